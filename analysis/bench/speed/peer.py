"""gsplat's published kernels beside those here: its gradient of the same view, with the loss of the kernels here."""

from collections.abc import Callable
from typing import Any

import torch

from analysis.bench.workloads import Workload
from splat.losses.autograd import view_loss
from splat.scenes.view import View


class MissingPeer(Exception):
    """Lack of anything to compare with, with its reason."""


def gsplat_gradient(workload: Workload, view: View, loss: Any) -> Callable[[], object]:
    """The call, made once to see that it works.  MissingPeer where the package is not installed or does not run."""
    try:
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]
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
