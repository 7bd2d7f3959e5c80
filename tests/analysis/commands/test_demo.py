"""The demo: a scene, a run and a record, and a second run that leaves the first alone."""

import os
import signal
from contextlib import nullcontext

import pytest
import torch

from analysis.commands.cli import main
from analysis.commands.demo import free_folder
from analysis.records.records import read_record
from splat.render.forward import background_of
from splat.scenes.synthetic import SyntheticSettings
from splat.training.checkpoint import load_checkpoint


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr("analysis.commands.demo.SCENE", SyntheticSettings(gaussians=60, views=5, width=24, height=18))
    monkeypatch.setattr("analysis.commands.demo.ITERATIONS", 12)
    monkeypatch.setattr("analysis.commands.demo.drawing", lambda module: nullcontext(lambda target: []))


def test_the_demo_makes_a_scene_trains_probes_and_says_what_to_open(small, tmp_path, capsys):
    out = tmp_path / "demo"
    assert main(["demo", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert (
        f"next: open the report in a browser; landscape map {out / 'run'}\n" in said
        and str(out / "run" / "probe" / "report.html") in said
    )
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


def test_an_interrupted_demo_is_continued_where_it_was(small, tmp_path, capsys, monkeypatch):
    whole, out, presses, probed = tmp_path / "whole", tmp_path / "demo", [], []
    monkeypatch.setattr("analysis.commands.demo.run_probe", lambda options, *_: probed.append(options.checkpoint) or 0)

    def press(*given):
        presses.append(1)
        if len(presses) == 4:
            os.kill(os.getpid(), signal.SIGINT)
        return background_of(*given)

    def stopped(*_):
        raise KeyboardInterrupt

    assert main(["demo", "--out", str(whole)]) == 0
    for place, by, step in (
        ("synthetic_scene", stopped, None),
        ("splat.render.loss_and_gradient.background_of", press, 4),
        ("run_training", stopped, 4),
        ("run_probe", stopped, 12),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(place if "." in place else f"analysis.commands.demo.{place}", by)
            assert main(["demo", "--out", str(out)]) == 130
        assert step is None or load_checkpoint(out / "run" / "checkpoint.pt").training.step == step
    capsys.readouterr()
    assert main(["demo", "--out", str(out)]) == 0
    assert "$ landscape probe" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["demo", "whole"]
    flat, other = (load_checkpoint(each / "run" / "checkpoint.pt").training.gaussians.flat for each in (out, whole))
    assert torch.equal(flat, other) and probed == [each / "run" / "checkpoint.pt" for each in (whole, out)]


def test_a_free_folder_is_the_first_that_does_not_exist(tmp_path):
    assert free_folder(tmp_path / "demo") == tmp_path / "demo"
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo-2").mkdir()
    assert free_folder(tmp_path / "demo") == tmp_path / "demo-3"
