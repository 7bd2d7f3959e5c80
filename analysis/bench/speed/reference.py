"""Double backward through the torch reference renderer, for comparison: in a process of its own, whose memory is its own."""

import resource
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from analysis.bench.speed.meters import GpuMeter
from analysis.bench.workloads import Workload
from analysis.console.drawing import own_pool
from splat.losses.reference import photometric_loss
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
    alone = replace(workload, views=workload.views[:1]).to(torch.device("cpu"))  # a GPU's memory is not passed on
    with own_pool() as pool:
        return pool.submit(_measure, alone, workload.gaussians.flat.device, torch.get_num_threads()).result()


def _measure(workload: Workload, device: torch.device, threads: int) -> ReferenceCost:
    torch.set_num_threads(threads)
    torch.set_default_device(device)
    (view,), theta = workload.views, workload.gaussians.flat.detach().to(device).requires_grad_()
    gaussians, target, background = workload.gaussians.with_flat(theta), view.image.to(theta), workload.background

    def gradient(create_graph: bool) -> torch.Tensor:
        image = render(gaussians, view.camera, background, workload.settings, backend="reference").image
        loss = photometric_loss(image, target, workload.loss)
        return torch.autograd.grad(loss, theta, create_graph=create_graph)[0]

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
