"""What the cells of a sweep came to: which numbers are averaged and compared, and how they are shown."""

import io
import json
import math
import shutil
from pathlib import Path

import pandas as pd
import pytest
import torch
from rich.console import Console

from analysis.records.quantities import PLUS_MINUS
from analysis.runs.sweep.sweep_file import Cell
from analysis.runs.sweep.sweep_results import REASONS, results, summarize, tables, unfinished, with_ratios
from analysis.train.options import TrainOptions
from analysis.train.progress import TrainingTime
from splat.training.loop import StepResult
from tests.recorded import soft, synthetic, written


def test_an_index_of_which_only_a_bound_is_known_is_not_averaged(tmp_path):
    data, arrays = synthetic()
    data["anisotropy"]["eigenvalue_ratio"] = {"value": 7.0, "low": 34.2, "high": None, "note": "not resolved"}
    cell = Cell("still", "3dgs", TrainOptions(Path("still"), out=tmp_path / "0"))
    written(cell.out / "probe", data, arrays)
    (cell.out / "metrics.json").write_text(json.dumps({"test": {}, "train": {}, "gaussians": 9}))
    rows = results([cell], {cell.name: "done"})
    assert rows.iloc[0]["eigenvalue_ratio_low"] == 34.2 and rows.iloc[0]["negative_ratio"] == pytest.approx(220 / 3.1e4)
    summary = summarize(rows)
    assert summary["negative_ratio_n"].item() == 1 and summary["eigenvalue_ratio_n"].item() == 0


def test_searches_that_ran_out_are_said_with_their_cells(tmp_path):
    data, arrays = synthetic()  # the smallest eigenvalue's ended at its time
    cells = [Cell("still", "3dgs", TrainOptions(Path("still"), out=tmp_path / str(i), seed=i)) for i in range(3)]
    for cell, reason in zip(cells, ("tolerance", "noise floor", None), strict=True):
        data["eigenvalues"]["max"]["reason"] = reason
        written(cell.out / "probe", data, arrays)
        (cell.out / "metrics.json").write_text(json.dumps({"test": {}, "train": {}, "gaussians": 9}))
    shutil.rmtree(cells[2].out / "probe")
    rows = results(cells, {cell.name: "done" for cell in cells})
    assert rows["lambda_min_reason"].tolist()[:2] == ["matvec budget"] * 2
    assert rows["lambda_max_reason"].tolist()[:2] == ["tolerance", "noise floor"]
    (line,) = unfinished(rows)
    assert line.startswith(
        "still/3dgs/0, still/3dgs/1: The search for the smallest eigenvalue ended at its matvec budget"
    )
    assert "lambda_min_n" in summarize(rows) and not [name for name in summarize(rows) if "reason" in name]
    assert unfinished(rows.drop(columns=list(REASONS))) == []


def test_mean_deviation_and_ratio_are_taken_over_the_seeds_of_a_method():
    rows = pd.DataFrame(
        {
            "scene": ["a", "a", "a", "a", "b"],
            "method": ["x", "y", "x", "y", "x"],
            "seed": [0, 0, 1, 1, 0],
            "status": "done",
            "psnr": [10.0, 20.0, 13.0, None, 7.0],
        }
    )
    summary = summarize(rows)
    assert summary[["scene", "method"]].values.tolist() == [["a", "x"], ["a", "y"], ["b", "x"]]
    assert summary["psnr_mean"].tolist() == [11.5, 20.0, 7.0] and summary["psnr_n"].tolist() == [2, 1, 1]
    assert summary["psnr_std"].tolist()[0] == pytest.approx(4.5**0.5)
    assert summary["psnr_std"].isna().tolist()[1:] == [True] * 2
    (table,) = tables(summary)
    assert [list(column.cells) for column in table.columns][3] == [f"11.50{PLUS_MINUS}2.12", "20.00", "7.00"]


def test_processor_times_are_compared_with_the_first_method_of_the_same_seed():
    rows = pd.DataFrame({"scene": "a", "method": ["x", "y", "z"] * 2, "seed": [0, 0, 0, 1, 1, 1]})
    rows = with_ratios(rows.assign(cpu_seconds=[9.0, 18.0, 27.0, 4.0, 2.0, math.nan]))
    assert rows["cpu_ratio"].tolist()[:5] == [1.0, 2.0, 3.0, 1.0, 0.5] and math.isnan(rows["cpu_ratio"].iloc[5])
    assert "cpu_ratio" not in with_ratios(rows.filter(["scene", "method", "seed"]))


def test_a_training_continued_with_other_threads_has_none_of_its_own(monkeypatch):
    spent = TrainingTime(0, 0.0, 0.0)
    for threads, said in ((2, 2), (2, 2), (3, None), (3, None)):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        list(spent.timed([StepResult(spent.step + 1, 0.5, 9, "view")]))
        assert spent.threads == said


def test_peak_memory_is_kept_and_never_falls(tmp_path):
    spent = TrainingTime(0, 0.0, 0.0)
    spent.write(tmp_path)
    held = TrainingTime.read(tmp_path).peak
    assert held is not None and 2**26 < held < 2**40  # bytes of a process with torch, not their 1024th part
    TrainingTime(0, 0.0, 0.0, peak=2**50).write(tmp_path)
    assert TrainingTime.read(tmp_path).peak == 2**50


def test_no_cell_of_the_tables_is_wrapped_or_cut_in_80_columns():
    names = ["psnr", "ssim", "lpips", "avge", "gaussians", "cpu_ratio", "trace_means", "trace_sh", "lambda_max"]
    sizes = {"psnr": 20.0, "ssim": 0.6, "lpips": 0.3, "avge": 0.1, "cpu_ratio": 3.4}
    parts = (("mean", 1.0), ("std", 0.7), ("n", 3))
    row = {
        f"{name}_{what}": value * (1 if what == "n" else sizes.get(name, 45000.0))
        for name in names
        for what, value in parts
    }
    summary = pd.DataFrame([{"scene": "garden", "method": "attribute-probes", **row}])
    printed = io.StringIO()
    for table in tables(summary):
        Console(width=80, file=printed).print(table)
    text = soft(printed.getvalue())
    assert max(map(len, text.splitlines())) <= 80 and "…" not in text
    lines = [line for line in text.splitlines() if "garden" in line]
    assert sum(line.count(" ± ") for line in lines) == len(names) == text.count(" ± ") - text.count("mean ± standard")
