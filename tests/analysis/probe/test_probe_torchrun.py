"""A probe whose views are shared by processes that torchrun started gives the record of one process."""

import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from analysis.commands.cli import main
from analysis.records.records import read_record
from landscape.operators.distributed import Ranks
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene

ROOT = Path(__file__).parents[3]
TORCHRUN = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "analysis.commands.cli"]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("shared")
    scene, out = folder / "still", folder / "run"
    write_transforms_scene(synthetic_scene(SyntheticSettings(gaussians=60, views=5, width=16, height=12)).scene, scene)
    words = ["--iterations", "30", "--no-densify", "--sh-degree", "1"]
    assert main(["train", str(scene), "--out", str(out), *words]) == 0
    return out / "checkpoint.pt"


def shared(*words: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, *TORCHRUN, *words], env=environment, capture_output=True, text=True)


def test_two_processes_write_the_record_of_one(checkpoint, tmp_path):
    words = ["probe", str(checkpoint), "--quick", "--slice-points", "5"]
    done = shared(*words, "--out", str(tmp_path / "two"))
    assert done.returncode == 0, done.stderr
    assert main([*words, "--out", str(tmp_path / "one")]) == 0
    two, one = (read_record(tmp_path / name) for name in ("two", "one"))
    for name, trace in one.data.traces.items():
        # the order of a sum of views in single precision, of a trace some of whose parts cancel
        scale = 1e-5 * max(abs(each.value) for each in one.data.traces.values())
        assert two.data.traces[name].value == pytest.approx(trace.value, abs=scale), name
        assert two.data.traces[name].probes == trace.probes
    largest = [np.max(record.arrays["spectrum"]["ritz_values"]) for record in (two, one)]
    assert largest[0] == pytest.approx(largest[1], rel=1e-4)
    assert all(check.passed for check in two.data.checks.values())
    assert done.stdout.count("report.html") == 1  # the second process is silent


def test_what_one_process_has_to_hold_is_refused(checkpoint, monkeypatch, capsys):
    """By each process of torchrun, as by one that is told that it is one of two."""
    monkeypatch.setattr("analysis.probe.command.torchrun_ranks", lambda device: nullcontext(Ranks(0, 2)))
    assert main(["probe", str(checkpoint), "--per-attribute"]) == 2
    assert "in one process" in capsys.readouterr().err
