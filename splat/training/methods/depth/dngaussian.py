"""DNGaussian (Li et al., CVPR 2024): depth of the right shape, globally and in every small patch.

    L = L_recon + L(D_hard) + L(D_soft),   L(D) = local_weight E_local(D) + global_weight E_global(D)
    D_hard      depth of the sampled view with every opacity 0.95: only the means have a gradient, so that the nearest
                Gaussians, not a mixture, come to lie at the right place; from step hard_start + 1
    D_soft      depth with the opacities as they are: only they have a gradient; from step soft_start + 1
    E           mean of (N(D) - N(prior))^2 over the pixels where |N(D) - N(prior)| > tolerance, N either of
    N_local     (D - mean_P) / (std_P + 0.01 std)           mean_P, std_P over the patch of a pixel, std over all patches
    N_global    (D - mean_P) / (std_D + 0.01 std)           std_D over the image, a constant to the derivative
    P           square patches side by side from the top left corner; pixels left over at the edges do not count; their
                side is drawn anew for each E, uniform in [smallest_patch, largest_patch], at most the image's

D and prior: see `prior.py`.  Weights, starts, sides and tolerance
are those of the published code for LLFF (Fictionarry/DNGaussian, train_llff.py and scripts/run_llff.sh).  It takes a step of
Adam for each of the three losses, the paper their sum, as here.

Not here: its neural colours, its penalties on shape, scale and opacity, and its smoothness of depth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from landscape.errors import InputError
from splat.model.gaussians import Gaussians
from splat.model.typed import Count, NonNegative
from splat.render.loss_and_gradient import LossAndGradient
from splat.render.render import render_depth
from splat.scenes.view import View
from splat.training.methods.depth.prior import DepthKind, prior, require_maps
from splat.training.state import Method, MethodSettings, Step, TrainConfig, Training

HARD = log(0.95 / 0.05)
EPS = 0.01
Patch = Annotated[int, Meta(ge=2)]


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
        sides = torch.randint(
            settings.smallest_patch, settings.largest_patch + 1, (2,), generator=self.generator
        ).tolist()
        if not rendered.detach().std() > 0:
            return loss
        for side, weight, local in zip(
            sides, (settings.local_weight, settings.global_weight), (True, False), strict=True
        ):
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
