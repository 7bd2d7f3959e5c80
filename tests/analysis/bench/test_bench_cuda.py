"""The bench of scenes on the kernels for GPUs, at toy size: without one by `tests.ptx`, with a clock that is given."""

import sys
from collections.abc import Callable
from types import ModuleType

import numpy as np
import pandas as pd
import pytest
import torch
from rich.console import Console

pytest.importorskip("triton", reason="the kernels for GPUs need triton")

from analysis.bench import command as bench
from analysis.bench.options import BenchOptions
from analysis.bench.speed.meters import HostMeter
from analysis.bench.speed.peer import MissingPeer, gsplat_gradient
from analysis.bench.speed.scene import BYTES, ViewBench
from analysis.bench.speed.timing import Timing
from analysis.bench.workloads import Workload
from splat.losses.reference import LossSettings
from splat.render.backend import backend_of
from tests.splat.gpu.emulated import emulate
from tests.splat.held_scenes import two_views
from tests.splat.random_scenes import random_gaussians, relative_error


def toy() -> Workload:
    """For a machine without a GPU: one tile, and a loss without SSIM."""
    gaussians = random_gaussians(4, 0, logit=1.0, spread=0.4).to(torch.float32)
    return Workload("toy", gaussians, tuple(two_views(16, 12)[:1]), torch.zeros(3), LossSettings("charbonnier", 0.0))


class StillClock(HostMeter):
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


def test_a_bench_on_a_gpu_measures_every_stage_and_names_a_missing_peer(gpu, monkeypatch, tmp_path):
    made: list[ViewBench] = []
    monkeypatch.setattr(bench, "ViewBench", lambda workload: made.append(ViewBench(workload)) or made[-1])
    monkeypatch.setattr(bench, "synthetic_workload", lambda size: toy())
    for ceiling in ("fma_peak", "bandwidth"):
        monkeypatch.setattr(bench, ceiling, lambda meter: 1e9)
    monkeypatch.setattr(bench, "scaling", lambda *given: iter([("gaussians", 4, {"gradient": Timing((1.0,))})]))
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with (tmp_path / "said").open("w") as said:
        options = BenchOptions(out=tmp_path, sizes=("4@16x12",), repetitions=1)
        bench.bench_scenes(options, StillClock(gpu), Console(file=said, width=200))
    (own,), text = made, (tmp_path / "said").read_text()
    times, bounds = (pd.read_csv(tmp_path / name) for name in ("bench.csv", "bounds.csv"))
    stages = times.loc[times["study"] == "stages", "stage"].tolist()
    assert stages[:6] == ["project", "bin", "pack", "forward", "slots", "backward + reduce"] and len(stages) == 21
    assert "no gradient to compare with: gsplat cannot be imported" in text and "GB/s" in text
    measured = dict(zip(bounds["what"], bounds["measured"], strict=True))
    assert measured["H v 1 / gradient"] == 1 and measured["H v 8 / gradient"] == 1 / 8
    assert (
        np.isnan(measured["gradient, atomic / gsplat"])
        and (bounds["holds"] == "not measured").tolist().count(True) == 2
    )

    found = [own.gradient(), own.gradient_by_autograd(), own.gradient_by_autograd("atomic"), own.linearized.gradient]
    emulate(monkeypatch, False)
    expected = ViewBench(toy())
    for gradient in found:
        assert relative_error(gradient.cpu(), expected.gradient()) < 1e-5
    entries = own.raster.intersections_reached
    assert own.raster.pairs == 256 * entries > 0 and own.bytes_of("forward") == 68 * entries + 24 * 16 * 12
    assert BYTES.keys() == bench.OPERATIONS.keys()


def test_gsplat_is_given_the_same_view_and_the_same_loss(monkeypatch):
    workload, seen = toy(), {}

    def rasterization(means, quats, scales, opacities, colours, poses, lenses, width, height, **more):
        seen.update(more, poses=poses, lenses=lenses, size=(width, height), scales=scales)
        return (means.sum() + torch.zeros(1, height, width, 3)), None, {}

    module = ModuleType("gsplat")
    monkeypatch.setattr(module, "rasterization", rasterization, raising=False)
    monkeypatch.setitem(sys.modules, "gsplat", module)
    view = workload.views[0]
    loss = backend_of(workload.gaussians.flat).view_loss(view.image, workload.loss, workload.gaussians.flat)
    gsplat_gradient(workload, view, loss)()
    homogeneous = torch.cat([workload.gaussians.means, torch.ones(4, 1)], dim=1) @ seen["poses"][0].T
    camera = view.camera
    offset = (workload.gaussians.means.double() - camera.centre) @ camera.rotation.double().T
    assert torch.allclose(homogeneous[:, :3].double(), offset, atol=1e-5)
    assert seen["size"] == (16, 12) and seen["lenses"][0, 0, 0] == pytest.approx(camera.fx)
    assert torch.equal(seen["scales"], workload.gaussians.log_scales.exp())

    monkeypatch.setattr(module, "rasterization", lambda *given, **more: 1 / 0)
    with pytest.raises(MissingPeer, match=r"gsplat does not run \(division by zero\)"):
        gsplat_gradient(workload, view, loss)
