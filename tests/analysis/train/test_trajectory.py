"""The landscape along a training: what is recorded, what it costs, and that the training does not notice."""

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch

from analysis.commands.cli import main
from analysis.train import command
from analysis.train.trajectory import COLUMNS, LEAST, Trajectory, TrajectorySettings, measure
from landscape import extreme_eigenpairs
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.model.gaussians import ATTRIBUTES
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint, save_checkpoint

STEPS, EVERY = 40, 10
TIMES = ["seconds", "time_share"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trajectory") / "still"
    settings = SyntheticSettings(gaussians=60, views=5, width=16, height=12)
    write_transforms_scene(synthetic_scene(settings).scene, folder)
    return folder


def arguments(scene: Path, out: str, *more: str) -> list[str]:
    run = ["--views", "3", "--iterations", str(STEPS), "--checkpoint-every", "10", "--sh-degree", "0"]
    return ["train", str(scene), "--out", str(scene.parent / out), *run, *more]


def probed(scene: Path, out: str, *more: str) -> list[str]:
    return arguments(scene, out, "--probe-every", str(EVERY), "--probe-share", "inf", *more)


def rows(run: Path) -> pd.DataFrame:
    return pd.read_csv(run / "trajectory.csv")


@pytest.fixture(scope="module")
def run(scene) -> Path:
    assert main(probed(scene, "run")) == 0
    return scene.parent / "run"


@pytest.fixture(scope="module")
def at_the_end(run) -> tuple:
    """(training, views, objective) of the finished run."""
    path = run / "checkpoint.pt"
    loaded = load_checkpoint(path)
    views = loaded.load_scene(path).load(loaded.scene.train)
    config = loaded.training.config
    objective = SceneObjective(loaded.training.gaussians, views, config.loss, torch.zeros(3), config.render)
    return loaded.training, views, objective


def test_probing_changes_no_bit_of_the_training(scene, run):
    assert main(arguments(scene, "plain")) == 0
    assert (run / "checkpoint.pt").read_bytes() == (scene.parent / "plain" / "checkpoint.pt").read_bytes()
    assert not (scene.parent / "plain" / "trajectory.csv").exists()


def test_a_row_is_written_every_so_many_steps_with_every_column(run):
    table = rows(run)
    assert tuple(table) == COLUMNS
    assert list(table["step"]) == list(range(EVERY, STEPS + 1, EVERY))
    assert set(table["state"]) == {"whole"}
    assert table["gaussians"].iloc[-1] == len(load_checkpoint(run / "checkpoint.pt").training.gaussians)
    assert sorted(path.name for path in run.glob("*trajectory*")) == ["trajectory.csv"]


def test_the_last_row_is_that_of_the_checkpoint(run, at_the_end, tmp_path):
    training, views, _ = at_the_end
    trajectory = Trajectory(tmp_path, training, views, TrajectorySettings(EVERY, float("inf")))
    trajectory.after_step(1.0)
    written, (again,) = rows(run).iloc[-1], trajectory.rows
    assert {key: again[key] for key in again if key not in (*TIMES, "note")} == {
        key: written[key] for key in again if key not in (*TIMES, "note")
    }


def test_the_search_for_the_ends_begins_at_the_directions_of_single_gaussians(at_the_end, monkeypatch):
    _, _, objective = at_the_end
    starts = []

    def noted(operator, generator, settings, start):
        starts.append(start)
        return extreme_eigenpairs(operator, generator, settings, start)

    monkeypatch.setattr("analysis.train.trajectory.extreme_eigenpairs", noted)
    measure(objective, torch.Generator().manual_seed(0), TrajectorySettings(EVERY))
    assert torch.equal(starts[0], BlockEigenvectors(objective, *objective.approximate_blocks).warm_start())


def test_a_row_is_the_landscape_within_its_errors(at_the_end, tmp_path):
    training, views, objective = at_the_end
    few = replace(training, gaussians=training.gaussians.select(objective.mask.nonzero()[:15, 0]))
    trajectory = Trajectory(tmp_path, few, views, TrajectorySettings(EVERY, float("inf")))
    trajectory.after_step(1.0)
    (row,) = trajectory.rows
    config = training.config
    objective = SceneObjective(few.gaussians, views, config.loss, torch.zeros(3), config.render)
    hessian = SceneHessian(objective)
    H = hessian.apply(torch.eye(hessian.dim)).double()
    values = torch.linalg.eigvalsh((H + H.T) / 2)
    rounding = hessian.dim * torch.finfo(torch.float32).eps * float(values.abs().max())
    for name, value in {"lambda_max": values[-1], "lambda_min": values[0]}.items():
        assert abs(row[name] - float(value)) <= row[f"{name}_error"] + rounding
    for name in ATTRIBUTES:
        block = objective.blocks[name]
        exact = float(H[block, block].trace())
        assert abs(row[f"trace_{name}"] - exact) <= 4 * row[f"trace_{name}_error"] + rounding
    known = {"literal": values[-1] / values[0], "saddle": -values[-1] / values[0]}
    known |= {"share": values[-1] / values.abs().sum()}
    for index, value in known.items():
        assert row[f"{index}_low"] - 1e-6 <= float(value) <= row[f"{index}_high"] + 1e-6, index


def test_the_start_is_kept_and_finds_its_scene(run):
    path = run / "start" / "checkpoint.pt"
    loaded = load_checkpoint(path)
    assert loaded.training.step == 0
    assert (path.parent / loaded.scene.relative).resolve() == loaded.load_scene(path).root.resolve()


def test_a_run_killed_beside_a_checkpoint_and_resumed_gives_the_same_rows(scene, run, monkeypatch):
    class Killed(BaseException):
        """Reported by no handler of errors."""

    def killed(path, training, reference):
        if training.step == 30:
            raise Killed
        save_checkpoint(path, training, reference)

    out = scene.parent / "killed"
    with monkeypatch.context() as patch:
        patch.setattr(command, "save_checkpoint", killed)
        with pytest.raises(Killed):
            main(probed(scene, "killed"))
    assert list(rows(out)["step"]) == [10, 20, 30]  # the last of them is after the checkpoint, of step 20
    assert main(probed(scene, "killed", "--resume")) == 0
    pd.testing.assert_frame_equal(rows(out).drop(columns=TIMES), rows(run).drop(columns=TIMES), check_exact=True)
    assert (out / "checkpoint.pt").read_bytes() == (run / "checkpoint.pt").read_bytes()


def test_what_does_not_fit_is_skipped_and_time_that_ends_a_record_is_said(run, at_the_end, tmp_path):
    training, views, _ = at_the_end
    trajectory = Trajectory(tmp_path, training, views, TrajectorySettings(EVERY, 0.1))
    assert trajectory.skipped == ""
    trajectory.after_step(1e-3)
    (row,) = trajectory.rows
    assert trajectory.skipped.startswith("1 of 1 records of the landscape were skipped (no time: ")
    assert trajectory.skipped.endswith("0.0001 s were allowed); --probe-share inf sets no limit to their time")
    assert (
        row["state"] == "skipped"
        and row["seconds"] == row["time_share"] == 0
        and "0.0001 s were allowed" in row["note"]
    )
    trajectory.least = 0.0, 1
    trajectory.after_step(1e-3)
    row = trajectory.rows[-1]
    assert row["state"] == "cut" and row["note"].startswith("out of time: ") and "lambda_min" in row["note"]
    assert row["lambda_min_reason"] == "time budget" and row["time_share"] == row["seconds"] / 1e-3
    trajectory.after_step(1e-3)  # the budget is overdrawn now, whatever a record takes
    assert trajectory.rows[-1]["state"] == "skipped"
    trajectory.after_step(1e6)
    assert trajectory.rows[-1]["state"] == "whole"
    assert list(rows(tmp_path)["state"]) == ["skipped", "cut", "skipped", "whole"]
    counts = pd.read_csv(tmp_path / "trajectory.csv", dtype=str)["visible_gaussians"]
    assert counts.iloc[-1].isdigit()  # beside rows that have none


def warnings(scene, capsys, name: str) -> list[str]:
    """What a training whose records do not fit says about them."""
    assert main([*arguments(scene, name), "--probe-every", str(EVERY), "--probe-share", "1e-9"]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "skipped" in line]
    assert all("--probe-share inf" in line for line in said)
    count = len(rows(scene.parent / name))
    assert said[-1].startswith(f"{count} of {count} records of the landscape were skipped")
    return said[:-1]


def test_a_training_says_beforehand_that_no_record_will_fit_and_counts_them_at_the_end(scene, capsys):
    (before,) = warnings(scene, capsys, "hopeless")
    assert before.startswith("every record of the landscape will be skipped: at a share of 1e-09")


def test_a_training_warns_of_the_first_record_that_it_skips(scene, capsys, monkeypatch):
    monkeypatch.setattr(Trajectory, "hopeless", "")  # one that may fit, as far as is known
    (after,) = warnings(scene, capsys, "short")
    assert after.startswith(f"after step {EVERY}: 1 of 1 records")


def test_it_is_known_beforehand_from_which_step_on_a_record_may_fit(at_the_end, tmp_path):
    training, views, _ = at_the_end
    for share, sure in ((LEAST * len(views) / training.config.iterations, False), (1e-3, True), (float("inf"), False)):
        trajectory = Trajectory(tmp_path / f"{share}", training, views, TrajectorySettings(EVERY, share))
        assert bool(trajectory.hopeless) == sure


@pytest.mark.parametrize(("option", "value"), [("--probe-every", "0"), ("--probe-share", "0")])
def test_options_out_of_range_are_refused(scene, tmp_path, capsys, option, value):
    assert main([*arguments(scene, "refused", "--probe-every", "5"), option, value]) == 2
    assert f"expected {option[2:].replace('-', '_')}" in capsys.readouterr().err
    assert not (scene.parent / "refused").exists()
