"""EWA projection and SH colour: stored parameters of Gaussians -> 2-D splats of one view.  The specification.

Plain torch, any float type, differentiable any number of times; the kernels of `cpu.py` are tested against it.

    x      camera-space centre R (mean - centre), z its depth
    J      2 x 3 Jacobian of the pinhole projection at x (x/z and y/z clamped to fov_clamp tan(fov/2))
    r1 r2  the two rows of J R R(q) diag(exp(log_scales)); the 2-D covariance is r r^T + blur 1
    conic  its inverse [[a, b], [b, c]], in px^-2, with det = |r1 x r2|^2 + blur (|r1|^2 + |r2|^2) + blur^2:
           the textbook a c - b^2 cancels in float32, by 1e-3 at a condition number of 1e4
    colour max(0, 0.5 + sum_k Y_k(direction) sh_k)

Scales and opacities of antialiased Gaussians: `antialias.py`.
"""

from dataclasses import dataclass, fields
from math import log, sqrt

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from landscape.errors import InputError
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.harmonics import harmonics
from splat.model.settings import RenderSettings
from splat.projection.formulas import FACTORS, Lens

NEEDLE = 100.0  # the condition number from which on a splat is called a needle
LARGEST_SPLAT = 2.0**60  # px, and world units: 1 / det of a needle is this squared over blur, which float32 still holds


@dataclass(frozen=True, eq=False)
class Splats:
    """The 2-D footprints of n Gaussians in one view; those in front of the near plane are marked in `drawn`.

    means: px; conics: (a, b, c) of a dx^2 + 2 b dx dy + c dy^2, px^-2; opacities and colours as composited; depths: z.
    Entries of Gaussians that are not drawn are finite and mean nothing.
    """

    means: Float[Tensor, "n 2"]
    conics: Float[Tensor, "n 3"]
    opacities: Float[Tensor, " n"]
    colours: Float[Tensor, "n 3"]
    depths: Float[Tensor, " n"]
    drawn: Bool[Tensor, " n"]

    def detach(self) -> "Splats":
        """The same numbers, off the autograd graph."""
        return Splats(*(getattr(self, each.name).detach() for each in fields(self)))


def rotation_matrices(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices of quaternions w x y z, normalised here."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def project(gaussians: Gaussians, camera: Camera, settings: RenderSettings = RenderSettings()) -> Splats:
    """Project all Gaussians into the camera (Eq. (1), steps 1 and 2 of the splatting pipeline)."""
    means = gaussians.means
    to_camera = camera.rotation.to(means)
    offset = means - camera.centre.to(means)
    x, y, z = (offset @ to_camera.T).unbind(-1)
    drawn = z > settings.near
    z = torch.where(drawn, z, torch.ones_like(z))  # keeps the values of culled Gaussians finite
    limit_x = settings.fov_clamp * camera.width / (2 * camera.fx)
    limit_y = settings.fov_clamp * camera.height / (2 * camera.fy)
    u, v = (x / z).clamp(-limit_x, limit_x), (y / z).clamp(-limit_y, limit_y)

    scales, opacities = gaussians.log_scales.exp(), gaussians.opacity_logits.sigmoid()
    if gaussians.filter_widths is not None:
        wide = (scales.square() + gaussians.filter_widths[:, None].square()).sqrt()
        scales, opacities = wide, opacities * (scales / wide).prod(dim=1)
    axes = to_camera @ rotation_matrices(gaussians.quats) * scales[:, None, :]
    r1 = camera.fx / z[:, None] * (axes[:, 0] - u[:, None] * axes[:, 2])
    r2 = camera.fy / z[:, None] * (axes[:, 1] - v[:, None] * axes[:, 2])
    xx, xy, yy = (r1 * r1).sum(-1), (r1 * r2).sum(-1), (r2 * r2).sum(-1)
    cross = torch.linalg.cross(r1, r2)
    blur = settings.blur
    sharp = (cross * cross).sum(-1)
    det = sharp + blur * (xx + yy) + blur * blur
    opacities = opacities * _compensation(sharp, det, settings)
    conics = torch.stack([(yy + blur) / det, -xy / det, (xx + blur) / det], dim=-1)

    basis = harmonics(offset / offset.norm(dim=-1, keepdim=True), gaussians.sh_degree)
    colours = (0.5 + torch.einsum("nk,nkc->nc", basis, gaussians.sh)).clamp_min(0)
    centres = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=-1)
    return Splats(centres, conics, opacities, colours, z, drawn)


def _compensation(
    sharp: Float[Tensor, " n"], det: Float[Tensor, " n"], settings: RenderSettings
) -> Float[Tensor, " n"] | float:
    """The 2-D filter's factor of opacities, given the covariance's determinant without and with the blur."""
    if settings.antialias == "none":
        return 1.0
    floor, epsilon = FACTORS[settings.antialias]
    squared = sharp / (det + epsilon) + epsilon
    free = (squared > floor) & (sharp > epsilon)
    return torch.where(free, torch.where(free, squared, 1.0).sqrt(), sqrt(floor))


def on_screen(splats: Splats, camera: Camera) -> Bool[Tensor, " n"]:
    """Mask of the Gaussians that are drawn and have a 3-sigma bounding box that meets the image."""
    a, b, c = splats.conics.unbind(-1)
    det = (a * c - b * b).clamp_min(torch.finfo(a.dtype).tiny)  # cancels for needles: the box is then too large
    (x, y), inside = splats.means.unbind(-1), splats.drawn
    for centre, spread, half in ((x, c, camera.width / 2), (y, a, camera.height / 2)):
        inside = inside & ((centre - half).abs() < 3 * (spread / det).sqrt() + half)
    return inside


@torch.no_grad()
def add_screen_gradients(total: Tensor, renders: Tensor, gradient: Tensor, splats: Splats, camera: Camera) -> None:
    """Add what one render gives to `training.densify.ScreenGradients`; gradient: (n, 2), in the splats' means, per px."""
    half_size = torch.tensor([camera.width / 2, camera.height / 2]).to(gradient, non_blocking=True)
    visible = on_screen(splats, camera)
    total += torch.where(visible, (gradient * half_size).norm(dim=1), 0)
    renders += visible


def condition(conics: Float[Tensor, "n 3"]) -> Float64[Tensor, " n"]:
    """The condition number of every splat's covariance, which is that of its conic, with the blur in it.

    >>> condition(torch.tensor([[0.5, 0.0, 2.0], [1.0, 0.0, 1.0]])).tolist()
    [4.0, 1.0]
    """
    a, b, c = conics.double().unbind(-1)
    largest = (a + c) / 2 + ((a - c).square() / 4 + b * b).sqrt()
    kappa = largest.square() / (a * c - b * b)
    return kappa.nan_to_num(nan=torch.inf).abs()  # edge on and infinitely thin


def require_sizes(lens: Lens, log_scales: np.ndarray, depths: np.ndarray, drawn: np.ndarray) -> None:
    """Raise ValueError that names the first Gaussian whose splat is larger than LARGEST_SPLAT, so that no derivative overflows.

    log_scales: (n, 3); depths: (n,), those of the Gaussians drawn beyond near.  Size: the largest scale times focal length / z.
    """
    limit, focal = log(LARGEST_SPLAT), max(lens.fx, lens.fy)
    if not log_scales.size or log_scales.max() + max(log(focal / lens.near), 0.0) <= limit:
        return
    gain = np.log(focal / np.where(drawn, depths, focal))
    sizes = log_scales.max(axis=1) + np.maximum(gain, 0.0)
    bad = drawn & (sizes > limit)
    if bad.any():
        first = int(np.argmax(bad))
        raise InputError(
            f"expected log_scales of at most {limit - max(gain[first], 0.0):.1f} at depth {depths[first]:.3g} (a splat of "
            f"{LARGEST_SPLAT:.0e} px), got {log_scales[first].tolist()} at Gaussian {first} ({int(bad.sum())} of {len(bad)} "
            "are larger); remove them from the checkpoint, or lower its rates"
        )
