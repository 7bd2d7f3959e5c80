"""What a machine with a GPU is to be asked, in a few minutes: does it agree with the CPU, and how fast is it?

    python -m analysis.gpu_check RUN/checkpoint.pt          both, on the checkpoint's training views
    python -m analysis.gpu_check 500k@1600x1060             the ratios alone, on a synthetic scene of that size

Agreement: relative differences, the GPU's loss, gradient, H v and traces against the CPU's, all in the checkpoint's precision.
Ratios: of one view's gradient in the two modes of summation to that of gsplat, where that package is installed; and of
H v to the gradient, for one vector and for each of eight.  How long a whole probe takes, `landscape probe --device cuda` says.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from analysis.timing import interleaved
from analysis.workloads import Size, Workload, synthetic_workload, workload_of
from landscape.probes import draw_probes
from splat.curvature import SceneHessian, SceneObjective
from splat.device import device_named
from splat.linearize import hold
from splat.losses_cpu import loss_against, view_loss
from splat.raster.functions import project_by_kernel, rasterize_by_kernel
from splat.settings import Sums
from splat.traces import LEAST_SAMPLES, exact_traces

REPETITIONS = 10
MOST_VECTORS = 8


@dataclass(frozen=True)
class Check:
    """A number and what it should not exceed; None: nothing to compare it with."""

    name: str
    value: float | None
    bound: float

    @property
    def holds(self) -> bool | None:
        return None if self.value is None else self.value <= self.bound


def placed(workload: Workload, device: torch.device) -> Workload:
    gaussians = workload.gaussians
    return replace(workload, gaussians=gaussians.with_flat(gaussians.flat.to(device)))


def agreement(workload: Workload, device: torch.device) -> list[Check]:
    """The same numbers on the CPU and on a device, from the same random vectors."""
    found: list[dict[str, Tensor]] = []
    for at in (torch.device("cpu"), device):
        w = placed(workload, at)
        objective = SceneObjective(w.gaussians, w.views, w.loss, w.background, w.settings, keep_unseen=True)
        generator = torch.Generator().manual_seed(0)
        v = draw_probes(objective.active.flat.numel(), 1, generator, objective.active.flat.dtype)
        traces = exact_traces(objective, generator, samples=LEAST_SAMPLES)
        found.append(
            {
                "loss": torch.tensor(objective.loss(objective.active.flat)),
                "gradient": objective.gradient.cpu(),
                "H v": SceneHessian(objective).apply(v),
                **{f"trace of {name}": torch.tensor(trace.value) for name, trace in traces.items()},
            }
        )
    here, there = found
    differences = {name: (there[name] - here[name]).double().norm() / here[name].double().norm() for name in here}
    return [Check(name, float(value), 1e-6 if name == "loss" else 1e-5) for name, value in differences.items()]


def ratios(workload: Workload, device: torch.device, repetitions: int = REPETITIONS) -> list[Check]:
    """Of the first view."""
    w, view = placed(workload, device), workload.views[0]
    camera, background = view.camera, workload.background.to(w.gaussians.flat)
    loss = loss_against(view.image, w.loss, w.gaussians.flat)
    held = hold(w.gaussians, camera, loss, background, w.settings)

    def gradient(sums: Sums) -> None:
        flat = w.gaussians.flat.detach().requires_grad_()
        splats = project_by_kernel(w.gaussians.with_flat(flat), camera, w.settings)
        settings = replace(w.settings, sums=sums)
        image, _ = rasterize_by_kernel(splats, background, camera.width, camera.height, settings)
        torch.autograd.grad(view_loss(image, loss), flat)

    generator = torch.Generator(device).manual_seed(0)
    vectors = draw_probes(w.gaussians.flat.numel(), MOST_VECTORS, generator, w.gaussians.flat.dtype)
    calls: dict[str, Callable[[], object]] = {
        "deterministic": partial(gradient, "ordered"),
        "atomic": partial(gradient, "atomic"),
        "one": partial(held.hvp, vectors[:, :1].contiguous()),
        "eight": partial(held.hvp, vectors),
    }
    if peer := find_spec("gsplat") and _peer(w, view.image.to(w.gaussians.flat), camera, background, loss):
        calls["gsplat"] = peer
    times = {name: time.minimum for name, time in interleaved(_waiting(calls, device), repetitions).items()}
    gsplat = times.get("gsplat")
    return [
        Check("gradient / gsplat's, atomic", gsplat and times["atomic"] / gsplat, 1.2),
        Check("gradient / gsplat's, deterministic", gsplat and times["deterministic"] / gsplat, 1.8),
        Check("H v / gradient, one vector", times["one"] / times["deterministic"], 2.0),
        Check("H v / gradient, each of eight", times["eight"] / times["deterministic"] / MOST_VECTORS, 1.2),
    ]


def _waiting(calls: dict[str, Callable[[], object]], device: torch.device) -> dict[str, Callable[[], object]]:
    """The calls, each with all that it started on the device."""

    def finished(call: Callable[[], object]) -> None:
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    return {name: partial(finished, call) for name, call in calls.items()}


def _peer(workload: Workload, target: Tensor, camera, background: Tensor, loss) -> Callable[[], object]:
    """The same gradient by gsplat's published kernels, with the loss of the kernels here."""
    import gsplat  # pyright: ignore[reportMissingImports]

    gaussians = workload.gaussians
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = camera.rotation, -camera.rotation @ camera.centre
    lens = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])

    def gradient() -> None:
        flat = gaussians.flat.detach().requires_grad_()
        each = gaussians.with_flat(flat).attributes
        image, _, _ = gsplat.rasterization(
            each["means"], each["quats"], each["log_scales"].exp(), each["opacity_logits"].sigmoid(), each["sh"],
            pose.to(target)[None], lens.to(target)[None], camera.width, camera.height, sh_degree=gaussians.sh_degree,
            backgrounds=background[None], packed=False,
        )  # fmt: skip
        torch.autograd.grad(view_loss(image[0].permute(2, 0, 1).contiguous(), loss), flat)

    return gradient


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; 1 where something does not hold."""
    (path,) = sys.argv[1:] if arguments is None else arguments
    device = device_named("cuda")
    if Path(path).exists():
        workload = workload_of(Path(path))
        checks = agreement(workload, device) + ratios(workload, device)
    else:
        workload = synthetic_workload(Size.parse(path))
        checks = ratios(workload, device)
    Console().print(table(workload.name, checks))
    return int(any(check.holds is False for check in checks))


def table(name: str, checks: Sequence[Check]) -> Table:
    result = Table("", "found", "at most", "", title=name)
    words = {None: "gsplat is not installed", True: "holds", False: "[red]does not hold[/red]"}
    for check in checks:
        value = "-" if check.value is None else f"{check.value:.2g}"
        result.add_row(check.name, value, f"{check.bound:g}", words[check.holds])
    return result


if __name__ == "__main__":
    sys.exit(main())
