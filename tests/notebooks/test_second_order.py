"""Curves of a sweep: loss and scores of every checkpoint that was kept, and the picture of them."""

import pandas as pd
import pytest

from analysis.commands.cli import main
from notebooks.second_order.__main__ import CURVE, CURVES
from notebooks.second_order.__main__ import main as curves
from notebooks.second_order.curves import against
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint
from splat.training.score.evaluate import evaluate
from tests.forks import stand_in

SWEEP = """
seeds = [1]
views = 2
iterations = 4
log_every = 2
checkpoint_every = 2
keep_checkpoints = "all"
ssim_weight = 0.0
[scenes.still]
path = "still"
pixel_loss = "l2"
[scenes.polish]
path = "still"
from = "runs/still/gn-cg/{seed}/checkpoint.pt"
[methods.gn-cg]
[methods.3dgs]
"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("curves")
    made = synthetic_scene(SyntheticSettings(gaussians=60, views=3, width=20, height=14))
    write_transforms_scene(made.scene, folder / "still")
    (folder / "sweep.toml").write_text(SWEEP)
    with pytest.MonkeyPatch.context() as patch:
        stand_in(patch)
        assert main(["sweep", str(folder / "sweep.toml"), "--out", str(folder / "runs"), "--jobs", "1"]) == 0
    assert curves([str(folder / "runs"), "--out", str(folder / "pictures")]) == 0
    return folder / "runs"


def test_a_curve_has_loss_scores_and_passes_of_the_checkpoints(runs):
    run = runs / "still" / "gn-cg" / "1"
    rows, history = (pd.read_csv(run / name).to_dict("list") for name in (CURVE, "history.csv"))
    assert rows["step"] == [2, 4]
    assert rows["passes"] == [sum(history["passes"][:2]), sum(history["passes"])]
    assert rows["loss"][0] == pytest.approx(history["loss"][2], rel=1e-6)  # before the third step
    assert list(pd.read_csv(runs / "still" / "3dgs" / "1" / CURVE)["passes"]) == [4, 8]
    path = run / "step-4" / "checkpoint.pt"
    loaded = load_checkpoint(path)
    held_out, config = loaded.with_scene(path).scene.load(loaded.scene.test), loaded.training.config
    score = evaluate(loaded.training.gaussians, held_out, None, config.render).psnr
    assert rows["held_out"][1] == pytest.approx(score, rel=1e-6)


def test_a_cell_starts_from_the_checkpoint_of_its_seed(runs):
    first, polished = (runs / scene / "gn-cg" / "1" for scene in ("still", "polish"))
    assert f"from {first / 'checkpoint.pt'}" in (polished.parent / "1.log").read_text()
    losses = [pd.read_csv(run / "train.csv").to_dict("list")["loss"][0] for run in (polished, first)]
    assert losses[0] != losses[1]
    whole = pd.read_csv(runs / CURVES)
    assert len(whole) == 8 and set(whole["scene"]) == {"still", "polish"} and set(whole["method"]) == {"gn-cg", "3dgs"}


def test_the_picture_is_drawn_for_every_scene(runs):
    assert {path.name for path in runs.with_name("pictures").iterdir()} == {"polish.png", "still.png"}


def test_the_stored_curves_are_drawn(tmp_path, capsys):
    assert curves(["--out", str(tmp_path), "--against", "adam"]) == 0
    said, files = capsys.readouterr().out, sorted(path.name for path in tmp_path.iterdir())
    assert files and all(file in said for file in files) and "gn-cg" in said


def test_seconds_to_the_loss_of_another_method_are_shares_of_its_own():
    def run(method: str, seed: int, seconds: list[float], losses: list[float]) -> pd.DataFrame:
        return pd.DataFrame({"cpu": seconds, "loss": losses, "held_out": 20.0 + seed}).assign(
            scene="still", method=method, seed=seed
        )

    table = pd.concat(
        [run("adam", 0, [5.0, 10.0], [1e-1, 1e-3]), run("adam", 1, [5.0, 20.0], [1e-1, 1e-2])]
        + [run("fast", 0, [1.0, 3.0], [1e-2, 1e-4]), run("fast", 1, [1.0, 3.0], [1e-1, 2e-2])]
    )
    adam, fast = against(table, "adam").to_dict("records")
    assert (adam["seconds"], adam["seconds_sd"]) == (1.0, 0.0)
    assert (fast["seeds"], fast["reached"]) == (2, 1) and fast["seconds"] == pytest.approx(0.2)
    assert (fast["held_out"], fast["held_out_sd"]) == (20.5, pytest.approx(0.5**0.5))
    with pytest.raises(ValueError, match="'adam', 'fast'"):
        against(table, "sgd")


def test_runs_without_checkpoints_are_refused(tmp_path, capsys):
    assert curves([str(tmp_path)]) == 2
    assert "expected runs that have ended" in capsys.readouterr().err
