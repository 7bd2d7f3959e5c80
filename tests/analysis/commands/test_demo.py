"""The demo: a scene, a run and a record, and a second run that leaves the first alone."""

import pytest

from analysis.commands.cli import main
from analysis.commands.demo import free_folder
from analysis.records.records import read_record
from splat.scenes.synthetic import SyntheticSettings
from splat.training.checkpoint import load_checkpoint


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr("analysis.commands.demo.SCENE", SyntheticSettings(gaussians=60, views=5, width=24, height=18))
    monkeypatch.setattr("analysis.commands.demo.ITERATIONS", 12)
    monkeypatch.setattr("analysis.console.recording.draw", lambda module, target: [])


def test_the_demo_makes_a_scene_trains_probes_and_says_what_to_open(small, tmp_path, capsys):
    out = tmp_path / "demo"
    assert main(["demo", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "compiles the kernels" in said and str(out / "run" / "probe" / "report.html") in said
    assert f"$ landscape probe {out / 'run' / 'checkpoint.pt'}" in said and "exists" not in said
    assert sorted(path.name for path in out.iterdir()) == ["run", "scene"]
    assert load_checkpoint(out / "run" / "checkpoint.pt").training.step == 12
    before = (out / "run" / "probe" / "probe.json").read_bytes()
    assert main(["demo", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert f"{out} exists, so this run goes to {out}-2" in said and f"{out}-2/run/probe/report.html" in said
    assert (out / "run" / "probe" / "probe.json").read_bytes() == before
    first, second = (read_record(tmp_path / name / "run" / "probe").data for name in ("demo", "demo-2"))
    assert first.counts.gaussians == second.counts.gaussians
    assert first.objective == second.objective


def test_a_free_folder_is_the_first_that_does_not_exist(tmp_path):
    assert free_folder(tmp_path / "demo") == tmp_path / "demo"
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo-2").mkdir()
    assert free_folder(tmp_path / "demo") == tmp_path / "demo-3"
