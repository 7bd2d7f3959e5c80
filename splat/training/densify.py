"""Adaptive density control of 3DGS (Kerbl et al. 2023, Sec. 5.2, and its published code).

At an interval, after `start` and before `stop`, a Gaussian whose mean screen-space gradient is above the threshold

    is cloned  if its largest scale is at most clone_scale x extent: an exact copy beside it, opacity included;
    is split   if it is larger: replaced by two drawn from it, mean ~ N(mean, R S S R^T), scales / 1.6, all else copied.

With `split_distance`, a Gaussian far from its neighbours is split too, whatever its gradient, as CoR-GS's and FSGS's codes do:

    mean squared distance to the three nearest > split_distance x extent,   largest scale > extent

Then Gaussians that are nearly transparent are removed, and, once opacities have been reset, those larger than
prune_scale x extent.  (The published code is meant to remove Gaussians that are large on screen too, but never does: it zeroes
their radii before the test.)  Opacities are lowered to reset_opacity every `reset_every` steps before `stop`; on a white
background, which the first Gaussians soon imitate, also at the step `start`.

The screen-space gradient is the norm of dL / d(mean) in normalised device coordinates, in which the image is 2 wide and
2 high, averaged over the renders in which the Gaussian's 3-sigma box meets the image.  Splat means (x, y) are in pixels, so
this gradient is (w/2 dL/dx, h/2 dL/dy).  extent: radius of the cameras' bounding sphere, world units.
"""

from dataclasses import dataclass
from math import floor, log
from typing import Annotated

import scipy
import torch
from jaxtyping import Bool, Float, Int
from msgspec import Meta
from torch import Tensor

from landscape.errors import InputError
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.typed import Count, Length, Positive, Settings, Share
from splat.projection.antialias import filter_factor
from splat.projection.reference import Splats, rotation_matrices
from splat.render.backend import backend_of

SPLIT_INTO = 2  # Gaussians
SPLIT_SHRINK = 0.8 * SPLIT_INTO  # divisor of scales
NEIGHBOURS = 3  # in the mean squared distance


@dataclass(frozen=True)
class DensifySettings(Settings):
    """Settings of density control in a run of T steps: after min(start, start_share T), before min(stop, stop_share T).

    The interval is `every`, but at most every_share T.  In the 30,000 steps of 3DGS the shares change nothing; with them short
    runs densify too, and have half of their steps to settle.  While the image does not fit, a round makes 1.6 to 1.7 Gaussians
    of one, 3 steps after the last as 100 steps after it (LLFF's fern): what counts is how many rounds there are, and a run of
    at most 5000 steps has none in its first tenth.

    gradient_threshold: of the mean screen-space gradient, in normalised device coordinates.  clone_scale, prune_scale: in units
    of the extent; None: no Gaussian is removed for its size.  split_distance: in world units, see above; None: none is split
    for its distance.  min_opacity: Gaussians below it are removed.  grow_opacity: only Gaussians above it are cloned, or split
    for their gradient.  reset_opacity: highest opacity after a reset; None: no resets.  first_reset: step of the first reset;
    None: reset_every.
    """

    enabled: bool = True
    start: Count = 500
    stop: Count = 15000
    start_share: Share = 0.25
    stop_share: Share = 0.5
    every: Length = 100
    every_share: Share = 0.05
    gradient_threshold: Positive = 2e-4
    clone_scale: Positive = 0.01
    split_distance: Positive | None = None
    prune_scale: Positive | None = 0.1
    min_opacity: Share = 0.005
    grow_opacity: Share = 0.0
    reset_every: Length = 3000
    first_reset: Length | None = None
    reset_opacity: Annotated[float, Meta(gt=0, lt=1)] | None = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reset_opacity is not None and self.min_opacity >= self.reset_opacity:
            raise InputError(
                "expected min_opacity < reset_opacity (else a reset would remove every Gaussian), "
                f"got {self.min_opacity} and {self.reset_opacity}"
            )

    def collects(self, step: int, iterations: int) -> bool:
        """Whether the screen-space gradient of a step (1, 2, ...) counts: density control is on and has not stopped."""
        return self.enabled and step < min(self.stop, self.stop_share * iterations)

    def begins(self, iterations: int) -> int:
        """The last step before the first in which Gaussians can be cloned, split and removed."""
        return floor(min(self.start, self.start_share * iterations))

    def densifies(self, step: int, iterations: int) -> bool:
        """Whether Gaussians are cloned, split and removed after a step."""
        begun = step > self.begins(iterations)
        interval = max(1, min(self.every, round(self.every_share * iterations)))
        return begun and step % interval == 0 and self.collects(step, iterations)

    def resets_opacity(self, step: int, iterations: int, *, white: bool) -> bool:
        """Whether opacities are lowered after a step; white: whether the background is white."""
        since = step - (self.first_reset or self.reset_every)
        due = (since >= 0 and since % self.reset_every == 0) or (white and step == self.begins(iterations))
        return due and self.reset_opacity is not None and self.collects(step, iterations)

    def prunes_large(self, step: int) -> bool:
        """Whether large Gaussians are removed at a step: only after the first reset of opacities."""
        return self.prune_scale is not None and step > (self.first_reset or self.reset_every)


@dataclass(eq=False)
class ScreenGradients:
    """For each Gaussian, the sum of the norms of screen-space gradients, and the number of renders in it."""

    total: Float[Tensor, " n"]
    renders: Float[Tensor, " n"]

    @classmethod
    def zero(cls, n: int, dtype: torch.dtype, device: torch.device | None = None) -> "ScreenGradients":
        return cls(*(torch.zeros(n, dtype=dtype, device=device) for _ in range(2)))

    def add(self, gradient: Float[Tensor, "n 2"], splats: Splats, camera: Camera) -> None:
        """Add dL / d(splats.means) of one render, per pixel."""
        backend_of(self.total).add_screen_gradients(self.total, self.renders, gradient, splats, camera)

    @property
    def mean(self) -> Float[Tensor, " n"]:
        """Mean norm; 0 for Gaussians in no render."""
        return self.total / self.renders.clamp_min(1)


@dataclass(frozen=True, eq=False)
class Densified:
    """Result of density control.

    gaussians: the new set.  parents: index of the old Gaussian that each comes from.  fresh: which are not kept, but clones or
    draws.
    """

    gaussians: Gaussians
    parents: Int[Tensor, " n"]
    fresh: Bool[Tensor, " n"]


@torch.no_grad()
def densify(
    gaussians: Gaussians,
    gradients: Float[Tensor, " m"],
    extent: float,
    settings: DensifySettings,
    generator: torch.Generator,
    *,
    prune_large: bool,
) -> Densified:
    """Clone, split and prune.  gradients: `ScreenGradients.mean`.  Kept Gaussians come first, in their old order."""
    high = (gradients > settings.gradient_threshold) & (gaussians.opacity_logits.sigmoid() > settings.grow_opacity)
    largest = gaussians.log_scales.amax(dim=1)
    small = largest <= log(settings.clone_scale * extent)
    divide = high & ~small
    if settings.split_distance is not None:
        squared = neighbours(gaussians, NEIGHBOURS)[0].square().mean(dim=1)
        divide |= (squared > settings.split_distance * extent) & (largest > log(extent))
    keep, clone, split = (mask.nonzero()[:, 0] for mask in (~divide, high & small & ~divide, divide))
    parents = torch.cat([keep, clone, split.repeat_interleave(SPLIT_INTO)])
    result = gaussians.select(parents)
    fresh = torch.arange(len(parents), device=parents.device) >= len(keep)
    draw_from_parents(result, len(keep) + len(clone), generator)

    remain = result.opacity_logits.sigmoid() >= settings.min_opacity
    if prune_large:
        assert settings.prune_scale is not None
        remain &= result.log_scales.amax(dim=1) <= log(settings.prune_scale * extent)
    return Densified(result.select(remain), parents[remain], fresh[remain])


def neighbours(gaussians: Gaussians, count: int) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """Distances from each mean to the nearest others, world units, and their indices.  k: min(count, n - 1)."""
    means = gaussians.means.cpu().double().numpy()
    wanted = list(range(2, min(count, len(means) - 1) + 2))  # the nearest is the Gaussian itself
    found = scipy.spatial.KDTree(means).query(means, k=wanted)
    distances, nearest = (torch.as_tensor(each).to(gaussians.flat.device) for each in found)
    return distances, nearest


def draw_from_parents(gaussians: Gaussians, start: int, generator: torch.Generator) -> None:
    """Replace the copies from `start` on, in place, by draws from the Gaussians they copy, with scales / 1.6."""
    means, log_scales = gaussians.means[start:], gaussians.log_scales[start:]
    noise = torch.randn(means.shape, dtype=means.dtype, generator=generator).to(means.device) * log_scales.exp()
    means += (rotation_matrices(gaussians.quats[start:]) @ noise[:, :, None])[:, :, 0]
    log_scales -= log(SPLIT_SHRINK)


@torch.no_grad()
def reset_opacities(gaussians: Gaussians, opacity: float) -> None:
    """Lower every opacity to at most this, in place; with a 3-D filter, the filtered opacity, as in Mip-Splatting."""
    if gaussians.filter_widths is None:
        gaussians.opacity_logits.clamp_max_(log(opacity / (1 - opacity)))
        return
    highest = torch.logit((opacity / filter_factor(gaussians)).clamp_max(1.0))  # infinite where no opacity is above it
    gaussians.opacity_logits.copy_(torch.minimum(gaussians.opacity_logits, highest))
