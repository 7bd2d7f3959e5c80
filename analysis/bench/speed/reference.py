"""Double backward through the torch reference renderer, for comparison: in a process of its own, whose memory is its own."""

import multiprocessing
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from analysis.bench.speed.meters import GpuMeter
from analysis.bench.workloads import Workload
from splat.losses.reference import LossSettings, photometric_loss
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.render import render


@dataclass(frozen=True)
class ReferenceCost:
    """Seconds of a gradient, and of an H v with the graph it needs; peak: bytes that the latter added to the process's, on a
    GPU to those of torch's allocator."""

    gradient: float
    product: float
    peak: int


def reference_cost(workload: Workload) -> ReferenceCost:
    """One gradient and one H v of the first view, where its Gaussians are, with as many threads as here."""
    view, flat = workload.views[0], workload.gaussians.flat
    arrays = (flat.cpu().numpy(), view.image.numpy(), workload.background.numpy())
    settings = (workload.gaussians.sh_degree, view.camera, workload.loss, workload.settings)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(_measure, *arrays, *settings, torch.get_num_threads(), str(flat.device)).result()


def _measure(
    flat: Any,
    image: Any,
    background: Any,
    sh_degree: int,
    camera: Camera,
    loss: LossSettings,
    settings: RenderSettings,
    threads: int,
    device: str,
) -> ReferenceCost:
    torch.set_num_threads(threads)
    torch.set_default_device(device)
    theta, target = torch.from_numpy(flat).to(device).requires_grad_(), torch.from_numpy(image).to(device)

    def gradient(create_graph: bool) -> torch.Tensor:
        gaussians = Gaussians(theta, sh_degree)
        rendered = render(gaussians, camera, torch.from_numpy(background), settings, backend="reference").image
        return torch.autograd.grad(photometric_loss(rendered, target, loss), theta, create_graph=create_graph)[0]

    def product() -> None:
        torch.autograd.grad(gradient(create_graph=True), theta, torch.ones_like(theta))

    if theta.is_cuda:
        meter = GpuMeter(theta.device)
        peak = meter.allocated(product)
        return ReferenceCost(meter.seconds(lambda: gradient(create_graph=False)), meter.seconds(product), peak)
    before, start = _memory()[0], time.perf_counter()
    product()
    peak, middle = _memory()[1] - before, time.perf_counter()
    gradient(create_graph=False)
    return ReferenceCost(time.perf_counter() - middle, middle - start, peak)


def _memory() -> tuple[int, int]:
    """Bytes of memory that this process holds, and the most it has held; where only the latter is known, twice that."""
    status = Path("/proc/self/status")
    if status.is_file():  # Linux, where getrusage counts what the parent held before the start too
        fields = dict(line.split(":", 1) for line in status.read_text().splitlines())
        now, most = (1024 * int(fields[name].split()[0]) for name in ("VmRSS", "VmHWM"))
        return now, most
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return most, most
