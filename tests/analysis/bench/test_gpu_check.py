"""The checks for a machine with a GPU, at toy size: without one, by `tests.ptx`."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rich.console import Console

pytest.importorskip("triton", reason="the kernels for GPUs need triton")

from analysis.bench.gpu_check import (
    PARTS,
    Check,
    _with_other_last_bits,
    agreement,
    in_turn,
    main,
    probe,
    recordings,
    training,
)
from analysis.bench.speed.meters import HostMeter
from analysis.bench.workloads import Workload
from splat.backend.gpu.graphs import CudaGraphCache
from splat.curvature.hessian import SceneHessian
from splat.losses.reference import LossSettings
from splat.scenes.synthetic import SyntheticSettings
from tests.splat.held_scenes import two_views
from tests.splat.random_scenes import random_gaussians
from tests.splat.tiny import tiny_gaussians, tiny_views


def toy(dtype: torch.dtype = torch.float32) -> Workload:
    """For a machine without a GPU: one tile, and a loss without SSIM."""
    gaussians = random_gaussians(4, 0, logit=1.0, spread=0.4).to(dtype)
    return Workload("toy", gaussians, tuple(two_views(16, 12)[:1]), torch.zeros(3), LossSettings("charbonnier", 0.0))


def last_emulated(device, monkeypatch, runs: int) -> None:
    """Without a GPU the last of so many runs is that of the GPU's kernels."""
    if device.type == "cpu":
        emulated = iter([False] * (runs - 1) + [True])

        def stay(workload: Workload, at: torch.device) -> Workload:
            monkeypatch.setattr("splat.backend.device.EMULATED", next(emulated))
            return workload

        monkeypatch.setattr(Workload, "to", stay)


def test_a_device_agrees_with_the_cpu(device, monkeypatch):
    last_emulated(device, monkeypatch, 2)
    checks = agreement(toy(torch.float64), device)  # in single precision so few Gaussians' traces cancel
    assert [check.name for check in checks][:3] == ["loss", "gradient", "H v"] and len(checks) == 8
    assert all(check.verdict == "holds" for check in checks), checks
    assert [check.bound for check in checks] == [1e-10] + [1e-9] * 7


def test_what_the_last_bits_change_on_the_cpu_is_no_disagreement(device, monkeypatch):
    last_emulated(device, monkeypatch, 3)
    moved = []

    def twice_as_dense(workload: Workload, seed: int) -> Workload:
        moved.append(seed)
        gaussians = workload.gaussians.with_flat(workload.gaussians.flat.clone())
        gaussians.opacity_logits.add_(0.1)
        return replace(workload, gaussians=gaussians)

    monkeypatch.setattr("analysis.bench.gpu_check._with_other_last_bits", twice_as_dense)
    checks = agreement(toy(torch.float64), device, neighbours=1)
    assert moved == [0] and all(1e-3 < check.bound < 10 for check in checks), checks


def test_other_last_bits_are_those_next_to_them():
    workload = toy()
    logits = workload.gaussians.opacity_logits.clone()
    moved = [_with_other_last_bits(workload, seed).gaussians.opacity_logits for seed in range(8)]
    assert torch.equal(workload.gaussians.opacity_logits, logits)
    steps = torch.stack(moved) - logits
    assert (steps != 0).all() and steps.abs().max() <= torch.finfo(logits.dtype).eps * logits.abs().max()
    assert (steps > 0).any() and (steps < 0).any()


def test_a_trained_scene_is_compared_in_both_precisions(monkeypatch):
    monkeypatch.setattr("analysis.bench.gpu_check.workload_of", lambda path: toy())

    def stand_in(workload, device, neighbours=0):
        return [Check(f"{workload.gaussians.flat.dtype} {neighbours}", 0.0, 1.0)]

    monkeypatch.setattr("analysis.bench.gpu_check.agreement", stand_in)
    found = PARTS["checkpoint"][1](torch.device("cpu"), Path("checkpoint.pt"))
    assert [check.name for check in found] == ["torch.float64 0, float64", "torch.float32 3, float32"]


@pytest.mark.parametrize("off", [0.0, 1.0])
def test_recorded_products_are_held_against_launched_ones(off, monkeypatch):
    def capture(call):
        result = call()
        return result, lambda: result.copy_(call() + off)

    monkeypatch.setattr(SceneHessian, "recordable", lambda self, vectors: vectors == 8)
    monkeypatch.setattr(SceneHessian, "_recordings", CudaGraphCache(capture))
    alone, difference, ratio = recordings(toy(), HostMeter())
    assert alone.value is None and alone.reason == "not recorded here"
    assert difference.name == "H v 8, recorded - launched" and difference.value == pytest.approx(off, rel=1e-4)
    assert difference.fails == (off != 0) and ratio.value is not None and ratio.value > 0


def test_a_training_is_timed_at_its_pace():
    views = tuple(tiny_views())
    (check,) = training(Workload("tiny", tiny_gaussians(sh_degree=1), views, torch.zeros(3)), torch.device("cpu"), 1, 2)
    assert check.value is not None and check.value > 0 and check.bound == 13 and "12 Gaussians, 3 views" in check.name


def test_a_probe_is_timed_from_its_checkpoint_on(monkeypatch):
    monkeypatch.setattr("analysis.console.recording.draw", lambda module, target, *options: [])
    settings = SyntheticSettings(60, 4, 16, 12)
    code, seconds = probe(settings, torch.device("cpu"), quick=True, seconds=0.1, slice_points=5)
    assert code == Check("exit code", 0, 0) and seconds.value is not None and 0 < seconds.value < 600


def test_a_part_that_fails_or_hangs_leaves_the_others_as_they_are(tmp_path):
    checks = [{"name": "loss", "value": 1e-7, "bound": 1e-6, "reason": None}]
    say = f"import sys; open(sys.argv[-1], 'w').write({json.dumps(checks)!r})"
    commands = {
        "crash": (60.0, [sys.executable, "-c", "import os; os._exit(3)"]),
        "hang": (0.5, [sys.executable, "-c", "import time; time.sleep(60)"]),
        "silent": (60.0, [sys.executable, "-c", ""]),
        "good": (60.0, [sys.executable, "-c", say]),
    }
    console = Console(width=100, record=True)
    found = in_turn(commands, tmp_path / "found.json", console)
    assert {name: not checks[0].fails for name, checks in found.items()} == {
        "crash": False, "hang": False, "silent": False, "good": True,
    }  # fmt: skip
    assert found["good"] == [Check("loss", 1e-7, 1e-6)]
    text = console.export_text()
    assert "failed with exit code 3" in text and "not done in 0 s" in text and "holds" in text
    written = json.loads((tmp_path / "found.json").read_text())
    assert list(written) == list(commands) and written["good"] == checks


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_the_checks_are_refused_in_one_sentence(capsys):
    assert main([]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(r"gpu_check: expected an NVIDIA GPU for the device cuda, got .*; ", line)
