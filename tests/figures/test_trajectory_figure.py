"""The landscape along trainings: gathered, drawn as recorded, and legible; what is missing is named."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

from analysis.commands.cli import main
from analysis.runs.trajectories import first_and_last, gathered
from analysis.train.trajectory import COLUMNS
from figures import trajectory
from figures.style import RUNS
from figures.trajectory import UNITS
from tests.figures.test_figures import require_layout
from tests.recorded import ATTRIBUTES


def rows(scale: float = 1.0, steps: int = 4) -> pd.DataFrame:
    """A run's records, the first one skipped; the eigenvalue ratio is negative, the participation ratio unbounded above."""
    found = []
    for i in range(1, steps + 1):
        row = {"step": 500 * i, "gaussians": 1000 * i, "state": "whole", "note": "", "seconds": 1.0, "time_share": 0.1}
        for j, name in enumerate(ATTRIBUTES):
            value = scale * (10.0 ** (i + j) if j % 2 else i - 2.5)
            row |= {f"trace_{name}": value, f"trace_{name}_error": 0.1 * abs(value)}
            row |= {f"trace_{name}_low": value - 0.2 * abs(value), f"trace_{name}_high": value + 0.2 * abs(value)}
        row |= {"lambda_max": scale * i, "lambda_max_error": 0.1 * scale, "lambda_min": -scale / i}
        row["lambda_min_error"] = 0.0
        for name, value, low, high in (
            ("eigenvalue_ratio", -float(i * i), -1.1 * i * i, -0.9 * i * i),
            ("participation_ratio", 10.0 * i, 5.0 * i, math.nan),
        ):
            row |= {name: value, f"{name}_low": low, f"{name}_high": high}
        found.append(row)
    found[0] = {key: value for key, value in found[0].items() if key in COLUMNS[:6]} | {"state": "skipped"}
    return pd.DataFrame(found, columns=list(COLUMNS))


def run(folder: Path, scale: float = 1.0) -> Path:
    folder.mkdir(parents=True)
    rows(scale).to_csv(folder / "trajectory.csv", index=False)
    return folder


@pytest.mark.parametrize("scale", [1e-12, 1e9])
def test_labels_stay_inside_the_column_and_apart_whatever_the_records(tmp_path, scale):
    figure = trajectory.draw(gathered([run(tmp_path / "3dgs", scale), run(tmp_path / "stablegs", 3 * scale)]))
    require_layout(figure)


def test_what_is_drawn_is_what_was_recorded(tmp_path):
    table = gathered([run(tmp_path / "a"), run(tmp_path / "b", 3.0)])
    figure = trajectory.draw(table)
    panels = {axes.get_title(): axes for axes in figure.axes}
    assert all(axes.get_yscale() == "log" for axes in panels.values())
    for name, colour, scale in (("a", RUNS[0], 1.0), ("b", RUNS[1], 3.0)):
        lines = [x for x in panels["trace of position"].lines if to_hex(x.get_color()).upper() == colour]
        assert list(np.asarray(lines[0].get_xdata())) == [1000, 1500, 2000], name  # the skipped record is left out
        assert np.asarray(lines[0].get_ydata()) == pytest.approx([scale * abs(i - 2.5) for i in (2, 3, 4)])
    smallest = panels["−λ min"]
    filled = [x for x in smallest.lines if x.get_marker() == "o" and to_hex(x.get_markerfacecolor()) != "#ffffff"]
    heights = [float(y) for x in filled for y in np.asarray(x.get_ydata())]
    assert heights == pytest.approx([1 / 2, 1 / 3, 1 / 4, 3 / 2, 1, 3 / 4])
    assert list(np.asarray(panels["Gaussians"].lines[0].get_ydata())) == [2000, 3000, 4000]
    assert "a: λ max × 2.0 from step 1,000 to 2,000" in figure.get_suptitle()


def test_trainings_of_a_method_share_its_colour_and_its_sentence(tmp_path):
    figure = trajectory.draw(gathered([run(tmp_path / name) for name in ("3dgs/0", "3dgs/1", "stablegs/0")]))
    looks = {x.get_label(): (str(x.get_color()).upper(), x.get_linestyle()) for x in figure.legends[0].get_lines()[:3]}
    assert looks == {"3dgs/0": (RUNS[0], "-"), "3dgs/1": (RUNS[0], "--"), "stablegs/0": (RUNS[1], "-")}
    grown = rows()
    grown.loc[grown.index[-1], "lambda_max"] = 40.0
    figure = trajectory.draw(pd.concat([rows().assign(run="a/0"), grown.assign(run="a/1")], ignore_index=True))
    assert figure.get_suptitle() == "a: λ max × 2.0 to 20 from step 1,000 to 2,000 (2 runs)"


def test_a_number_that_is_0_within_round_off_is_left_off_the_logarithmic_axis():
    table = rows().assign(run="a")
    table.loc[1, ["trace_quats", "trace_quats_low", "trace_quats_high"]] = -7.7e-9
    figure = trajectory.draw(table)
    axes = {each.get_title(): each for each in figure.axes}["trace of rotation"]
    assert "left off: 0 within round-off" in [text.get_text() for text in figure.legends[0].get_texts()]
    assert {each.get_xlim() for each in figure.axes} == {(920.0, 2080.0)}
    (line,) = [x for x in axes.lines if x.get_linestyle() == "-"]
    assert np.isfinite(np.asarray(line.get_ydata(), float)).tolist() == [False, True, True]
    assert axes.get_ylim()[0] > 1e-3


def test_a_bound_is_an_arrow_without_a_line(tmp_path):
    axes = {x.get_title(): x for x in trajectory.draw(gathered([run(tmp_path / "a")])).axes}["participation ratio"]
    arrows = [x for x in axes.lines if x.get_marker() == trajectory.ARROW["marker"]]
    assert [float(y) for x in arrows for y in np.asarray(x.get_ydata())] == [10.0, 15.0, 20.0]
    lines = [x for x in axes.lines if x.get_linestyle() == "-"]
    assert lines and not np.isfinite(np.concatenate([np.asarray(x.get_ydata(), float) for x in lines])).any()
    assert all(x.get_linestyle() == "None" for x in arrows)


def test_an_index_that_coarse_records_lack_is_said_to_be_so():
    coarse = rows().assign(run="a", participation_ratio=math.nan, participation_ratio_low=math.nan)
    panels = {axes.get_title(): axes for axes in trajectory.draw(coarse).axes}
    assert [text.get_text() for text in panels["participation ratio"].texts] == ["not measured"]
    assert not panels["participation ratio"].get_xticks().size and not panels["largest eigenvalue"].texts


def test_ticks_are_at_steps_such_as_are_recorded():
    assert list(trajectory.step_ticks().tick_values(90, 310)) == [0, 100, 200, 300, 400]


def test_every_point_stands_at_its_step_and_the_band_is_its_interval():
    table = rows().assign(run="a")
    axes = {each.get_title(): each for each in trajectory.draw(table).axes}["largest eigenvalue"]
    (line,) = [x for x in axes.lines if x.get_linestyle() == "-"]
    measured = table[table["state"] != "skipped"]
    assert list(np.asarray(line.get_xdata())) == list(measured["step"])
    corners = np.asarray(axes.collections[0].get_paths()[0].vertices)
    assert corners[:, 1].min() == pytest.approx(1.9) and corners[:, 1].max() == pytest.approx(4.1)


def test_the_legend_says_what_is_open_and_what_an_arrow_is():
    figure = trajectory.draw(rows(1e-4).assign(run="a"))
    said = ["a", "open: the number is negative", "arrow: at least so large", UNITS]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == said
    positive = rows().assign(run="a")
    for name in ("lambda_min", "trace_means", "trace_quats"):
        positive[name] = positive[name].abs()
    positive["participation_ratio_high"] = 2 * positive["participation_ratio"]
    assert [text.get_text() for text in trajectory.draw(positive).legends[0].get_texts()] == ["a", UNITS]


def test_the_command_prints_first_and_last_values_and_writes_the_files(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    runs = [run(tmp_path / "runs" / "3dgs" / "0"), run(tmp_path / "runs" / "stablegs" / "0", 3.0)]
    assert main(["trajectory", *map(str, runs)]) == 0
    said = capsys.readouterr().out
    out = tmp_path / "runs" / "trajectory"
    assert (out / "trajectories.png").is_file()
    assert list(pd.read_csv(out / "trajectories.csv")["run"].unique()) == ["3dgs/0", "stablegs/0"]
    lines = [line.split() for line in said.splitlines()]
    assert ["3dgs/0", "(1", "skipped)", "step", "1,000", "(whole)", "step", "2,000", "(whole)"] in lines
    assert ["largest", "eigenvalue", "2.00", "±", "0.10", "4.00", "±", "0.10"] in lines
    place = lines.index(["eigenvalue", "ratio*", "−4.00", "−16.0"]) + 1
    assert said.count("* the ratio rests on eigenvalues that no renders have confirmed") == 1
    assert lines[place] == ["−4.40", "to", "−3.60", "−17.6", "to", "−14.4"]
    assert ["participation", "ratio", "≥", "10.0", "≥", "20.0"] in lines  # of which nothing else is certain


def test_an_exact_trace_that_round_off_may_have_made_is_printed_as_zero():
    table = rows().iloc[[1, 3]].assign(run="a")
    table["trace_means"], table["trace_means_error"] = [-1e-9, 1e-9], [0.0, 1e-10]
    columns = [[*column.cells] for column in first_and_last(table).columns]
    first, last = (column[columns[0].index("trace of position")] for column in columns[1:])
    assert first == "0" and str(last).startswith("(1.0")  # which has an error, by which it is not 0


def test_a_figures_script_given_something_else_says_what_it_expects(tmp_path):
    command = [sys.executable, "-m", "figures.trajectory", str(tmp_path)]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1
    assert ended.stderr.startswith("expected the table trajectories.csv as written by")


def test_a_run_without_records_or_named_twice_is_refused_with_what_to_do(tmp_path, capsys):
    kept = run(tmp_path / "kept")
    (tmp_path / "bare").mkdir()
    run(tmp_path / "blind")
    rows()[:1].assign(note="no Gaussian touches a pixel").to_csv(tmp_path / "blind" / "trajectory.csv", index=False)
    (run(tmp_path / "empty") / "trajectory.csv").write_text("")
    for runs, told in (
        ([kept, tmp_path / "bare"], f"landscape train SCENE --out {tmp_path / 'bare-along'} --probe-every 500"),
        ([kept, kept], "every run once"),
        ([kept, tmp_path / "gone"], f"{tmp_path / 'gone'} does not exist"),
        ([tmp_path / "blind"], "got 1 skipped (no Gaussian touches a pixel)"),
        ([tmp_path / "empty"], f"in {tmp_path / 'empty' / 'trajectory.csv'}, got"),
    ):
        assert main(["trajectory", *map(str, runs)]) == 2
        said = capsys.readouterr().err
        assert said.startswith("landscape: expected") and told in said
    table = gathered([kept])
    with pytest.raises(ValueError, match="expected at least one record"):
        trajectory.draw(pd.DataFrame(table[table["state"] == "skipped"]))
