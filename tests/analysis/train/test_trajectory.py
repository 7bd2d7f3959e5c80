"""The landscape along a training: what is recorded, what it costs, and that the training does not notice."""

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch
from scipy.stats import t as student

from analysis.commands.cli import main
from analysis.train.trajectory import COLUMNS, Trajectory, TrajectorySettings, measure
from landscape import extreme_eigenpairs
from landscape.errors import InputError
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.model.gaussians import ATTRIBUTES
from splat.model.untrusted import read_table
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint
from tests.analysis.train.test_progress import killed_at

STEPS, EVERY = 40, 10
TIMES = ["seconds"]


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
    return arguments(scene, out, "--probe-every", str(EVERY), *more)


def rows(run: Path) -> pd.DataFrame:
    return read_table(run / "trajectory.csv")


@pytest.fixture(scope="module")
def run(scene) -> Path:
    assert main(probed(scene, "run")) == 0
    return scene.parent / "run"


@pytest.fixture(scope="module")
def at_the_end(run) -> tuple:
    """(training, views, objective, reference) of the finished run."""
    path = run / "checkpoint.pt"
    loaded = load_checkpoint(path)
    views = loaded.with_scene(path).scene.load(loaded.scene.train)
    config = loaded.training.config
    objective = SceneObjective(loaded.training.gaussians, views, config.loss, torch.zeros(3), config.render)
    return loaded.training, views, objective, loaded.scene


def test_probing_changes_no_bit_of_the_training(scene, run):
    assert main(arguments(scene, "plain")) == 0
    assert (run / "checkpoint.pt").read_bytes() == (scene.parent / "plain" / "checkpoint.pt").read_bytes()
    assert not (scene.parent / "plain" / "trajectory.csv").exists()


def test_a_row_is_written_every_so_many_steps_with_every_column(run):
    table = rows(run)
    assert tuple(table) == COLUMNS
    assert list(table["step"]) == list(range(0, STEPS + 1, EVERY))
    assert set(table["state"]) == {"whole"}
    assert table["gaussians"].iloc[-1] == len(load_checkpoint(run / "checkpoint.pt").training.gaussians)
    assert sorted(path.name for path in run.glob("*trajectory*")) == ["trajectory.csv"]


def test_the_last_row_is_that_of_the_checkpoint(run, at_the_end, tmp_path):
    training, views, _, reference = at_the_end
    trajectory = Trajectory(tmp_path, training, views, TrajectorySettings(EVERY), reference)
    trajectory.after_step()
    written, (again,) = rows(run).iloc[-1], trajectory.rows
    assert {key: again[key] for key in again if key not in (*TIMES, "note")} == {
        key: written[key] for key in again if key not in (*TIMES, "note")
    }


def test_the_search_for_the_ends_begins_at_the_directions_of_single_gaussians(at_the_end, monkeypatch):
    _, _, objective, _ = at_the_end
    starts = []

    def noted(operator, generator, settings, start):
        starts.append(start)
        return extreme_eigenpairs(operator, generator, settings, start)

    monkeypatch.setattr("analysis.train.trajectory.extreme_eigenpairs", noted)
    measure(objective, torch.Generator().manual_seed(0), TrajectorySettings(EVERY))
    assert torch.equal(starts[0], BlockEigenvectors(objective, objective.exact_blocks).warm_start())


def test_a_row_is_the_landscape_within_its_errors(at_the_end, tmp_path):
    training, views, objective, reference = at_the_end
    few = replace(training, gaussians=training.gaussians.select(objective.mask.nonzero()[:15, 0]))
    trajectory = Trajectory(tmp_path, few, views, TrajectorySettings(EVERY), reference)
    trajectory.after_step()
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
    known = {"eigenvalue_ratio": values[-1] / values[0], "negative_ratio": -values[0] / values[-1]}
    known |= {"top_mass": values[-1] / values.abs().sum()}
    for index, value in known.items():
        assert row[f"{index}_low"] - 1e-6 <= float(value) <= row[f"{index}_high"] + 1e-6, index


def test_the_start_is_kept_and_finds_its_scene(run):
    path = run / "start" / "checkpoint.pt"
    loaded = load_checkpoint(path)
    assert loaded.training.step == 0
    assert (path.parent / loaded.scene.relative).resolve() == loaded.with_scene(path).scene.root.resolve()


def test_a_run_killed_beside_a_checkpoint_and_resumed_gives_the_same_rows(scene, run):
    out = scene.parent / "killed"
    with killed_at(30):
        main(probed(scene, "killed"))
    assert list(rows(out)["step"]) == [0, 10, 20, 30]  # the last of them is after the checkpoint, of step 20
    assert main(probed(scene, "killed", "--resume")) == 0
    pd.testing.assert_frame_equal(rows(out).drop(columns=TIMES), rows(run).drop(columns=TIMES), check_exact=True)
    assert (out / "checkpoint.pt").read_bytes() == (run / "checkpoint.pt").read_bytes()


def test_exact_traces_are_those_that_samples_estimate(at_the_end):
    _, _, objective, _ = at_the_end
    exact, sampled = (
        measure(objective, torch.Generator().manual_seed(0), TrajectorySettings(EVERY, quick)).traces
        for quick in (False, True)
    )
    for name in ATTRIBUTES:
        assert exact[name].reason == "exact" and exact[name].standard_error == 0
        assert exact[name].dim == sampled[name].dim
        surely = float(student.isf(1e-6, sampled[name].probes - 1))  # of one in 500,000 draws it is exceeded
        assert abs(exact[name].value - sampled[name].value) <= surely * sampled[name].standard_error


def test_quick_records_are_all_coarse_and_none_is_left_out(scene):
    assert main(probed(scene, "quick", "--probe-quick")) == 0
    table = rows(scene.parent / "quick")
    assert list(table["step"]) == list(range(0, STEPS + 1, EVERY)) and set(table["state"]) == {"coarse"}
    known = [sum(table[name].notna().tolist()) for name in ("lambda_max", "participation_ratio")]
    assert known == [len(table), 0]


def test_a_record_where_nothing_can_be_measured_says_why_and_whole_numbers_stay_so(at_the_end, tmp_path, monkeypatch):
    training, views, _, reference = at_the_end
    along = Trajectory(tmp_path, training, views, TrajectorySettings(EVERY), reference)
    along.after_step()
    assert along.skipped == ""

    def refused(*_):
        raise InputError("expected Gaussians in sight")

    monkeypatch.setattr("analysis.train.trajectory.measure", refused)
    along.after_step()
    assert along.skipped == "of 2 records of the landscape 1 are empty: expected Gaussians in sight"
    table = pd.read_csv(tmp_path / "trajectory.csv", dtype=str)
    assert list(table["state"]) == ["whole", "skipped"] and table["visible_gaussians"].iloc[0].isdigit()


def test_an_option_out_of_range_is_refused(scene, capsys):
    assert main([*arguments(scene, "refused", "--probe-every", "0")]) == 2
    assert "expected probe_every" in capsys.readouterr().err
    assert not (scene.parent / "refused").exists()
