"""FSGS (Zhu et al., ECCV 2024): new Gaussians between distant neighbours, and depth that correlates with a prior.

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
    D, prior    see `prior.py`; for disparity m the better of -m and 1 / (m + 200), as in the published code
                (200: for MiDaS's numbers; of maps in [0, 1] the two are the same)

with late_depth_weight after `depth_until`.  depth_weight 0 leaves the unpooling alone, and needs no depth maps.

Not here: the same term at pseudo-views, whose prior is a monocular network's answer to the rendered image.  Splitting by the
score, which only the code does, is `densify.split_distance`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splat.model.gaussians import Gaussians
from splat.model.typed import Count, Length, NonNegative, Positive
from splat.render.loss_and_gradient import LossAndGradient
from splat.render.render import render_depth
from splat.scenes.view import View
from splat.training.densify import Densified, neighbours
from splat.training.methods.depth.prior import DepthKind, prior, require_maps
from splat.training.state import Method, MethodSettings, Step, TrainConfig, Training

MIDAS = 200.0


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
        weight = settings.depth_weight and (
            settings.depth_weight if step.number <= settings.depth_until else settings.late_depth_weight
        )
        if not weight:
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
