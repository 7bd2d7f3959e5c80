"""The table of a foreign training is one that `landscape trajectory` reads."""

import pandas as pd
import torch

from analysis.runs.trajectories import gathered
from landscape import EigenSettings, Monitor
from tests.landscape.foreign import Bumps
from tests.refusals import refused


def test_a_training_is_recorded_and_read(tmp_path):
    bumps, made = Bumps(), []
    monitor = Monitor(tmp_path / "run", every=10, samples=8, eigen=EigenSettings(rtol=0.1, max_matvecs=20))

    def operator():
        made.append(1)
        return bumps.hessian()

    assert [step for step in range(1, 31) if monitor(step, operator)] == [10, 20, 30] and len(made) == 3
    table = gathered([tmp_path / "run"])
    assert list(table["step"]) == [10, 20, 30] and set(table["state"]) == {"coarse"} and set(table["gaussians"]) == {6}
    dense = bumps.exact().apply(torch.eye(24, dtype=torch.float64))
    assert (abs(table["lambda_max"] - float(torch.linalg.eigvalsh(dense)[-1])) <= table["lambda_max_error"]).all()
    assert (table["trace_places_low"].to_numpy() < table["trace_places"].to_numpy()).all()
    assert not table["trace_means"].notna().to_numpy().any()  # there is no such block


def test_a_refused_operator_is_a_note_and_the_training_goes_on(tmp_path):
    monitor, bumps = Monitor(tmp_path, every=1), Bumps(change=lambda image: image / 0)
    assert monitor(1, bumps.hessian)
    row = pd.read_csv(tmp_path / "trajectory.csv").iloc[0]
    assert row["state"] == "skipped" and "expected a finite image of view 0" in row["note"]


def test_a_second_training_in_one_folder_and_no_steps_are_refused(tmp_path):
    Monitor(tmp_path, every=1)(1, Bumps(change=lambda image: image / 0).hessian)
    refused("folder without a trajectory", Monitor, tmp_path)
    refused("every 0 steps", Monitor, tmp_path / "other", every=0)
