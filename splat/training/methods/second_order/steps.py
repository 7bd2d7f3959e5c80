"""A step of second order on all views at once, held to true renders (Levenberg 1944, Marquardt 1963).

    L(theta + S y) ~ L - b.y + y.A y / 2      A = S P H P S, b = -S P grad L, H that of all views (`damped_blocks.py`)
    y              solves (A + lambda) y = b, in a method's own way
    ratio          fall of L in renders / fall of the model; lambda falls where it is high and rises where it is low

A step after which L is not lower is not taken: it is halved up to HALVINGS times, then lambda rises and y is solved for anew.
Quaternions move at right angles to themselves and are brought to unit length, which changes no render.  What no view sees stays
as it is, and so does what has neither slope nor curvature.

In place of the L1 loss, whose second derivative is 0, L has its smooth form, Charbonnier's (`loss.eps`).  Each step is of all
views, so that the seed makes no difference but to a start or a background that is random.
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
from splat.scenes.view import View
from splat.training.densify import DensifySettings
from splat.training.loop import with_background
from splat.training.methods.second_order.damped_blocks import DampedBlocks
from splat.training.state import Method, MethodSettings, Step, TrainConfig, Training

GOOD, POOR = 0.75, 0.25  # ratios beyond which lambda changes
FALLS, RISES = 1 / 3, 4.0
HALVINGS, TRIES = 2, 6
LEAST, MOST = 1e-6, 1e6  # of lambda
ROUNDOFF = 1e-7  # of L: a smaller fall cannot be told from the rounding of the renders


@dataclass(frozen=True)
class SecondOrder(MethodSettings):
    """damping: the first lambda; floor: see `damped_blocks.py`.  curvature: H's Gauss-Newton part, or H whole.

    coupling: False leaves out SSIM's coupling of pixels from H and its blocks, as published methods do.
    """

    damping: Positive = 1.0
    floor: NonNegative = 1.0
    curvature: Literal["gauss-newton", "hessian"] = "gauss-newton"
    coupling: bool = True
    ITERATIONS: ClassVar[int] = 50

    def density_control(self, config: TrainConfig) -> DensifySettings:
        """None: the Gaussians stay those of the start."""
        return replace(config.densify, enabled=False)


@dataclass(frozen=True, eq=False)
class Proposal:
    """y, the fall of L that the model predicts, and whether negative curvature was met on the way."""

    y: Float[Tensor, " p"]
    fall: float
    negative: bool = False


class Local:
    """The model of L at the Gaussians of a step.  mask: which of these the views see; each: parameters of one."""

    def __init__(self, objective: SceneObjective, settings: SecondOrder):
        self.objective, self.mask, gauss_newton = objective, objective.mask, settings.curvature == "gauss-newton"
        self.each = len(objective.active.flat) // len(objective.active)
        self.loss = sum(view.value for view in objective.linearized) / len(objective.views)
        blocks = objective.block_diagonal(gauss_newton=gauss_newton, approximate=not settings.coupling, traced=False)
        self.metric = DampedBlocks(objective.active, blocks, settings.floor)
        H = SceneHessian(objective, gauss_newton=gauss_newton, keep_null=True, coupled=settings.coupling)
        self.A = CountingOperator(ScaledOperator(ProjectedOperator(H, self.metric.project), self.metric.scale))
        coupled = settings.coupling and objective.couples_pixels
        # of a view: who is seen, forward, backward, blocks
        self.passes = len(objective.views) * (5 if coupled else 4)
        self.b = -self.metric.scale * self.metric.project(objective.gradient[:, None])[:, 0]

    def loss_at(self, gaussians: Gaussians) -> float:
        """L elsewhere; infinite where it cannot be rendered."""
        try:
            return self.objective.loss(gaussians.flat)
        except InputError:  # sizes or colours beyond the renderer's range
            return inf

    def moved(self, y: Float[Tensor, " p"]) -> Gaussians:
        """The Gaussians at y, with unit quaternions."""
        at = self.objective.active
        found = at.with_flat(at.flat + self.metric.scale * y)
        found.quats.div_(found.quats.norm(dim=1, keepdim=True))
        return found

    def in_unknowns(self, change: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
        """y of a change of all stored parameters."""
        seen = Gaussians(change, self.objective.active.sh_degree).select(self.mask).flat
        y = torch.where(self.metric.scale > 0, seen / self.metric.scale, 0.0)
        return self.metric.project(y[:, None])[:, 0]


S = TypeVar("S", bound=SecondOrder)


class SecondOrderMethod(Method[S], Generic[S]):
    """history: a row a step: L before it, lambda, products with A, renders of all views, passes over a view's pixels, and the
    ratio; 0 where no step was taken."""

    def __init__(self, settings: S, seed: int):
        super().__init__(settings, seed)
        self.damping = settings.damping

    def on_start(self, training: Training, views: Sequence[View]) -> None:
        name, config = self.settings.name, training.config
        if config.clamp_image:
            raise InputError(
                f"expected clamp_image=false for {name}, whose Hessian is that of the image before it is clamped"
            )
        if training.gaussians.flat.is_cuda and self.settings.coupling and config.loss.ssim_weight:
            raise InputError(
                f"expected --device cpu for {name}: the exact blocks of a loss with SSIM are made there alone; give it, or "
                "--set coupling=false, or --ssim-weight 0"
            )

    def propose(self, local: Local, damping: float) -> Proposal:
        """A step of the model."""
        raise NotImplementedError

    def taken(self, before: Gaussians, after: Gaussians) -> None:
        """Called after a step, with all Gaussians."""

    def own_step(self, step: Step) -> float:
        config, training = step.config, step.training
        old = config.background_colour(step.background.dtype)
        views = [view.with_image(with_background(view, old, step.background)) for view in step.views]
        loss = replace(config.loss, pixel="charbonnier") if config.loss.pixel == "l1" else config.loss
        local = Local(SceneObjective(step.gaussians, views, loss, step.background, config.render), self.settings)
        moved = self._descend(local, step.number)
        vars(local.objective).pop("linearized", None)  # refers back: would wait for the garbage collector
        if moved is not None:
            after = step.gaussians.with_flat(step.gaussians.flat.clone())
            for name, values in after.attributes.items():
                values[local.mask] = moved.attributes[name]
            self.taken(step.gaussians, after)
            training.gaussians = after
        return local.loss

    def _descend(self, local: Local, number: int) -> Gaussians | None:
        """The Gaussians after the step; None where none lowers L."""
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
        """Change lambda after a step of this ratio, 0 where it was shortened."""
        if ratio < POOR or negative:
            self.damping = min(self.damping * RISES, MOST)
        elif ratio > GOOD:
            self.damping = max(self.damping * FALLS, LEAST)

    def state(self) -> dict[str, Any]:
        return {**super().state(), "damping": self.damping}

    def restore(self, state: dict[str, Any]) -> None:
        super().restore(state)
        self.damping = typed(Positive, state["damping"], "damping")
