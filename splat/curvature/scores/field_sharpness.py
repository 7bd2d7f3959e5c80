"""Sharpness under random smooth fields over space, the same for the two halves of a Gaussian that was split.

phi is a Gaussian random field with 11 independent parts, each of variance 1 and of correlation exp(-r^2 / 2 length^2), by
random Fourier features (Rahimi and Recht 2007).  It moves every Gaussian by its value at the Gaussian's mean:

    displacement (3)   of the mean, px: in units of |mean - centre| / f of the nearest camera
    scale              of all three axes, by exp
    turn (3)           the rotation vector, radians, in the world's axes
    thickness          of the optical thickness -ln(1 - opacity), by exp: that of coincident halves is the sum of theirs
    colour (3)         added to the constant band, in units of the range of a colour

S = E[L(Theta + d phi(mu))] - L(Theta) on the training views, and E |R(Theta + d phi(mu)) - R(Theta)|_1 at new poses, where d
is SIZES.  Each draw is the mean over phi and -phi, in which the slope of L cancels.

No two halves give quite the images of the whole (`analysis/measures/split_control.py`).  Those of all of fern's Gaussians (126
x 94, 2,000 steps) raise the loss itself by 25%; they change S by -12% and the images' change by +7%, of errors of 5% and 1%.
"""

from collections.abc import Mapping, Sequence
from math import pi, sqrt
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.results import Measured
from splat.curvature.objective import SceneObjective
from splat.curvature.scores.poses import Poses, distance
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.harmonics import Y00

FEATURES = 256
PARTS = {"displacement": 3, "scale": 1, "turn": 3, "thickness": 1, "colour": 3}
# alike rises of the loss on fern
SIZES = {"displacement": 0.03, "scale": 0.04, "turn": 0.01, "thickness": 0.1, "colour": 0.01}


class Sharpness(NamedTuple):
    """loss: rise on the training views; images: change at new poses."""

    loss: Measured
    images: Measured


def field_sharpness(
    gaussians: Gaussians,
    objective: SceneObjective,
    new: Poses,
    length: float,
    generator: torch.Generator,
    sizes: Mapping[str, float] = SIZES,
    draws: int = 8,
) -> Sharpness:
    """S at the training views and at new poses.

    gaussians: all; objective: of them, over the training views.  length: of the correlation, world units.  sizes: d of each of
    PARTS.  The error is that of the mean over the draws.
    """
    whole = gaussians.aligned_to(gaussians)
    pixel = pixel_lengths(whole, [view.camera for view in objective.views])
    base, before = objective.loss(objective.active.flat), new.images(whole)
    rises, changes = torch.zeros(2, draws, dtype=torch.float64)
    for i in range(draws):
        phi = smooth_field(whole.means, length, sum(PARTS.values()), generator)
        for sign in (0.5, -0.5):  # each counts half
            moved = step(whole, 2 * sign * phi, pixel, sizes)
            rises[i] += (objective.loss(moved.select(objective.mask).flat) - base) / 2
            changes[i] += distance(new.images(moved), before) / 2
    return Sharpness(Measured.mean(rises), Measured.mean(changes))


def smooth_field(
    points: Float[Tensor, "n 3"], length: float, parts: int, generator: torch.Generator
) -> Float64[Tensor, "n parts"]:
    """phi at points, world units."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    waves, phases = normal(3, FEATURES) / length, 2 * pi * torch.rand(FEATURES, generator=generator).double()
    return sqrt(2 / FEATURES) * (points.double() @ waves + phases).cos() @ normal(FEATURES, parts)


def pixel_lengths(gaussians: Gaussians, cameras: Sequence[Camera]) -> Float64[Tensor, " n"]:
    """The length of a pixel at each Gaussian, world units, for the nearest camera."""
    means = gaussians.means.double()
    return torch.stack([(means - each.centre).norm(dim=1) / each.fx for each in cameras]).amin(dim=0)


def step(
    gaussians: Gaussians, phi: Float64[Tensor, "n 11"], pixel: Float64[Tensor, " n"], sizes: Mapping[str, float]
) -> Gaussians:
    """Theta + d phi(mu) of Gaussians with unit quaternions."""
    part = {name: sizes[name] * each for name, each in zip(PARTS, phi.split([*PARTS.values()], dim=1), strict=True)}
    result = gaussians.with_flat(gaussians.flat.to(torch.float64, copy=True))
    result.means.add_(pixel[:, None] * part["displacement"])
    result.log_scales.add_(part["scale"])
    result.quats.copy_(turned(result.quats, part["turn"]))
    thickness = F.softplus(result.opacity_logits) * part["thickness"][:, 0].exp()
    result.opacity_logits.copy_(thickness + (-torch.expm1(-thickness)).log())  # ln(e^t - 1)
    result.sh[:, 0].add_(part["colour"] / Y00)
    return result.to(gaussians.flat.dtype)


def turned(quats: Float64[Tensor, "n 4"], turn: Float64[Tensor, "n 3"]) -> Float64[Tensor, "n 4"]:
    """Rotations followed by turns, rotation vectors in the world's axes."""
    half = turn / 2
    angle = half.norm(dim=1, keepdim=True)
    w, v = angle.cos(), half * torch.sinc(angle / pi)
    own, axis = quats[:, :1], quats[:, 1:]
    along = (v * axis).sum(dim=1, keepdim=True)
    return torch.cat([w * own - along, w * axis + own * v + torch.linalg.cross(v, axis)], dim=1)
