"""The bench of scenes on the kernels for GPUs, at toy size: without one by Triton's interpreter, with a clock that is given."""

from collections.abc import Callable

import pandas as pd
import pytest
import torch
from rich.console import Console

pytest.importorskip("triton", reason="the kernels for GPUs need triton")

from analysis.bench import command as bench
from analysis.bench.options import BenchOptions
from analysis.bench.timing import Meter, Timing
from analysis.bench.workloads import ViewBench, Workload
from splat.losses.reference import LossSettings
from tests.splat.gpu.interpreted import emulate
from tests.splat.held_scenes import two_views
from tests.splat.random_scenes import random_gaussians
from tests.splat.tolerances import relative_error


def toy() -> Workload:
    """For a machine without a GPU: one tile, and a loss without SSIM."""
    gaussians = random_gaussians(4, 0, logit=1.0, spread=0.4).to(torch.float32)
    return Workload("toy", gaussians, tuple(two_views(16, 12)[:1]), torch.zeros(3), LossSettings("charbonnier", 0.0))


class StillClock(Meter):
    """Every call takes the time that it is given, and as much memory."""

    def __init__(self, device: torch.device):
        self.device = device

    def seconds(self, call: Callable[[], object]) -> float:
        return 0.25

    def allocated(self, call: Callable[[], object]) -> int:
        return 1000


@pytest.fixture
def gpu(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The device, with its kernels for all tensors on it."""
    emulate(monkeypatch, device.type == "cpu")
    return device


def test_a_bench_on_a_gpu_measures_its_kernels_with_the_numbers_of_the_cpu(gpu, monkeypatch, tmp_path):
    made: list[ViewBench] = []
    monkeypatch.setattr(bench, "ViewBench", lambda workload: made.append(ViewBench(workload)) or made[-1])
    monkeypatch.setattr(bench, "synthetic_workload", lambda size: toy())
    monkeypatch.setattr(bench, "interleaved", lambda calls, *_, **__: dict.fromkeys(calls, Timing((0.25,))))
    monkeypatch.setattr(ViewBench, "workspace", lambda self, K, meter: 1000)
    with (tmp_path / "said").open("w") as said:
        options = BenchOptions(out=tmp_path, sizes=("4@16x12",), repetitions=1)
        bench.bench_scenes(options, StillClock(gpu), Console(file=said, width=200))
    (own,) = made
    times, bounds = (pd.read_csv(tmp_path / name) for name in ("bench.csv", "bounds.csv"))
    assert {"gradient, atomic", "H v 8"} <= {*times["stage"]} and "exact blocks" not in {*times["stage"]}
    measured = dict(zip(bounds["what"], bounds["measured"], strict=True))
    assert measured["H v 1 / gradient"] == 1 and measured["H v 8 / gradient"] == 1 / 8
    found = [own.gradient(), own.gradient_by_autograd("atomic"), own.linearized.gradient]
    emulate(monkeypatch, False)
    expected = ViewBench(toy()).gradient()
    assert all(relative_error(gradient.cpu(), expected) < 1e-5 for gradient in found)
