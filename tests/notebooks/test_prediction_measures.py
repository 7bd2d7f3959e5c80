"""Bars of the study of prediction against toys whose answer is known, and the table that a sweep gives once."""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from analysis.commands.cli import main
from analysis.runs.sweep.sweep_file import read_sweep
from notebooks.prediction import __main__ as command
from notebooks.prediction.measures import coadaptation, ensemble
from splat.curvature.scores.poses import distance
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint
from tests.forks import stand_in
from tests.splat.curvature.scores.test_new_poses import DOUBLE, poses, seeded
from tests.splat.tiny import tiny_gaussians


def test_an_ensemble_is_the_distance_of_the_renders():
    one, *others = (tiny_gaussians(seed=seed, dtype=DOUBLE) for seed in range(3))
    exact = [distance(poses().images(one), poses().images(other)) for other in others]
    found = ensemble(one, others, poses())
    assert found.value == pytest.approx(np.mean(exact), rel=1e-12) and found.error > 0
    assert ensemble(one, [one], poses()).value == 0


def test_coadaptation_is_the_variance_over_all_subsets():
    gaussians, at = tiny_gaussians(6, dtype=DOUBLE), poses(1)
    masks = [torch.tensor(mask, dtype=DOUBLE) for mask in product((0.0, 1.0), repeat=6)]
    exact = float(torch.stack([at.images(gaussians, mask)[0] for mask in masks]).var(dim=0, correction=0).mean())
    found = coadaptation(gaussians, at, seeded(), draws=300)
    assert 0 < found.error < 0.1 * exact
    assert found.value == pytest.approx(exact, abs=3 * found.error)


SWEEP = """
seeds = [0, 1]
views = 2
iterations = 50
save_at_psnr = [1, 99]
[scenes.still]
path = "still"
[methods.a]
method = "3dgs"
"""
ALWAYS = {"scene", "cell", "seed", "at", "reached", "commit", "date", "seconds"}


def rows_of(path: Path) -> list[dict[str, Any]]:
    return pd.read_csv(path, dtype={"at": str}).to_dict("records")


def test_the_table_has_each_row_once_and_is_continued(tmp_path, monkeypatch):
    made = synthetic_scene(SyntheticSettings(gaussians=60, views=10, width=20, height=14))
    write_transforms_scene(made.scene, tmp_path / "still")
    (tmp_path / "sweep.toml").write_text(SWEEP)
    runs, out = tmp_path / "runs", tmp_path / "table.csv"
    stand_in(monkeypatch)
    assert main(["sweep", str(tmp_path / "sweep.toml"), "--out", str(runs), "--jobs", "1", "--only", "still/a/0"]) == 0
    monkeypatch.setattr(command, "LEVELS", (1.0, 99.0))
    measured, paths = command.measured_row, []
    monkeypatch.setattr(command, "measured_row", lambda path: paths.append(path) or measured(path))
    assert command.main([str(runs), "--only", "still/a/0", "--out", str(out)]) == 0
    first = {row["at"]: row for row in rows_of(out)}
    assert {at: row["reached"] for at, row in first.items()} == {"end": True, "1": True, "99": False}
    assert len(paths) == 2 and {name for name, value in first["99"].items() if value == value} == ALWAYS
    for at in ("end", "1"):
        assert {name for name, value in first[at].items() if value != value} == {"ensemble", "ensemble_error"}
        assert first[at]["ensemble_seeds"] == 0
    assert first["end"]["digest"] == load_checkpoint(runs / "still" / "a" / "0" / "checkpoint.pt").state
    assert first["end"]["scene_digest"] == first["1"]["scene_digest"]

    before = out.read_bytes()
    assert command.main([str(runs), "--only", "still/a/0", "--out", str(out)]) == 0
    assert len(paths) == 2 and out.read_bytes() == before
    assert main(["sweep", str(tmp_path / "sweep.toml"), "--out", str(runs), "--jobs", "1"]) == 0
    assert command.main([str(runs), "--out", str(out)]) == 0  # the other seed, and the ensemble of the first
    table = rows_of(out)
    assert len(paths) == 4 and len(table) == 6
    assert all(row["ensemble_seeds"] == 1 and row["ensemble"] > 0 for row in table if row["reached"])
    again = {row["at"]: row for row in table if row["seed"] == 0}
    assert all(again[at][name] == first[at][name] for at in ("end", "1") for name in ("lambda_max", "digest"))

    out.write_text(out.read_text().replace(first["end"]["digest"], "0" * 16))  # as if the training had been made again
    assert command.main([str(runs), "--out", str(out)]) == 0
    made_again = {row["at"]: row for row in rows_of(out) if row["seed"] == 0}["end"]
    assert len(paths) > 4 and all(made_again[key] == again["end"][key] for key in ("digest", "lambda_max", "ensemble"))


def test_the_levels_are_those_of_the_sweep():
    sweep = read_sweep(command.RESULTS.parents[1] / "prediction.toml")
    assert {cell.training.save_at_psnr for cell in sweep.cells} == {command.LEVELS}
