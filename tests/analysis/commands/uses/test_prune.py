"""`landscape prune`: what is kept, what the files hold, and that a curve goes on where it was stopped."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.stats import spearmanr

from analysis.commands.cli import main
from analysis.commands.uses import prune
from splat.curvature.scores.removal import SCORES
from splat.model.files.read import read_splats
from splat.model.files.splat_ply import splat_ply
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint
from splat.training.score.evaluate import evaluate

MADE = synthetic_scene(SyntheticSettings(gaussians=50, views=5, width=24, height=16))
QUICK = ("--curve", "--sample", "6")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Gaussians, one of them opaque and out of sight, with the scene that they were trained on."""
    folder = tmp_path_factory.mktemp("pruned")
    write_transforms_scene(MADE.scene, folder / "scene")
    unseen = MADE.truth.select(torch.tensor([*range(len(MADE.truth)), 0]))
    unseen.means[-1], unseen.opacity_logits[-1] = torch.tensor([0.0, 0.0, -50.0]), 5.0
    (folder / "in.ply").write_bytes(splat_ply(unseen, tool="splat-landscape"))
    return folder


def run(folder: Path, *words: str) -> int:
    return main(["prune", str(folder / "in.ply"), "--scene", str(folder / "scene"), "--views", "3", *words])


@pytest.fixture(scope="module")
def curved(folder) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prune, "STEPS", 2)
        assert run(folder, *QUICK, "--keep", "0.4", "--score", "opacity") == 0
    return folder / "prune"


def test_the_highest_scores_are_kept_in_both_files(curved, folder):
    before, table = read_splats(folder / "in.ply").gaussians, pd.read_csv(curved / "scores.csv")
    chosen = np.sort(table.sort_values("opacity", ascending=False).gaussian[: round(0.4 * len(before))])
    assert len(before) - 1 not in chosen  # opaque, but no view sees it
    expected = before.select(torch.from_numpy(chosen))
    written = read_splats(curved / "pruned.ply")
    assert written.width == 24  # of the pictures that it was trained on
    assert torch.equal(written.gaussians.flat, expected.flat) and written.tool == "splat-landscape"
    loaded = load_checkpoint(curved / "checkpoint.pt")
    assert torch.equal(loaded.training.gaussians.flat, expected.flat)
    assert loaded.with_scene(curved / "checkpoint.pt").scene.root == (folder / "scene").resolve()


def test_the_curve_scores_what_is_left(curved):
    curve, loaded = pd.read_csv(curved / "curve.csv"), load_checkpoint(curved / "checkpoint.pt")
    assert {*curve.score} == {*SCORES} and len(curve) == len(SCORES) * (len(prune.REMOVED) + 3 * len(prune.REFINED))
    lost = prune.lost(curve, 0.9, 2, "train_psnr")
    assert lost.shape == (3, len(SCORES)) and len({*lost["opacity"]}) == 3  # seeds
    path, views = curved / "checkpoint.pt", loaded.scene
    kept = evaluate(loaded.training.gaussians, loaded.with_scene(path).scene.load(views.test))
    row = curve[(curve.score == "opacity") & (curve.removed == 0.6) & (curve.steps == 0)].iloc[0]
    assert row.test_psnr == pytest.approx(kept.psnr, abs=1e-4) and row.test_ssim == pytest.approx(kept.ssim, abs=1e-6)
    assert curve[curve.removed == 0].train_psnr.nunique() == 1
    assert (curved / "curve.png").stat().st_size > 10_000


def test_scores_are_compared_with_true_removals(curved):
    table, ranks = pd.read_csv(curved / "scores.csv"), pd.read_csv(curved / "correlations.csv", index_col=0)
    assert table.error.notna().sum() == 6
    true = spearmanr(table["error"], table["removal_error"], nan_policy="omit")[0]
    assert ranks.loc["error", "removal_error"] == pytest.approx(true)


def test_refinement_lowers_the_training_loss_and_what_was_assumed_is_said(folder, tmp_path, capsys):
    assert run(folder, "--sample", "3", "--keep", "0.3", "--out", str(tmp_path / "out")) == 0
    assert "trained by splat-landscape" in capsys.readouterr().err
    loaded = load_checkpoint(tmp_path / "out" / "checkpoint.pt")
    views, psnr = loaded.with_scene(tmp_path / "out" / "checkpoint.pt").scene.load(loaded.scene.train), []
    for steps in (0, 20):
        if steps:
            prune.refine(loaded.training, views, steps, 0)
        psnr.append(evaluate(loaded.training.gaussians, views).psnr)
    assert psnr[1] > psnr[0] + 0.1


def test_a_curve_that_is_stopped_goes_on(folder, curved, tmp_path, monkeypatch):
    whole, calls = prune.refine, []

    def refined(*arguments):
        calls.append(arguments)
        if len(calls) == 20:
            raise KeyboardInterrupt
        whole(*arguments)

    monkeypatch.setattr(prune, "refine", refined)
    monkeypatch.setattr(prune, "STEPS", 2)
    monkeypatch.setattr(prune, "draw", lambda *_: [])
    words = [*QUICK, "--out", str(tmp_path / "out")]
    assert run(folder, *words) == 130 and not (tmp_path / "out").exists()
    assert run(folder, *words) == 0
    every = len(SCORES) * prune.SEEDS * len(prune.REFINED)
    assert len(calls) == every + 2  # of the fourth score, which was under way
    assert (tmp_path / "out" / "curve.csv").read_text() == (curved / "curve.csv").read_text()
    assert not (tmp_path / ".out.unfinished").exists()


@pytest.mark.parametrize("words", [("--keep", "0"), ("--score", "opacty"), ("--sample", "1")])
def test_what_cannot_be_is_refused_alone(folder, words, capsys):
    assert run(folder, *words) == 2
    sentence = capsys.readouterr().err
    assert f"expected {words[0]} " in sentence


def test_a_share_in_percent_is_said(folder, capsys):
    assert run(folder, "--keep", "50") == 2
    assert "got 50; for 50% say --keep 0.5" in " ".join(capsys.readouterr().err.split())
