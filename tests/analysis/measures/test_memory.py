"""How many vectors fit, and what a command says where memory runs out."""

from pathlib import Path

import pytest
import torch

from analysis.commands.cli import main
from analysis.measures import memory
from analysis.measures.memory import GIB, expected_peak, needs_of, size_of, vectors_within
from landscape.errors import InputError, TooLittleMemory
from splat.backend.memory import SLACK, free_memory, resident_memory, staying_within
from splat.curvature.linearize import LinearizedView
from splat.curvature.objective import SceneObjective
from splat.render.forward import rasterize_view
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene

ROOT = Path(__file__).parents[3]
MADE = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=64, height=48))


@pytest.fixture
def objective() -> SceneObjective:
    return SceneObjective(MADE.truth, MADE.scene.load())


def free(monkeypatch, amount: float) -> None:
    monkeypatch.setattr(memory, "free_memory", lambda _: int(amount))


def test_vectors_are_those_of_the_budget_and_of_half_of_what_is_free(objective, monkeypatch):
    each = objective.active.flat.numel() * 4
    free(monkeypatch, 100 * each)
    assert vectors_within(objective, 1.0) == 50 and vectors_within(objective, 10 * each / GIB) == 10


def test_what_a_view_takes_is_foreseen_from_its_raster(objective):
    kept, active, views = objective.linearized, objective.active, objective.views
    rasters = [rasterize_view(active, view.camera, objective.background, objective.settings) for view in views]
    view, workspace, _ = max(LinearizedView.size_of(raster, active, objective.settings) for raster in rasters)
    assert needs_of(objective)[0] == view and 0.7 < view / kept.first.bytes < 1.5
    assert 0.7 < workspace / kept.first.workspace(1) < 1.5


def test_less_memory_keeps_fewer_views_and_too_little_is_refused(objective, monkeypatch):
    (view, beside), used = needs_of(objective), resident_memory()
    assert view + beside < expected_peak(objective) - used < 3 * view + beside + 2**24
    few = SceneObjective(objective.active, objective.views, memory=view)
    assert few.linearized.kept == 1 and objective.linearized.kept == 2
    free(monkeypatch, view)
    with pytest.raises(TooLittleMemory, match=r"expected at least [\d.]+ [MG]B .* got .*; [\d.]+ [kM]B more would fit"):
        expected_peak(objective)
    with staying_within(1), pytest.raises(TooLittleMemory, match=r"; --memory [\d.]+GB would fit"):
        expected_peak(objective)


def test_a_process_stays_within_what_it_was_told():
    cpu, mib = torch.device("cpu"), 2**20
    room = int((resident_memory() + 50 * mib) / (1 - SLACK))
    with staying_within(room):
        assert 0 < free_memory(cpu) <= 50 * mib
    with staying_within(int((1 - SLACK) * room)):  # a part of what is asked for is for what is not counted
        assert free_memory(cpu) < (50 - 0.5 * SLACK * 50) * mib
    assert free_memory(cpu) > 60 * mib


@pytest.mark.parametrize("text", ["8", "much", "-1GB", "GB"])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(InputError, match="such as 8GB"):
        size_of(text)


def test_a_probe_whose_memory_runs_out_ends_with_a_sentence_and_leaves_no_record(tmp_path, monkeypatch, capsys):
    made = synthetic_scene(SyntheticSettings(gaussians=60, views=5, width=200, height=150))
    write_transforms_scene(made.scene, tmp_path / "scene")
    assert main(["train", str(tmp_path / "scene"), "--out", str(tmp_path / "run"), "--iterations", "1"]) == 0

    def short(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr("analysis.probe.command.measure", short)
    assert main(["probe", str(tmp_path / "run/checkpoint.pt"), "--quick"]) == 71
    said = " ".join(capsys.readouterr().err.split())
    assert "landscape: memory ran out; take fewer Gaussians" in said and "Traceback" not in said
    assert not (tmp_path / "run/probe-quick").exists()
