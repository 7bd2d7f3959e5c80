"""Levenberg-Marquardt steps on all views at once, accepted only if they lower the rendered loss (Marquardt 1963).

    L(theta + S y) ~ L - b.y + y.A y / 2      A = S P H P S, b = -S P grad L, H that of all views (`damped_blocks.py`)
    y              solves (A + lambda) y = b, as each method does it
    ratio          decrease of L in renders / decrease of the model; lambda falls where it is above GOOD, rises below POOR

A step that does not lower L is halved up to HALVINGS times; then lambda rises and y is solved for again, up to TRIES times.
Quaternions move orthogonally to themselves and are normalised, which changes no render.  Parameters that no view sees, or that
have neither slope nor curvature, stay.

In place of the L1 loss, whose second derivative is 0, L has the smooth one of Charbonnier (`loss.eps`).  As every step is on
all views, the seed matters only to a random start or background.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any, ClassVar, Generic, Literal, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.operators.operator import CountingOperator, ProjectedOperator, ScaledOperator
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.model.gaussians import Gaussians
from splat.model.typed import NonNegative, Positive, typed
from splat.render.backend import backend_of
from splat.scenes.view import View
from splat.training.densify import DensifySettings
from splat.training.loop import with_background
from splat.training.methods.second_order.damped_blocks import DampedBlocks
from splat.training.state import Method, MethodSettings, Step, TrainConfig, Training

GOOD, POOR = 0.75, 0.25  # ratios beyond which lambda changes
FALLS, RISES = 1 / 3, 4.0  # factors of lambda
HALVINGS, TRIES = 2, 6
LEAST, MOST = 1e-6, 1e6  # of lambda
ROUNDOFF = 1e-7  # of L: a smaller decrease is lost in the rounding of renders


@dataclass(frozen=True)
class SecondOrder(MethodSettings):
    """damping: the first lambda; floor: see `damped_blocks.py`.  curvature: which matrix is H, Gauss-Newton or the Hessian.

    ssim_window: False leaves out SSIM's window from H and its blocks, as published methods do.
    """

    damping: Positive = 1.0
    floor: NonNegative = 1.0
    curvature: Literal["gauss-newton", "hessian"] = "gauss-newton"
    ssim_window: bool = True
    ITERATIONS: ClassVar[int] = 50

    def density_control(self, config: TrainConfig) -> DensifySettings:
        """Switched off: the Gaussians stay those of the start."""
        return replace(config.densify, enabled=False)


@dataclass(frozen=True, eq=False)
class Proposal:
    """A step y, the decrease of L that the model predicts, and whether the solver met negative curvature."""

    y: Float[Tensor, " p"]
    fall: float
    negative: bool = False


class LocalModel:
    """The quadratic model of L at the Gaussians of a step.  mask: which of them the views see; each: parameters of one."""

    def __init__(self, objective: SceneObjective, settings: SecondOrder):
        self.objective, self.mask, gauss_newton = objective, objective.mask, settings.curvature == "gauss-newton"
        self.each = len(objective.active.flat) // len(objective.active)
        self.loss = sum(view.value for view in objective.linearized) / len(objective.views)
        blocks = objective.block_diagonal(gauss_newton=gauss_newton, approximate=not settings.ssim_window, traced=False)
        self.metric = DampedBlocks(objective.active, blocks, settings.floor)
        H = SceneHessian(objective, gauss_newton=gauss_newton, keep_null=True, ssim_window=settings.ssim_window)
        self.A = CountingOperator(ScaledOperator(ProjectedOperator(H, self.metric.project), self.metric.scale))
        coupled = settings.ssim_window and objective.couples_pixels
        # for each view: visibility, forward, backward, and one or two for blocks
        self.passes = len(objective.views) * (5 if coupled else 4)
        self.b = -self.metric.scale * self.metric.project(objective.gradient[:, None])[:, 0]

    def loss_at(self, gaussians: Gaussians) -> float:
        """L at other Gaussians; infinite where they cannot be rendered."""
        try:
            return self.objective.loss(gaussians.flat)
        except InputError:  # their sizes or colours are beyond the renderer's range
            return inf

    def moved(self, y: Float[Tensor, " p"]) -> Gaussians:
        """The Gaussians after the step y, with unit quaternions."""
        at = self.objective.active
        found = at.with_flat(at.flat + self.metric.scale * y)
        found.quats.div_(found.quats.norm(dim=1, keepdim=True))
        return found

    def in_unknowns(self, change: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
        """The step y that makes a change of all stored parameters."""
        seen = Gaussians(change, self.objective.active.sh_degree).select(self.mask).flat
        y = torch.where(self.metric.scale > 0, seen / self.metric.scale, 0.0)
        return self.metric.project(y[:, None])[:, 0]


S = TypeVar("S", bound=SecondOrder)


class SecondOrderMethod(Method[S], Generic[S]):
    """A training by such steps; `propose` solves for them.

    history: of each step L before it, lambda, products with A, renders of all views, passes over a view's pixels, and the
    ratio, 0 where no step was taken.
    """

    def __init__(self, settings: S, seed: int):
        super().__init__(settings, seed)
        self.damping = settings.damping

    def on_start(self, training: Training, views: Sequence[View]) -> None:
        name, config = self.settings.name, training.config
        if config.clamp_image:
            raise InputError(
                f"expected clamp_image=false for {name}, whose Hessian is that of the image before it is clamped"
            )
        exact = backend_of(training.gaussians.flat).exact_blocks
        if not exact and self.settings.ssim_window and config.loss.ssim_weight:
            raise InputError(
                f"expected --device cpu for {name}: the exact blocks of a loss with SSIM are made there alone; give it, or "
                "--set ssim_window=false, or --ssim-weight 0"
            )

    def propose(self, local: LocalModel, damping: float) -> Proposal:
        """The step to try."""
        raise NotImplementedError

    def taken(self, before: Gaussians, after: Gaussians) -> None:
        """Hook after an accepted step; before, after: all Gaussians."""

    def own_step(self, step: Step) -> float:
        config, training = step.config, step.training
        old = config.background_colour(step.background.dtype)
        views = [view.with_image(with_background(view, old, step.background)) for view in step.views]
        loss = replace(config.loss, pixel="charbonnier") if config.loss.pixel == "l1" else config.loss
        local = LocalModel(SceneObjective(step.gaussians, views, loss, step.background, config.render), self.settings)
        moved = self._descend(local, step.number)
        # a reference cycle, which would keep its memory until Python looks for cycles
        vars(local.objective).pop("linearized", None)
        if moved is not None:
            after = step.gaussians.with_flat(step.gaussians.flat.clone())
            for name, values in after.attributes.items():
                values[local.mask] = moved.attributes[name]
            self.taken(step.gaussians, after)
            training.gaussians = after
        return local.loss

    def _descend(self, local: LocalModel, number: int) -> Gaussians | None:
        """The Gaussians after the step; None where no step lowers L."""
        row: dict[str, Any] = {"step": number, "loss": local.loss, "damping": self.damping, "ratio": 0.0}
        found, renders = None, 0
        for _ in range(TRIES):
            if found is not None or not local.b.any():
                break
            proposal = self.propose(local, self.damping)
            if not proposal.fall > ROUNDOFF * local.loss:
                break
            for halvings in range(HALVINGS + 1):
                moved = local.moved(0.5**halvings * proposal.y)
                fall, renders = local.loss - local.loss_at(moved), renders + 1
                if fall > 0:
                    found, row["ratio"] = moved, fall / proposal.fall
                    break
            self._adapt(fall / proposal.fall if halvings == 0 else 0.0, proposal.negative)
        products = local.A.matvecs
        passes = local.passes + len(local.objective.views) * (2 * products + renders)
        self.history.append(row | {"products": products, "renders": renders, "passes": passes})
        return found

    def _adapt(self, ratio: float, negative: bool) -> None:
        """Change lambda after a step with this ratio, 0 for a step that was halved."""
        if ratio < POOR or negative:
            self.damping = min(self.damping * RISES, MOST)
        elif ratio > GOOD:
            self.damping = max(self.damping * FALLS, LEAST)

    def state(self) -> dict[str, Any]:
        return {**super().state(), "damping": self.damping}

    def restore(self, state: dict[str, Any]) -> None:
        super().restore(state)
        self.damping = typed(Positive, state["damping"], "damping")
