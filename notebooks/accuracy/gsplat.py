"""gsplat's published kernels beside those here: its gradient of the same view, with the loss of the kernels here.

`python -m notebooks.accuracy.gsplat [RUN]` times both on a GPU: milliseconds, and ours over gsplat's with what is asked of it.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from analysis.bench.timing import interleaved, meter_of
from analysis.bench.workloads import Size, ViewBench, Workload, synthetic_workload, workload_of
from analysis.console.failures import program
from splat.backend.device import device_named
from splat.losses.autograd import view_loss
from splat.scenes.view import View

ASKED = {"gradient, atomic": 1.2, "gradient, autograd": 1.8}  # at most of gsplat's time
SIZE, REPETITIONS = Size(100_000, 504, 378), 15


class MissingPeer(Exception):
    """Lack of anything to compare with, with its reason."""


def gsplat_gradient(workload: Workload, view: View, loss: Any) -> Callable[[], object]:
    """The call, made once to see that it works.  MissingPeer where the package is not installed or does not run."""
    try:
        from gsplat import rasterization  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]
    except ImportError as error:
        raise MissingPeer(f"gsplat cannot be imported ({error})") from None
    gaussians, camera = workload.gaussians, view.camera
    like, pose = gaussians.flat.detach(), torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = camera.rotation, -camera.rotation @ camera.centre
    lens = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    poses, lenses, backgrounds = (x.to(like)[None] for x in (pose, lens, workload.background))

    def gradient() -> None:
        flat = like.clone().requires_grad_()
        each = gaussians.with_flat(flat).attributes
        image, _, _ = rasterization(
            each["means"], each["quats"], each["log_scales"].exp(), each["opacity_logits"].sigmoid(), each["sh"],
            poses, lenses, camera.width, camera.height, sh_degree=gaussians.sh_degree, backgrounds=backgrounds,
            packed=False,
        )  # fmt: skip
        torch.autograd.grad(view_loss(image[0].permute(2, 0, 1).contiguous(), loss), flat)

    try:
        gradient()
    except Exception as error:  # what a package raises that cannot find, or build, its kernels is its own
        raise MissingPeer(f"gsplat does not run ({' '.join(str(error).split())[:200]})") from None
    return gradient


def main(arguments: Sequence[str] | None = None) -> int:
    """Time both in turns, and print; returns the exit code: 1 where there is no gsplat to compare with."""
    parser = argparse.ArgumentParser(
        "python -m notebooks.accuracy.gsplat", description="gsplat's gradient beside ours."
    )
    parser.add_argument("run", type=Path, nargs="?", help="RUN/checkpoint.pt; by default a synthetic scene")
    options, device = parser.parse_args(arguments), device_named("cuda")
    bench = ViewBench((workload_of(options.run) if options.run else synthetic_workload(SIZE)).to(device))
    try:
        calls = {"gsplat": gsplat_gradient(bench.workload, bench.view, bench.loss)}
    except MissingPeer as error:
        print(f"nothing to compare with: {error}")
        return 1
    calls |= {name: call for name, call in bench.calls().items() if name in ASKED}
    times = interleaved(calls, REPETITIONS, clock=meter_of(device).seconds)
    for name, time in times.items():
        over = time.minimum / times["gsplat"].minimum
        print(f"{name:20} {1e3 * time.minimum:8.3f} ms  {over:.2f}", f"(asked: {ASKED[name]})" if name in ASKED else "")
    return 0


if __name__ == "__main__":
    program(main)
