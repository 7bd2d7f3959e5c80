"""The methods that are supervised by depth maps, which the user provides.

    prior       a map that grows with distance: the user's map for "depth", its negative for "disparity" (MiDaS, DPT)
    rendered    the sum of weight times z over the Gaussians of a pixel, world units, not divided by alpha: as published

Monocular depth is known up to a scale and a shift in every view, so both methods compare shapes, not values.

FSGS (Zhu et al., ECCV 2024): new Gaussians between distant neighbours, and depth that correlates with a prior.

Proximity-guided unpooling, at every densification up to `unpool_until`:

    score(i)    mean distance from Gaussian i to its K nearest neighbours, between the means
    sources     score > threshold * extent,  largest scale > large * extent
    grown       one on each edge from a source to one of its neighbours (the destination): the mean half way, scales and
                opacity of the destination, no rotation (1, 0, 0, 0), SH 0; edges of both directions count

The paper's threshold is 10 in the units of the scene; here it is relative to the scene, as in the published code
(VITA-Group/FSGS, scene/gaussian_model.py).  `released` repeats what else that code does: its score is the mean of the squared
distances; the j-th of the s K edges of s sources runs from source j mod s, not j div K; the step `unpool_until` is left out.

Depth supervision, at every step:

    L = L_recon + depth_weight (1 - corr(D, prior)),   corr Pearson's over the pixels of the sampled view
    D, prior    see above; for disparity m the better of -m and 1 / (m + 200), as in the published code
                (200: for MiDaS's numbers; of maps in [0, 1] the two are the same)

with late_depth_weight after `depth_until`.  depth_weight 0 leaves the unpooling alone, and needs no depth maps.

Not here: the same term at pseudo-views, whose prior is a monocular network's answer to the rendered image.  Splitting by the
score, which only the code does, is `densify.split_distance`.

DNGaussian (Li et al., CVPR 2024): depth of the right shape, globally and in every small patch.

    L = L_recon + L(D_hard) + L(D_soft),   L(D) = local_weight E_local(D) + global_weight E_global(D)
    D_hard      depth of the sampled view with every opacity 0.95: only the means have a gradient, so that the nearest
                Gaussians, not a mixture, come to lie at the right place; from step hard_start + 1
    D_soft      depth with the opacities as they are: only they have a gradient; from step soft_start + 1
    E           mean of (N(D) - N(prior))^2 over the pixels where |N(D) - N(prior)| > tolerance, N either of
    N_local     (D - mean_P) / (std_P + 0.01 std)           mean_P, std_P over the patch of a pixel, std over all patches
    N_global    (D - mean_P) / (std_D + 0.01 std)           std_D over the image, a constant to the derivative
    P           square patches side by side from the top left corner; pixels left over at the edges do not count; their
                side is drawn anew for each E, uniform in [smallest_patch, largest_patch], at most the image's

D and prior: see above.  Weights, starts, sides and tolerance are those of the published code for LLFF (Fictionarry/DNGaussian,
train_llff.py and scripts/run_llff.sh).  It takes a step of Adam for each of the three losses, the paper their sum, as here.

Not here: its neural colours, its penalties on shape, scale and opacity, and its smoothness of depth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log
from pathlib import PurePosixPath
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from landscape.errors import InputError
from splat.model.gaussians import Gaussians
from splat.model.typed import Count, Length, NonNegative, Positive
from splat.render.loss_and_gradient import LossAndGradient
from splat.render.render import render_depth
from splat.scenes.view import View
from splat.training.densify import Densified, neighbours
from splat.training.state import Method, MethodSettings, Step, TrainConfig, Training

DepthKind = Literal["disparity", "depth"]
MIDAS = 200.0
HARD = log(0.95 / 0.05)
EPS = 0.01
Patch = Annotated[int, Meta(ge=2)]


def require_maps(views: Sequence[View], method: str) -> None:
    """InputError unless every view has a depth map."""
    without = [view.name for view in views if view.depth is None]
    if without:
        raise InputError(
            f"expected a depth map of every training view for the method {method}, got none of {without[0]!r} "
            f"({len(without)} of {len(views)} have none); save it as {PurePosixPath(without[0]).stem}.npy in a folder, and "
            "give that with --depths"
        )


def prior(view: View, kind: DepthKind, like: Tensor) -> Float[Tensor, "h w"]:
    """The view's map in the dtype of another tensor, larger for farther."""
    assert view.depth is not None
    return view.depth.to(like) * (1 if kind == "depth" else -1)


@dataclass(frozen=True)
class FSGS(MethodSettings):
    """neighbours: K; threshold, large: in units of the scene's extent; unpool_until, depth_until: steps.

    depths: what the depth maps hold, "disparity" (larger is nearer) or "depth" (larger is farther).
    released: unpool as the published code does.
    """

    name: Literal["fsgs"] = "fsgs"
    neighbours: Length = 3
    threshold: Positive = 5.0
    large: NonNegative = 1.0
    unpool_until: Count = 2000
    depth_weight: NonNegative = 0.05
    late_depth_weight: NonNegative = 0.001
    depth_until: Count = 9500
    depths: DepthKind = "disparity"
    released: bool = False

    def create(self, seed: int) -> Method:
        return FSGSMethod(self, seed)

    def parts(self, config: TrainConfig) -> dict[str, int]:
        begins = config.densify.begins(config.iterations)
        unpooling = {"densify.start": begins} if config.densify.enabled and self.unpool_until > begins else {}
        return unpooling | ({"depth_weight": 0} if self.depth_weight else {})


class FSGSMethod(Method[FSGS]):
    """history: how many Gaussians each unpooling grew."""

    def on_start(self, training: Training, views: Sequence[View]) -> None:
        if self.settings.depth_weight:
            require_maps(views, self.settings.name)

    def gradient(self, step: Step, base: LossAndGradient) -> LossAndGradient:
        settings = self.settings
        weight = settings.depth_weight if step.number <= settings.depth_until else settings.late_depth_weight
        if not (weight and settings.depth_weight):
            return base
        flat = step.gaussians.flat.detach().requires_grad_()
        rendered, _alpha = render_depth(step.gaussians.with_flat(flat), step.camera, step.config.render)
        if rendered.min() == rendered.max():  # nothing is seen
            return base
        loss = depth_loss(rendered, step.views[step.chosen], settings.depths)
        return replace(base, gradient=base.gradient + weight * torch.autograd.grad(loss, flat)[0])

    def after_step(self, step: Step) -> None:
        settings, training = self.settings, step.training
        if step.number > settings.unpool_until - settings.released:
            return
        schedule = step.config.method.density_control(step.config)
        if schedule.densifies(step.number, step.config.iterations):
            change = unpool(training.gaussians, training.extent, settings)
            grown = int(change.fresh.sum())
            self.history.append({"step": step.number, "grown": grown})
            if grown:
                training.replace_gaussians(change)


def depth_loss(rendered: Float[Tensor, "h w"], view: View, kind: DepthKind) -> Float[Tensor, ""]:
    """1 - the correlation of a rendered depth with the view's map."""
    farther = prior(view, kind, rendered)
    correlation = pearson(rendered, farther)
    if kind == "disparity" and bool((MIDAS - farther > 0).all()):
        correlation = torch.maximum(correlation, pearson(rendered, 1 / (MIDAS - farther)))
    return 1 - correlation


def pearson(x: Tensor, y: Tensor) -> Float[Tensor, ""]:
    """Pearson's correlation of two maps that are not constant.

    >>> ramp = torch.arange(4.0)
    >>> round(pearson(ramp, 3 - 2 * ramp).item(), 6)
    -1.0
    """
    x, y = x - x.mean(), y - y.mean()
    return (x / x.norm() * (y / y.norm())).sum()


@torch.no_grad()
def unpool(gaussians: Gaussians, extent: float, settings: FSGS) -> Densified:
    """The Gaussians, which stay first and in their order, with new ones on the edges of the sources."""
    n, device = len(gaussians), gaussians.flat.device
    k = min(settings.neighbours, n - 1)
    everyone = torch.arange(n, device=device)
    source = destination = everyone[:0]
    if k:
        distances, nearest = neighbours(gaussians, k)
        scores = (distances.square() if settings.released else distances).mean(dim=1)
        wide = scores > settings.threshold * extent
        wide &= gaussians.log_scales.exp().amax(dim=1) > settings.large * extent
        source = everyone[wide].repeat(k) if settings.released else everyone[wide].repeat_interleave(k)
        destination = nearest[wide].reshape(-1)
    parents = torch.cat([everyone, destination])
    result = gaussians.select(parents)
    result.means[n:] = (gaussians.means[source] + gaussians.means[destination]) / 2
    result.quats[n:] = torch.tensor([1.0, 0, 0, 0]).to(result.flat)
    result.sh[n:] = 0
    return Densified(result, parents, torch.arange(len(parents), device=device) >= n)


@dataclass(frozen=True)
class DNGaussian(MethodSettings):
    """tolerance: of normalised depth; smallest_patch, largest_patch: px; hard_start, soft_start: steps.

    depths: what the depth maps hold, "disparity" (larger is nearer) or "depth" (larger is farther).
    """

    name: Literal["dngaussian"] = "dngaussian"
    local_weight: NonNegative = 0.1
    global_weight: NonNegative = 1.0
    tolerance: NonNegative = 2.5e-4
    smallest_patch: Patch = 5
    largest_patch: Patch = 17
    hard_start: Count = 0
    soft_start: Count = 1000
    depths: DepthKind = "disparity"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.local_weight or self.global_weight):
            raise InputError("expected a local_weight or global_weight above 0, got 0 for both")
        if self.smallest_patch > self.largest_patch:
            raise InputError(
                f"expected smallest_patch <= largest_patch, got {self.smallest_patch} and {self.largest_patch}"
            )

    def create(self, seed: int) -> Method:
        return DNGaussianMethod(self, seed)

    def parts(self, config: TrainConfig) -> dict[str, int]:
        return {"hard_start": self.hard_start, "soft_start": self.soft_start}


class DNGaussianMethod(Method[DNGaussian]):
    def on_start(self, training: Training, views: Sequence[View]) -> None:
        require_maps(views, self.settings.name)

    def gradient(self, step: Step, base: LossAndGradient) -> LossAndGradient:
        settings, total = self.settings, base.gradient
        for start, attribute in ((settings.hard_start, "means"), (settings.soft_start, "opacity_logits")):
            if step.number > start:
                total = total + self._depth_gradient(step, attribute)
        return replace(base, gradient=total)

    def _depth_gradient(self, step: Step, attribute: str) -> Float[Tensor, " p"]:
        """The gradient of the hard loss in the means, or of the soft loss in the opacities; 0 in all else."""
        gradient = step.gaussians.with_flat(torch.zeros_like(step.gaussians.flat))
        parts = {name: value.detach() for name, value in step.gaussians.attributes.items()}
        parts["sh"] = parts["sh"][:, :1]  # colours do not matter
        leaf = parts[attribute] = parts[attribute].clone().requires_grad_()
        if attribute == "means":
            parts["opacity_logits"] = torch.full_like(parts["opacity_logits"], HARD)
        gaussians = Gaussians.pack(parts).with_filter(step.gaussians.filter_widths)
        rendered, _alpha = render_depth(gaussians, step.camera, step.config.render)
        target = prior(step.views[step.chosen], self.settings.depths, rendered)
        loss = self._loss(rendered, target)
        if loss.requires_grad:
            gradient.attributes[attribute].copy_(torch.autograd.grad(loss, leaf)[0])
        return gradient.flat

    def _loss(self, rendered: Float[Tensor, "h w"], target: Float[Tensor, "h w"]) -> Float[Tensor, ""]:
        """L(D); constant where nothing is seen."""
        settings, loss = self.settings, rendered.new_zeros(())
        ends = settings.smallest_patch, settings.largest_patch + 1
        sides = torch.randint(*ends, (2,), generator=self.generator).tolist()
        if not rendered.detach().std() > 0:
            return loss
        weights = settings.local_weight, settings.global_weight
        for side, weight, local in zip(sides, weights, (True, False), strict=True):
            if weight:
                side = min(side, *rendered.shape)
                error = (normalised(rendered, side, local=local) - normalised(target, side, local=local)).square()
                beyond = error > settings.tolerance**2
                loss = loss + weight * (error * beyond).sum() / beyond.sum().clamp_min(1)
        return loss


def normalised(depth: Float[Tensor, "h w"], side: int, *, local: bool) -> Float[Tensor, "patches pixels"]:
    """N_local or N_global of a map that is not constant, patch by patch."""
    rows, columns = (size // side for size in depth.shape)
    patches = depth[: rows * side, : columns * side].reshape(rows, side, columns, side)
    patches = patches.transpose(1, 2).reshape(rows * columns, side * side)
    centred = patches - patches.mean(dim=1, keepdim=True)
    spread = _std(centred, 1) if local else depth.detach().std()
    divisor = spread + EPS * _std(patches - patches.mean(), (0, 1))
    return centred / torch.where(divisor > 0, divisor, 1)


def _std(centred: Float[Tensor, "patches pixels"], dims: int | tuple[int, int]) -> Tensor:
    """The standard deviation of values with mean 0; 0, with its derivative, where all are 0."""
    squares = centred.square()
    variance = squares.sum(dim=dims, keepdim=True) / (squares.numel() / squares.sum(dim=dims).numel() - 1)
    return torch.where(variance > 0, variance, 1).sqrt() * (variance > 0)
