"""The figures of a comparison: common limits, signs, and runs of which something was not recorded."""

import json
from itertools import pairwise

import numpy as np
import pytest

from analysis.records.records import ProbeRecord, Record
from figures.compare import ALONE, beyond, draw_comparison, draw_densities, draw_sections, draw_slices, draw_traces
from figures.density import at_zero, unresolved_share
from figures.style import RUNS, style
from tests.figures.test_figures import POINT, laid_out
from tests.recorded import probe_of, synthetic


def records(tmp_path, *scales: float) -> dict[str, Record[ProbeRecord]]:
    made = {scale: synthetic(scale) for scale in scales}
    return {f"run {scale:g} $x_1$": Record(tmp_path, probe_of(data), arrays) for scale, (data, arrays) in made.items()}


def test_slices_share_the_smallest_window_and_the_levels(tmp_path):
    pair = records(tmp_path, 1.0, 0.25)
    figure = draw_slices(pair)
    arrays = [record.arrays["slice"] for record in pair.values()]
    reach = min(np.abs(each[axis]).max() for each in arrays for axis in "xy")
    panels = [axes for axes in figure.axes if axes.get_title(loc="left")]
    assert [axes.get_title(loc="left") for axes in panels] == [r"run 1 \$x_1\$", r"run 0.25 \$x_1\$"]
    for axes in panels:
        for limits in (axes.get_xlim(), axes.get_ylim()):
            exponent = round(np.log10(limits[1] / reach))
            assert limits == pytest.approx(np.array([-1, 1]) * reach * 10.0**exponent)
        assert axes.get_aspect() == 1.0
    levels = [axes.collections[0].levels for axes in panels]  # pyright: ignore[reportAttributeAccessIssue]
    assert (levels[0] == levels[1]).all()


def test_a_trace_shows_its_sign_and_whether_its_interval_decides_it(tmp_path):
    (record,) = records(tmp_path, 1.0).values()
    sh = record.data.traces["sh"]
    sh.value, sh.low, sh.high, sh.sign = 12.0, -1.0, 25.0, "undetermined"
    record.data.traces["means"].value = None
    marked = [line for line in draw_traces({"one": record}).axes[0].lines if line.get_marker() not in ("None", None)]
    looks = [(float(line.get_xdata()[0]), line.get_marker(), line.get_markerfacecolor()) for line in marked]  # pyright: ignore[reportIndexIssue, reportArgumentType]
    by_value = {round(value): (marker, face) for value, marker, face in looks}
    traces = record.data.traces
    assert len(looks) == 4 and by_value[12] == ("X", RUNS[0])
    assert by_value[round(-(traces["opacity_logits"].value or 0.0))] == ("o", "white")
    assert by_value[round(traces["quats"].value or 0.0)] == ("o", RUNS[0])


def test_a_density_is_divided_among_the_directions_on_both_sides_of_zero(tmp_path):
    (record,) = records(tmp_path, 1.0).values()
    nodes, weights = record.arrays["spectrum"]["nodes"], record.arrays["spectrum"]["weights"]
    (values, up), (_, down) = beyond(nodes, weights), beyond(-nodes, weights)
    assert up[0] + down[0] == pytest.approx(1, rel=1e-12) and (np.diff(values) > 0).all() and (np.diff(up) < 0).all()
    middle = values[len(values) // 2]
    assert up[len(values) // 2] == pytest.approx(np.where(nodes >= middle, weights, 0).sum(axis=1).mean(), rel=1e-12)
    left, right = draw_densities({"one": record, "two": record}).axes
    assert left.get_xlim()[::-1] == right.get_xlim()


def test_a_density_shows_how_far_its_start_vectors_lie_apart(tmp_path):
    (record,) = records(tmp_path, 1.0).values()
    spectrum = record.arrays["spectrum"]
    thin = [line for line in draw_densities({"one": record}).axes[1].lines if line.get_alpha() == ALONE["alpha"]]
    assert len(thin) == len(spectrum["nodes"]) == 3
    for line, nodes, weights in zip(thin, at_zero(spectrum["nodes"]), spectrum["weights"], strict=True):
        assert float(np.asarray(line.get_ydata())[0]) == pytest.approx(weights[nodes > 0].sum())


def test_a_side_of_which_only_ends_are_known_says_so(tmp_path):
    (record,) = records(tmp_path, 1.0).values()
    record.arrays["spectrum"]["nodes"] = np.abs(record.arrays["spectrum"]["nodes"])
    figure = draw_densities({"one": record})
    said = [[text.get_text() for text in axes.texts] for axes in figure.axes]
    assert said == [["the density found none; known\nare the extreme eigenvalues"], []]
    unresolved = unresolved_share(record.arrays["spectrum"])
    said = [text.get_text() for text in figure.legends[0].get_texts()]
    assert said == ["one", "end of the spectrum", unresolved] and unresolved.startswith("not resolved from 0: ")
    record.data.eigenvalues.max.value = record.data.eigenvalues.min.value = None
    figure = draw_densities({"one": record})
    assert [text.get_text() for text in figure.axes[0].texts] == ["none found"]
    assert len(figure.legends[0].get_texts()) == 2


def test_a_node_of_either_sign_that_is_not_resolved_from_0_curves_neither_up_nor_down(tmp_path):
    """One node holds nearly all of the weight, and its sign differs from start to start."""
    (record,) = records(tmp_path, 1.0).values()
    nodes = np.array([[-1.0, 1e-5, 0.5, 3.0], [-1.0, -1e-5, 0.6, 3.0]])
    record.arrays["spectrum"] |= {"nodes": nodes, "weights": np.full((2, 4), [0.01, 0.95, 0.03, 0.01])}
    down, up = draw_densities({"one": record}).axes
    most = [max(float(np.max(line.get_ydata())) for line in axes.lines if np.size(line.get_ydata()) > 2 or line.get_alpha())
            for axes in (down, up)]  # fmt: skip
    assert most == pytest.approx([0.01, 0.04])


def test_the_colour_bar_of_slices_is_labelled_at_its_levels_and_ends_at_the_data(tmp_path):
    figure = draw_slices(records(tmp_path, 1.0, 0.25))
    (bar,) = [axes for axes in figure.axes if axes.get_label() == "<colorbar>"]
    levels = figure.axes[0].collections[0].levels  # pyright: ignore[reportAttributeAccessIssue]
    labels = [float(text.get_text().replace("−", "-")) for text in bar.get_yticklabels()]
    assert labels == pytest.approx(levels[1:-1:2]) and bar.get_ylim() == pytest.approx((levels[0], levels[-1]))
    assert [axes.collections[0].extend for axes in figure.axes[:2]] == ["neither"] * 2  # pyright: ignore[reportAttributeAccessIssue]


def test_the_numbers_along_the_steps_of_sections_stay_apart(tmp_path):
    pair = records(tmp_path, 1.0, 0.25)
    for record in pair.values():
        for axis in "xy":
            record.arrays["slice"][axis] *= 0.1 / record.arrays["slice"][axis].max()
    figure = draw_sections(pair)
    renderer = laid_out(figure, dpi=300)
    for axes in figure.axes:
        with style():  # the ticks are made anew
            boxes = [label.get_window_extent(renderer) for label in axes.get_xticklabels() if label.get_text()]
        assert len(boxes) >= 3
        assert all(right.x0 - left.x1 > 4 * POINT * figure.dpi for left, right in pairwise(boxes))


def test_a_run_without_slice_or_density_is_in_the_other_pictures(tmp_path):
    both = records(tmp_path, 1.0, 2.0)
    poor = list(both.values())[1]
    del poor.arrays["slice"], poor.arrays["spectrum"]
    poor.data.slice = None
    assert len([axes for axes in draw_slices(both).axes if axes.get_title(loc="left")]) == 1
    for draw in (draw_sections, draw_densities, draw_traces):
        said = [text.get_text() for text in draw(both).legends[0].get_texts()]
        assert said[:2] == [label.replace("$", r"\$") for label in both]
    colours = {line.get_color() for line in draw_sections(both).axes[0].lines}
    assert colours == {RUNS[0]}


def test_what_no_run_has_is_not_drawn(tmp_path, monkeypatch):
    poor = records(tmp_path, 1.0, 2.0)
    for record in poor.values():
        record.arrays.clear()
        record.data.slice = None
    (tmp_path / "compare.json").write_text(json.dumps({"runs": {label: label for label in poor}}))
    monkeypatch.setattr("figures.compare.read_record", lambda folder, kind: poor[folder])
    assert [path.name for path in draw_comparison(tmp_path)] == ["compare_traces.png"]
