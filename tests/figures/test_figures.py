import json
import math
import os
import signal
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes._secondary_axes import SecondaryAxis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.contour import QuadContourSet
from matplotlib.patches import Ellipse
from matplotlib.text import Text
from msgspec import convert
from PIL import Image

from analysis.console.drawing import own_python
from analysis.records.quantities import exponent_of, quantity
from analysis.records.records import read_record
from analysis.records.run_files import Steepest
from figures import make_all, maps, slice2d, spectrum, surface, traces, uses
from figures.plane import plane
from figures.style import BLACK, BLUE, COLUMN, ORANGE, SKY, VERMILION, save, style
from landscape.errors import TooLittleMemory
from tests.recorded import long_numbers, synthetic, written, written_map
from tests.refusals import refused

POINT = 1 / 72  # inches


def test_a_png_is_what_matplotlib_saves_and_takes_one_drawing(tmp_path, monkeypatch):
    record = written(tmp_path / "probe", *synthetic())
    with style():
        traces.draw(record).savefig(tmp_path / "saved.png")
    figure, drawings = traces.draw(record), []
    draw = figure.draw
    monkeypatch.setattr(figure, "draw", lambda renderer: drawings.append(renderer) or draw(renderer))
    drawn, saved = (Image.open(path) for path in (save(figure, tmp_path / "traces.png"), tmp_path / "saved.png"))
    assert np.array_equal(np.asarray(drawn), np.asarray(saved.convert("RGB")))
    assert drawn.info["dpi"] == saved.info["dpi"]
    assert len(drawings) == 1


def laid_out(figure, dpi=100):
    """The figure drawn once, as `save` does, at a resolution that suffices for its layout; the renderer that measures it.

    None of its texts has a number of more than three digits.
    """
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    with style():  # how many ticks there are is decided when they are drawn
        canvas.draw()
    texts = [text.get_text() for text in figure.findobj(Text) if text.get_visible()]
    assert [text for text in texts if long_numbers(text)] == []
    return canvas.get_renderer()


def words(figure, renderer):
    """(text, box in pixels) of every text that is drawn and is no bare number."""
    texts = [text for text in figure.findobj(Text) if text.get_visible() and any(c.isalpha() for c in text.get_text())]
    return [(text.get_text(), text.get_window_extent(renderer)) for text in texts]


def require_layout(figure):
    """Everything drawn lies inside the figure, of a column's width; no two texts overlap."""
    renderer = laid_out(figure)
    drawn = figure.get_tightbbox(renderer)
    assert figure.get_figwidth() == COLUMN
    assert drawn.x0 >= -POINT and drawn.y0 >= -POINT
    assert drawn.x1 <= COLUMN + POINT and drawn.y1 <= figure.get_figheight() + POINT
    require_apart(words(figure, renderer))


def require_apart(boxes):
    pairs = [(a, b) for i, (a, box) in enumerate(boxes) for b, near in boxes[:i] if box.shrunk(0.9, 0.9).overlaps(near)]
    assert pairs == []


def difficult(case):
    """The synthetic record and what can be wrong with one."""
    if case in {"1e-12", "1e9"}:
        return synthetic(float(case))
    data, arrays = synthetic()
    if case == "no numbers":
        data["traces"]["means"] |= {"value": math.nan, "standard_error": math.nan, "low": None, "high": None}
        data["traces"]["quats"] |= {"value": None, "standard_error": None, "tau": None, "low": None, "high": None}
        arrays["slice"]["loss"][2:6, :4] = math.nan
        arrays["traces"] = {}
    if case == "flat":
        for entry in data["traces"].values():
            entry |= {"value": 0.0, "standard_error": 0.0, "low": 0.0, "high": 0.0, "tau": 0.0, "sign": "zero"}
        arrays["slice"]["loss"][:] = data["slice"]["center_loss"]
        arrays["spectrum"]["ritz_values"][:] = 0.0
    if case == "extremes":
        data["traces"]["means"] |= {"value": 1e9, "standard_error": 1e8, "low": 8e8, "high": 1.2e9}
        data["traces"]["sh"] |= {"value": -1e-12, "standard_error": 1e-13, "low": -1.2e-12, "high": -8e-13}
        data["traces"]["opacity_logits"] |= {"value": -50.0, "standard_error": 80.0, "low": -210.0, "high": 110.0}
        data["traces"]["opacity_logits"]["sign"] = "undetermined"
    if case == "long legend":
        data["slice"] |= {"loss_scale": 7.49e-5, "interpolation_error": 0.005}
        arrays["slice"]["evaluated"] = (np.arange(21 * 17) % 5 == 0).reshape(21, 17)
        arrays["slice"]["crossed"] = arrays["slice"]["evaluated"]
        steps = np.linspace(-1, 1, 21)[:, None] * np.ones(17)
        arrays["slice"]["model"] = data["slice"]["center_loss"] + 2e-3 * steps**2
        arrays["slice"]["loss"] = data["slice"]["center_loss"] + 2e-3 * (1.1 - abs(steps)) * steps**2
    if case == "least":
        arrays = {"slice": {k: arrays["slice"][k] for k in ("x", "y", "loss")}, "spectrum": arrays["spectrum"]}
        arrays["spectrum"] = {k: arrays["spectrum"][k][[0, -1]] for k in ("ritz_values", "residuals")}
    return data, arrays


DRAWN = (traces, spectrum, slice2d, surface)
CASES = dict.fromkeys(("plain", "1e-12", "1e9", "flat", "least"), DRAWN)  # and the figures that have what is changed
CASES |= {"no numbers": (traces, slice2d, surface), "extremes": (traces,), "long legend": (slice2d, surface)}


@pytest.mark.parametrize(
    ("module", "case"),
    [pytest.param(module, case, id=f"{module.__name__}-{case}") for case, drawn in CASES.items() for module in drawn],
)
def test_labels_stay_inside_the_column_and_apart_whatever_the_record(tmp_path, module, case):
    require_layout(module.draw(written(tmp_path / "probe", *difficult(case))))


def test_titles_of_renders_along_an_end_stay_apart(tmp_path):
    written_map(tmp_path / "map", {})
    end = json.loads((tmp_path / "map" / "map.json").read_text())["steepest"][0]
    end["carriers"] = [end["carriers"][0] | {"gaussian": 123456 + i, "share": 0.152} for i in range(5)]
    end |= {"step": 0.00373, "length": "1/32 × the optimiser's step", "losses": [0.07408, 0.0735, 0.07414]}
    pictures: dict[str, np.ndarray] = {name: np.zeros((126, 168, 3), np.uint8) for name in maps.END_MAPS}
    pictures["difference"] = np.zeros((126, 168), np.uint8)
    figure = maps.draw_steepest(pictures, convert(end, Steepest))
    require_apart(said := words(figure, laid_out(figure)))
    assert sum("(1/32 × the optimiser's step)" in text for text, _ in said) == 2
    colours = [each.get_edgecolor() for axes in figure.axes for each in axes.patches if isinstance(each, Ellipse)]
    assert len(colours) == 10 and len(set(colours)) == 5
    part = next(axes for axes in figure.axes if "15%" in str([text.get_text() for text in axes.texts]))
    # they cover no outline
    assert all(text.get_window_extent().y1 < part.get_window_extent().y0 for text in part.texts)


def test_the_drawn_traces_are_the_recorded_ones(tmp_path):
    record = written(tmp_path / "probe", *synthetic())
    axes = traces.draw(record).axes[0]
    markers = [line for line in axes.lines if line.get_marker() in {"o", "s"}]
    drawn = [float(np.asarray(line.get_xdata())[0]) for line in markers]
    assert drawn == [abs(trace.value) for trace in record.data.traces.values()]
    assert [line.get_marker() for line in markers] == ["o", "o", "o", "s", "o"]  # only opacity is negative


def test_an_undetermined_sign_reaches_the_left_edge(tmp_path):
    axes = traces.draw(written(tmp_path / "probe", *difficult("extremes"))).axes[0]
    left = axes.get_xlim()[0]
    bars = [line for line in axes.lines if line.get_marker() == "None" and len(np.asarray(line.get_xdata())) == 2]
    assert [float(np.asarray(bar.get_xdata())[0]) == left for bar in bars] == [False, False, False, True, False]


def test_a_density_shows_who_has_the_curvature(tmp_path):
    data, arrays = synthetic()
    arrays["spectrum"] |= {"nodes": np.array([[0.1, 61.0, -20.0]]), "weights": np.array([[0.9, 0.05, 0.05]])}
    axes = spectrum.draw(written(tmp_path / "probe", data, arrays)).axes[1]
    directions, curvature = (np.asarray(line.get_ydata(), float) for line in axes.lines[:2])
    x = np.asarray(axes.lines[0].get_xdata(), float)
    np.testing.assert_array_equal(x[1:-1], [-20.0, 0.0, 61.0])  # 0.1 is not resolved from 0
    np.testing.assert_allclose(directions[1:-1], [0.05, 0.95, 1.0], rtol=1e-12)
    np.testing.assert_allclose(curvature[1:-1], np.array([1.0, 1.09, 4.14]) / 4.14, rtol=1e-12)
    assert directions[0] == 0 == curvature[0] and directions[-1] == 1 == curvature[-1]
    assert axes.get_title(loc="left").endswith("not resolved from 0: 90% of all")


def test_ritz_values_and_ends_are_headed_by_what_is_converged_and_confirmed(tmp_path):
    data, arrays = synthetic()
    renders = {"confirmed": False, "steps": [1e-3], "ratios": [-2.0], "errors": [0.1]}
    data["eigenvalues"]["min"]["renders"] = renders
    axes = spectrum.draw(written(tmp_path / "probe", data, arrays)).axes
    first, top, bottom = axes[-1].get_title(loc="left").split("\n")
    found = arrays["spectrum"]
    converged = (found["residuals"] < spectrum.CONVERGED * abs(found["ritz_values"])).sum()
    assert first == f"60 eigenvalues met, {converged} known to 10%" and 0 < converged < 60
    assert top.startswith("λ max: ") and bottom.startswith("λ min, not confirmed: ")
    assert any(text.get_text().startswith("λ min, not confirmed = ") for text in axes[0].texts)


def test_cross_sections_are_the_rows_and_columns_through_the_centre(tmp_path):
    record = written(tmp_path / "probe", *synthetic())
    figure, arrays = slice2d.draw(record), record.arrays["slice"]
    field = plane(record)
    center = record.data.slice.center_loss
    sections = {axes.get_xlabel(): axes.lines[0] for axes in figure.axes if "step along" in axes.get_xlabel()}
    first = np.asarray(sections[field.x.short_label].get_ydata(), dtype=float) * 10.0**field.exponent
    second = np.asarray(sections[field.y.short_label].get_ydata(), dtype=float) * 10.0**field.exponent
    np.testing.assert_allclose(first, arrays["loss"][:, 8] - center, rtol=1e-12, atol=1e-17)
    np.testing.assert_allclose(second, arrays["loss"][10, :] - center, rtol=1e-12, atol=1e-17)


@pytest.mark.parametrize("reach", [(0.3, 0.0072), (0.06, 0.04), (0.001, 0.4), (7.0, 0.145)], ids=str)
def test_the_numbers_along_the_steps_stay_apart(tmp_path, reach):
    """Directions with a power of ten in common may leave one of them many digits."""
    data, arrays = synthetic()
    for name, about, far in zip("xy", data["slice"]["directions"], reach):
        arrays["slice"][name] *= far / arrays["slice"][name].max()
        about["unit"] = far / 3
    figure = slice2d.draw(written(tmp_path / "probe", data, arrays))
    renderer = laid_out(figure, dpi=300)
    for axes in (axes for axes in figure.axes if "step along" in axes.get_xlabel()):
        uppers = [upper for upper in axes.child_axes if isinstance(upper, SecondaryAxis)]
        for axis in (axes.xaxis, *(upper.xaxis for upper in uppers)):
            with style():  # the ticks are made anew
                labels = [label for label in axis.get_majorticklabels() if label.get_text()]
            boxes = [label.get_window_extent(renderer) for label in labels]
            inside = [box for box in boxes if axes.bbox.x0 - 1 <= (box.x0 + box.x1) / 2 <= axes.bbox.x1 + 1]
            assert len(inside) >= 3
            assert all(right.x0 - left.x1 > 4 * POINT * figure.dpi for left, right in pairwise(inside))


@pytest.mark.parametrize(("error", "said"), [(1.0, "One candidate is better"), (30.0, "4 of 9 candidates are equal")])
def test_the_gains_of_candidates_fit_their_figure_whatever_their_names(error, said):
    places = np.arange(9.0)
    table = pd.DataFrame({"view": [f"images/{'DSC_20190401_123456_HDR_' * (i % 3)}{i}.png" for i in range(9)]})
    table = table.assign(behind=20 * places, error=error * (places > 0), pick=np.where(places > 0, np.nan, 1.0))
    figure = uses.draw_gains(table.assign(coverage=-places, farthest=-places, uniform=-places))
    require_layout(figure)
    assert figure.get_suptitle().startswith(said)


def test_the_first_direction_runs_to_the_right(tmp_path):
    data, arrays = synthetic()
    arrays["slice"]["loss"] = data["slice"]["center_loss"] + np.add.outer(np.arange(21.0), np.zeros(17))
    arrays["slice"]["evaluated"] = np.arange(21)[:, None] * np.ones(17) > 15
    axes = slice2d.draw(written(tmp_path / "probe", data, arrays)).axes[0]
    (dots,) = [line for line in axes.lines if len(np.asarray(line.get_xdata())) == 5 * 17]
    assert np.min(np.asarray(dots.get_xdata())) > 0.4 * axes.get_xlim()[1]


def test_renders_and_interpolated_points_are_told_apart(tmp_path):
    data, arrays = synthetic()
    evaluated = np.zeros((21, 17), bool)
    evaluated[::5, ::4] = True
    arrays["slice"]["evaluated"], arrays["slice"]["crossed"] = evaluated, evaluated & (np.arange(21) > 10)[:, None]
    data["slice"]["interpolation_error"] = 0.004
    figure = slice2d.draw(written(tmp_path / "probe", data, arrays))
    dotted = [line for line in figure.axes[0].lines if line.get_marker() == "."]
    dots = {line.get_color(): len(np.asarray(line.get_xdata())) for line in dotted}
    assert dots == {slice2d.FAINT["color"]: 5 * 5}
    said = " ".join(text for text, _ in words(figure, laid_out(figure)))
    for part in ("plane: 7% rendered,\nelse interpolated (error <0.40%)", "order changed: 10\nof 25 renders"):
        assert part in said
    assert _blue(figure) == [2, 0]


def _blue(figure):
    """Numbers of blue dots in the two sections."""
    sections = [axes for axes in figure.axes if axes.get_title(loc="left").startswith("Along")]
    return [sum(len(np.asarray(x.get_xdata())) for x in axes.lines if x.get_color() == SKY) for axes in sections]


@pytest.mark.parametrize(("changed", "dots"), [(0.9, [18, 1]), (0.96, [0, 0])])
def test_the_legend_tells_how_many_changed_also_where_nearly_all_have_and_no_dot_is_blue(tmp_path, changed, dots):
    data, arrays = synthetic()
    arrays["slice"]["crossed"] = np.zeros((21, 17), bool)
    arrays["slice"]["crossed"][: round(changed * 20), 8] = True
    arrays["slice"]["evaluated"] = np.zeros((21, 17), bool)
    arrays["slice"]["evaluated"][:20, 8] = True
    figure = slice2d.draw(written(tmp_path / "probe", data, arrays))
    assert _blue(figure) == dots
    entries = {
        str(x.get_label()).split(":")[0]: x.get_marker()
        for x in slice2d._legend(plane(read_record(tmp_path / "probe")))
    }
    assert entries["order changed"] == ("." if any(dots) else "None")  # their number is told in any case


def test_contours_of_the_loss_are_solid_also_below_0_and_at_the_ticks_of_the_colour_bar(tmp_path):
    data, arrays = synthetic()
    arrays["slice"]["loss"] = 2 * data["slice"]["center_loss"] - arrays["slice"]["loss"]
    figure = slice2d.draw(written(tmp_path / "probe", data, arrays))
    axes = next(each for each in figure.axes if each.get_ylabel().startswith("step"))
    loss, model = (each for each in axes.collections if isinstance(each, QuadContourSet) and not each.filled)
    dashes = [[dash for _, dash in np.asarray(each.get_linestyle(), dtype=object)] for each in (loss, model)]
    levels = [*loss.levels]
    assert min(levels) < 0 and dashes[0] == [None] * len(levels) and dashes[1][0] is not None
    (bar,) = axes.child_axes
    assert list(bar.get_yticks()) == levels


@pytest.mark.parametrize(("stretch", "same"), [(1.2, True), (1.6, False)])
def test_ranges_that_are_alike_have_the_same_ticks(tmp_path, stretch, same):
    data, arrays = synthetic()
    arrays["slice"]["x"] = np.linspace(-6.5, 6.5, 21)
    arrays["slice"]["y"] = np.linspace(-6.5, 6.5, 17) * stretch
    figure = slice2d.draw(written(tmp_path / "probe", data, arrays))
    first, second = (each.get_xticks().tolist() for each in figure.axes if each.get_title("left").startswith("Along"))
    assert (first == second) == same


FAR = "what its curvature says, at 0.30 to 3.0 curvature units"


@pytest.mark.parametrize(
    ("ratio", "said"),
    [
        (lambda s: 1.1, "curves as its curvature says"),
        (lambda s: 0.14, f"curves up 0.14 times {FAR}"),
        (lambda s: 2.15 - 1.03 * s, f"curves up 1.1 to 2.0 times {FAR}"),
        (lambda s: 1.1 - s, "curves as its curvature says to 0.90 curvature units, then 0.10 to 0.70 times as much"),
        (lambda s: 10 * (s - 0.5) ** 2 - 0.2, f"curves −0.20 to 2.3 times {FAR}"),
        (lambda s: 1.3 - 1.5 * s, "curves as its curvature says to 0.90 curvature units, then falls on one side"),
        (lambda s: -0.2, "falls on one side, against its curvature"),
        (lambda s: -2.0, "falls on both sides, against its curvature"),
    ],
)
def test_a_section_is_headed_by_how_far_its_curvature_holds(tmp_path, ratio, said):
    """With a slope, which cancels in second differences.  Steps of 0.3 units to 3."""
    data, arrays = synthetic()
    steps = np.linspace(-1, 1, 21)[:, None] * np.ones(17)
    arrays["slice"]["model"] = data["slice"]["center_loss"] + steps + 2 * steps**2
    arrays["slice"]["loss"] = data["slice"]["center_loss"] + steps + 2 * ratio(abs(steps)) * steps**2
    figure = slice2d.draw(written(tmp_path / "probe", data, arrays))
    titles = [axes.get_title(loc="left").replace("\n", " ") for axes in figure.axes]
    assert f"Along {data['slice']['directions'][0]['name']} the loss {said}" in titles
    uppers = [top.get_xlabel() for axes in figure.axes for top in axes.child_axes if isinstance(top, SecondaryAxis)]
    assert uppers == [f"steps in curvature units,\n1: ΔL = {quantity(data['slice']['loss_scale'])}"] * 2
    assert all(
        handle.get_marker() != "None" or handle.get_linestyle() != "None"
        for handle in figure.subfigs[0].legends[0].get_lines()
    )
    require_layout(figure)


def test_a_plane_of_too_few_renders_is_drawn_as_its_sections_with_the_command_that_resolves_it(tmp_path):
    data, arrays = synthetic()
    evaluated = np.zeros((21, 17), bool)
    evaluated[10], evaluated[:, 8] = True, True
    arrays["slice"]["evaluated"], arrays["slice"]["crossed"] = evaluated, evaluated & False
    arrays["slice"]["loss"][~evaluated] = np.nan
    data["slice"] |= {"resolved": False, "tolerance": 0.01, "evaluated_points": 37, "interpolation_error": None}
    record = written(tmp_path / "probe", data, arrays)
    figure = slice2d.draw(record)
    require_layout(figure)
    said = " ".join(" ".join(text.split()) for text, _ in words(figure, laid_out(figure)))
    command = f"landscape slice {record.data.provenance.checkpoint} renders more"
    assert "37 of 357 renders" in said and command in said.replace("\n", " ")
    assert not any(axes.collections for axes in figure.axes)  # no contours
    for axes, count in zip(figure.axes[:2], (21, 17), strict=True):
        curve = next(line for line in axes.lines if line.get_linestyle() == "-" and line.get_color() == BLACK)
        assert np.isfinite(np.asarray(curve.get_ydata(), float)).sum() == count
    refused(r"landscape slice .* renders more", surface.draw, record)
    assert "surface.png" not in [path.name for path in make_all.draw_probe(record.folder)]


def test_a_missing_slice_is_said_and_the_other_figures_are_drawn(tmp_path):
    data, arrays = synthetic()
    del arrays["slice"]
    record = written(tmp_path / "probe", data | {"slice": None}, arrays)
    for module in (slice2d, surface):
        refused("expected a recorded slice", module.draw, record)
    assert [path.name for path in make_all.draw_probe(record.folder)] == ["traces.png", "spectrum.png"]


def test_a_slice_without_a_finite_point_is_refused(tmp_path):
    data, arrays = synthetic()
    arrays["slice"]["loss"][:] = math.nan
    refused("expected finite losses", slice2d.draw, written(tmp_path / "probe", data, arrays))


def test_the_command_draws_the_folder_named_on_its_standard_input(tmp_path):
    folder = written(tmp_path / "probe", *synthetic()).folder
    command = own_python("figures.make_all", "--only", "traces", "--only", "spectrum", "-")
    for said, names in (("", []), (str(folder), ["spectrum.png", "traces.png"])):
        done = subprocess.run(**command, input=said, capture_output=True, text=True, check=True)
        assert done.stderr == "" and sorted(path.name for path in folder.glob("*.png")) == names
    by_processes = {path.name: path.read_bytes() for path in folder.glob("*.png")}
    alone = make_all.draw_probe(folder, only=["traces", "spectrum"])  # by this process
    assert {path.name: path.read_bytes() for path in alone} == by_processes


def test_the_end_of_a_process_that_draws_is_said(tmp_path, monkeypatch):
    folder = written(tmp_path / "probe", *synthetic()).folder
    monkeypatch.setitem(make_all.FIGURES, "traces", lambda record: os.kill(os.getpid(), signal.SIGKILL))
    refused("a process that draws was ended", make_all.draw_probe, folder, processes=2, error=TooLittleMemory)


def test_a_surface_marks_its_renders_and_has_true_proportions_or_says_that_it_has_not(tmp_path):
    data, arrays = synthetic()
    evaluated = np.zeros((21, 17), bool)
    evaluated[[3, 20], 8] = True
    arrays["slice"]["evaluated"] = evaluated
    for stretch, said in ((1.0, False), (10.0, True)):
        arrays["slice"]["y"] = stretch * arrays["slice"]["x"][2:19]
        record = written(tmp_path / "probe", data, arrays)
        figure, field = surface.draw(record), plane(record)
        (dots,) = (line for line in figure.axes[0].lines if line.get_marker() == ".")
        x, y, height = dots.get_data_3d()  # pyright: ignore[reportAttributeAccessIssue]
        assert x == pytest.approx(field.x.scaled[[3, 20]]) and y == pytest.approx([field.y.scaled[8]] * 2)
        assert height == pytest.approx(field.change[[3, 20], 8])
        assert ("differ in scale" in figure.get_suptitle()) == said


def test_a_figure_from_the_command_line_and_its_refusal(tmp_path):
    folder = written(tmp_path / "probe", *synthetic()).folder
    command = [sys.executable, "-m", "figures.make_all", "--only", "traces"]
    good, bad = (subprocess.run([*command, str(at)], capture_output=True, text=True) for at in (folder, tmp_path))
    assert good.returncode == 0 and good.stdout.strip() == str(folder / "traces.png")
    with Image.open(folder / "traces.png") as picture:
        assert picture.width == round(COLUMN * 300)
    assert bad.returncode == 2 and bad.stderr.startswith("expected a folder") and "Traceback" not in bad.stderr


def test_an_axis_takes_out_a_power_of_a_thousand():
    assert [exponent_of(10.0**k) for k in (-12, -4, -1, 0, 3, 4, 9)] == [-12, -6, 0, 0, 0, 3, 9]
    assert exponent_of(np.array([np.nan, 0.0])) == 0


def test_rendered_steps_are_drawn_within_the_axes_however_far_from_the_curvature(tmp_path):
    data, arrays = synthetic()
    data["steps"] = dict.fromkeys(data["traces"], 1e-3)
    data["step_rises"] = {name: (10.0 ** (-3 * k), 0.0) for k, name in enumerate(data["traces"])}
    figure = traces.draw(written(tmp_path / "probe", data, arrays))
    axes, (legend,) = figure.axes[0], figure.legends
    looks = {(each.get_label(), each.get_marker(), each.get_color()) for each in legend.get_lines()}
    assert looks == {
        ("by curvature, positive", "o", BLUE), ("by curvature, negative", "s", VERMILION), ("rendered", "D", ORANGE),
    }  # fmt: skip
    low, high = axes.get_xlim()
    drawn = [
        float(np.ravel(line.get_xdata())[0])
        for line in axes.lines
        if line.get_marker() == "D" and line.get_color() == ORANGE
    ]
    shown = [rise / data["objective"]["value"] for rise, _ in data["step_rises"].values()]
    assert drawn == pytest.approx(shown) and low < min(drawn) and max(drawn) < high
