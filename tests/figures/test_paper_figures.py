"""The figures after the paper's Figs. 1 and 7: drawn from records, all landscapes to one scale; what is missing is named."""

import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from PIL import Image

from analysis.records.quantities import rough
from analysis.records.records import Record, SliceRecord, read_record, record_folder, write_record
from figures import fig1, fig7, surface
from figures.manifold import Scale, landscape_of, runs_script, start_of, window
from figures.plane import NOT_CONFIRMED
from figures.style import RUNS
from tests.figures.test_figures import POINT, laid_out
from tests.figures.test_trajectory_figure import rows
from tests.recorded import slice_of, synthetic, written


def slice_at(run: Path, scale: float) -> None:
    """A checkpoint in a run, and a slice of its landscape."""
    run.mkdir(parents=True, exist_ok=True)
    (run / "checkpoint.pt").touch()
    data, arrays = synthetic(scale)
    with record_folder(run / "slice-eigenvectors-2d", SliceRecord.FILE) as folder:
        write_record(folder, slice_of(data), {"slice": arrays["slice"]})


def rewrite(folder: Path, change: Callable[[Record], object]) -> None:
    record = read_record(folder)
    change(record)
    with record_folder(folder, SliceRecord.FILE) as anew:
        write_record(anew, record.data, record.arrays)


@pytest.fixture
def runs(tmp_path) -> list[Path]:
    """Two runs with all records: the second's curvatures are a ninth of the first's, the start's are nine times as large."""
    found = [tmp_path / "3dgs" / "0", tmp_path / "stablegs" / "0"]
    for run, scale in zip(found, (1.0, 1 / 9), strict=True):
        slice_at(run, scale)
        rows().to_csv(run / "trajectory.csv", index=False)
        (run / "test").mkdir()
        Image.new("RGB", (12, 9), "white").save(run / "test" / "view_3.png")
    slice_at(found[0] / "start", 9.0)
    return found


@pytest.mark.parametrize("module", [fig1, fig7], ids=["fig1", "fig7"])
def test_everything_stays_inside_the_page_steps_have_their_unit_and_ticks_overlap_no_words(runs, module):
    figure = module.draw(runs)
    renderer = laid_out(figure)
    drawn = figure.get_tightbbox(renderer)
    assert drawn.x0 >= -POINT and drawn.y0 >= -POINT
    assert drawn.x1 <= figure.get_figwidth() + POINT and drawn.y1 <= figure.get_figheight() + POINT
    steps = [axes.get_xlabel() for axes in figure.axes if not hasattr(axes, "get_zlim")]
    steps = [label for label in steps if label.startswith("step along")]
    assert steps and all("units of the parameters" in label for label in steps)
    for axes in figure.axes:
        names = [axes.xaxis.label, axes.yaxis.label]
        ticks = axes.get_xticklabels() + (axes.get_yticklabels() if hasattr(axes, "get_zlim") else [])
        low, high = axes.get_xlim()
        shown = [t for t in ticks if t.get_text() and (hasattr(axes, "get_zlim") or low <= t.get_position()[0] <= high)]
        boxes = [text.get_window_extent(renderer).shrunk(0.9, 0.7) for text in shown]
        assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i]), [t.get_text() for t in shown]
        if not hasattr(axes, "get_zlim"):
            assert not any(name.get_window_extent(renderer).overlaps(box) for name in names for box in boxes)


def test_stored_records_need_no_checkpoint(runs):
    for checkpoint in runs[0].parents[1].rglob("checkpoint.pt"):
        checkpoint.unlink()
    assert len(fig1.draw(runs).axes) == 9


def test_contours_have_the_ticks_of_the_sections(runs):
    for run, reach in zip(runs, (0.0532, 0.1005), strict=True):
        steps = {axis: value * reach / value.max() for axis, value in synthetic()[1]["slice"].items() if axis in "xy"}
        rewrite(run / "slice-eigenvectors-2d", lambda record, steps=steps: record.arrays["slice"].update(steps))
    figure = fig1.draw(runs)
    laid_out(figure)
    first, second = figure.axes[:2]
    sections = [axes for axes in figure.axes if axes.get_xlabel().startswith("step along e₁, e₂")]
    for axes in (first, second):
        assert axes.get_xticks().tolist() == axes.get_yticks().tolist() == sections[0].get_xticks().tolist()


def test_both_ends_share_their_axes_and_the_start_says_how_far_it_reaches(runs):
    figure = fig7.draw(runs)
    surfaces = [axes for axes in figure.axes if hasattr(axes, "get_zlim")]
    assert len(surfaces) == 3
    tightest = landscape_of(runs[0])
    reach = float(np.abs(tightest.x.steps).max())  # of the steepest direction of the steepest landscape: all reach it
    assert Scale.of(*map(landscape_of, runs)).reach == reach
    assert all(np.isfinite(window(landscape_of(run), reach)[1]).all() for run in runs)
    assert window(tightest, reach)[1][30, 30] == 0 and window(tightest, reach)[1][-1, 30] == pytest.approx(
        tightest.through_centre(tightest.rise, 0)[-1]
    )
    ends = {(axes.get_xlim(), axes.get_ylim(), axes.get_zlim()) for axes in surfaces[:2]}  # pyright: ignore[reportAttributeAccessIssue]
    assert len(ends) == 1
    wide = Scale.of(start_of(runs[0]))
    assert (
        surfaces[2]
        .get_title()
        .startswith(f"start of 3dgs, a window\n{rough(wide.reach / reach)} times as wide as at the last checkpoints;\n")
    )
    assert surfaces[2].get_xlim()[1] == pytest.approx(wide.reach / 10.0**wide.steps)
    across, along = figure.axes[-2:]
    assert across.get_xlim() == along.get_xlim()
    start, first, second = (np.ptp(np.asarray(line.get_xdata())) for line in across.lines)
    # a curvature unit is 1 / sqrt(lambda)
    assert first / start == pytest.approx(3) and second / first == pytest.approx(3)


def test_a_start_that_slopes_down_is_not_cut_off_at_the_ends_own_limits(runs):
    folder = runs[0] / "start" / "slice-eigenvectors-2d"
    down = np.linspace(1, -1, 21)[:, None] * np.full(17, 2e-2)
    rewrite(folder, lambda record: record.arrays["slice"].update(loss=record.data.slice.center_loss + down))
    along_e1 = fig7.draw(runs).axes[-2]
    start, *_ = (np.asarray(line.get_ydata(), float) for line in along_e1.lines)
    assert along_e1.get_ylim()[0] <= np.nanmin(start) < 0


def test_the_colours_of_the_surfaces_have_bars_and_open_dots_a_word(runs):
    figure = fig7.draw(runs)
    bars = [axes for axes in figure.axes if axes.get_label() == "<colorbar>"]
    ends, start = Scale.of(*map(landscape_of, runs)), Scale.of(start_of(runs[0]))
    for bar, scale in zip(bars, (ends, start), strict=True):
        assert bar.get_ylim() == pytest.approx((scale.low / 10.0**scale.loss, scale.high / 10.0**scale.loss))
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words == ["3dgs", "stablegs", "start", "open: the number is negative", fig7.UNIT]


def test_a_figure_makes_the_folder_that_it_is_written_to(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["fig1", *map(str, runs), "--out", str(tmp_path / "paper/figures/one.svg")])
    assert runs_script(fig1.draw, "fig1") == 0
    assert (tmp_path / "paper/figures/one.svg").is_file()


@pytest.mark.parametrize("module", [fig1, fig7], ids=["fig1", "fig7"])
def test_for_a_paper_titles_are_letters_and_the_caption_lies_beside_it(runs, tmp_path, monkeypatch, module):
    drawn = []
    monkeypatch.setattr(sys, "argv", ["figure", *map(str, runs), "--out", str(tmp_path / "one.png"), "--paper"])
    assert runs_script(lambda each: drawn.append(module.draw(each)) or drawn[0], "figure") == 0
    written = (tmp_path / "one.paper.pdf").read_bytes()
    assert written.startswith(b"%PDF") and b"STIX" in written and round(drawn[0].get_figwidth(), 1) == 6.9
    titles = [axes.get_title(side) for axes in drawn[0].axes for side in ("left", "center", "right")]
    letters = [title for title in titles if title]
    assert sorted(letters) == [f"({letter})" for letter in "abcdef"][: len(letters)] and len(letters) >= 4
    caption = (tmp_path / "one.paper.txt").read_text()
    assert "(a) " in caption and caption.count("\n") == 1
    assert not re.search(r"[^;] change of loss", caption)  # the titles of a panel are set apart
    if module is fig1:
        said = (
            "(a) 3dgs, step 2,000: λ max ",
            "0.11 times that of 3dgs",
            "(d) stablegs not scored.",
            "stablegs is the flatter one",
            "where the paper has StableGS flatter. One training",
        )
        assert [words for words in said if words not in caption] == []


def test_a_largest_eigenvalue_that_renders_do_not_confirm_is_said_to_be_so(runs):
    for run, confirmed in zip(runs, (True, False), strict=True):
        data, arrays = synthetic()
        renders = {"confirmed": confirmed, "steps": [1e-3], "ratios": [1.0], "errors": [0.1]}
        data["eigenvalues"]["max"]["renders"] = renders
        written(run / "probe", data, arrays)
    first, second = (axes.get_title() for axes in fig1.draw(runs).axes if hasattr(axes, "get_zlim"))
    assert NOT_CONFIRMED not in first and NOT_CONFIRMED in second
    doubts = [surface._doubt(read_record(run / "probe")) for run in runs]
    assert doubts[0] == "" and NOT_CONFIRMED in doubts[1]


def test_sections_fill_their_axes(runs):
    across = [axes for axes in fig1.draw(runs).axes if axes.get_xlabel().startswith("step along e₁, e₂")]
    seen = np.concatenate([np.ma.filled(np.ma.asarray(x.get_ydata())[abs(np.asarray(x.get_xdata())) <= axes.get_xlim()[1]], 0)
                           for axes in across for x in axes.lines])  # fmt: skip
    low, high = across[0].get_ylim()
    assert across[1].get_ylim() == (low, high) and np.ptp(seen) > 0.85 * (high - low) and low < seen.min()


def test_the_index_is_the_recorded_one_of_each_run(runs):
    index = fig7.draw(runs).axes[0]
    dots = [line for line in index.lines if line.get_marker() == "o" and len(np.asarray(line.get_xdata()))]
    assert {to_hex(line.get_color()).upper() for line in dots} == set(RUNS[:2])
    assert [float(y) for line in dots for y in np.asarray(line.get_ydata())] == [4.0, 9.0, 16.0] * 2
    assert fig7.names_of(runs) == ["3dgs", "stablegs"] and "one training each" in index.get_title()


def test_the_seeds_of_a_sweep_are_a_band_behind_the_index(runs):
    for run, factor in ((runs[0], 5.0), (runs[1], 2.0)):
        other = run.parent / "1"
        other.mkdir()
        table = rows()
        table[[name for name in table if name.startswith("eigenvalue_ratio")]] *= factor
        table.to_csv(other / "trajectory.csv", index=False)
    index = fig7.draw(runs).axes[0]
    reached = [np.asarray(band.get_paths()[0].vertices)[:, 1].max() for band in index.collections]
    assert {80.0, 32.0} <= set(np.round(reached, 6)) and "bands: 2 seeds" in index.get_title()


@pytest.mark.parametrize("module", [fig1, fig7], ids=["fig1", "fig7"])
@pytest.mark.parametrize(
    ("section", "key", "first", "second", "words"),
    [
        ("provenance", "views", ["a", "b"], ["a", "c"], "same training views"),
        ("objective", "sizes", [[12, 9]], [[24, 18]], "same sizes of the views"),
        ("objective", "loss", "L1", "L2", "same loss"),
        ("objective", "background", [0, 0, 0], [1, 1, 1], "same background"),
    ],
)
def test_landscapes_of_different_functions_are_not_drawn_together(runs, module, section, key, first, second, words):
    def recorded(run: Path, value: object) -> None:
        rewrite(run / "slice-eigenvectors-2d", lambda record: setattr(getattr(record.data, section), key, value))

    recorded(runs[0], first)
    recorded(runs[1], None)
    module.draw(runs)  # one does not say
    recorded(runs[1], second)
    with pytest.raises(ValueError, match=f"expected runs with the {words}.*draw them apart"):
        module.draw(runs)


def test_a_missing_record_is_named_with_the_command_that_makes_it(runs, tmp_path, capsys, monkeypatch):
    def refused(module, words: str, records: int = 1) -> None:
        monkeypatch.setattr(sys, "argv", ["figure", *map(str, runs), "--out", str(tmp_path / "out.png")])
        code = runs_script(module.draw, "figure")
        said = capsys.readouterr().err
        assert code == 2 and words in said and said.count("\n") == records, said
        assert not (tmp_path / "out.png").exists()

    (runs[0] / "start" / "slice-eigenvectors-2d" / "slice.json").unlink()
    refused(fig7, f"run: landscape slice {runs[0] / 'start' / 'checkpoint.pt'}")
    (runs[0] / "start" / "checkpoint.pt").unlink()
    refused(fig7, "train anew with --probe-every, which keeps it")
    table = pd.read_csv(runs[1] / "trajectory.csv")
    table[["step", "gaussians"]].to_csv(runs[1] / "trajectory.csv", index=False)
    refused(fig7, f"expected the records of landscape train --probe-every in {runs[1] / 'trajectory.csv'}", 2)
    table.assign(state="skipped").to_csv(runs[1] / "trajectory.csv", index=False)
    refused(fig7, "all were skipped", 2)
    (runs[1] / "trajectory.csv").unlink()
    refused(fig7, "found none; train anew with --probe-every", 2)
    (runs[1] / "test" / "view_3.png").unlink()
    shutil.rmtree(runs[1] / "slice-eigenvectors-2d")
    refused(fig1, f"run: landscape slice {runs[1] / 'checkpoint.pt'}", 2)
    slice_at(runs[1], 1.0)
    refused(fig1, "run landscape train to its end")


def test_a_suffix_that_is_none_of_a_picture_is_refused(runs, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["figure", *map(str, runs), "--out", str(tmp_path / "out.abc")])
    assert runs_script(fig7.draw, "fig7") == 2
    told = f"expected a file that ends with .png, .pdf or .svg, got {tmp_path / 'out.abc'}\n"
    assert capsys.readouterr().err == told
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize("module", [fig1, fig7], ids=["fig1", "fig7"])
def test_all_that_is_missing_is_named_at_once(runs, module):
    for run in (*runs, runs[0] / "start"):
        shutil.rmtree(run / "slice-eigenvectors-2d")
    missing = [f"run: landscape slice {run / 'checkpoint.pt'}" for run in runs]
    if module is fig1:
        shutil.rmtree(runs[0] / "test")
        missing.append(f"expected renders of held-out views in {runs[0] / 'test'}")
    else:
        (runs[1] / "trajectory.csv").unlink()
        missing.append(f"expected trajectory.csv in the run {runs[1]}, found none; train anew with --probe-every")
        missing.append(f"run: landscape slice {runs[0] / 'start' / 'checkpoint.pt'}")
    with pytest.raises(ValueError) as refused:
        module.draw(runs)
    lines = str(refused.value).splitlines()
    assert all(words in str(refused.value) for words in missing) and len(lines) == len(missing)
    assert all(line.count("expected") == 1 for line in lines)
