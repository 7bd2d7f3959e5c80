"""H v against differences of the gradient, which other code computes, in double precision.

    |H v - P (g(theta + h v) - g(theta - h v)) / (2 h)| / |H v|,   v random

at the first of four steps h that is good enough for the check, else at the best of them.

g is autograd's, in float64, through the torch specification of the projection and the first-order kernels of
compositing and loss; P leaves the quaternions' lengths out, as the operator does.  Splats are composited in the order of
their depths at theta, in the operator's precision, because H is the Hessian at a fixed order.  The steps are tiny, because
the loss has a kink at each zero residual and a jump wherever a splat's alpha falls under its threshold or a pixel stops: few
lie within 1e-11 of a parameter, where float64 still leaves the differences four digits.

Single precision may decide such cases otherwise than double: the order of depths that are equal to round-off, the sign of
a residual near zero, a splat at the threshold.  Where its H v is not close enough to the differences, the check is made of
the operator in float64, and the difference of the two products is reported apart:

    |H32 v - H64 v| / |H64 v|
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from landscape import DerivativeCheck, ProjectedOperator, check_gradient
from landscape.operators.checks import ROUND_OFFS
from landscape.results import Progress
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.losses.autograd import view_loss
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.reference import Splats, project
from splat.render.autograd import project_by_kernel, rasterize_by_kernel
from splat.render.backend import backend_of

STEPS = (1e-10, 3e-11, 1e-11, 3e-12)  # per parameter; means in units of their spread
MOST_MOVED = 5e-4  # sum of a step over all parameters: longer ones cross jumps, which the last two STEPS may
CHUNK = 1 << 16  # Gaussians that autograd projects at a time
MOVING = ("means", "conics", "opacities", "colours")  # of the splats; their depths give their order alone
ENOUGH = ROUND_OFFS * torch.finfo(torch.float32).eps  # what a probe asks for


@dataclass(frozen=True)
class ProductCheck:
    """difference: of H v from differences of the gradient.  rounding: of H v in single precision from H v in double; None
    where single precision agreed with the differences, or was not used."""

    difference: DerivativeCheck
    rounding: float | None


def check_against_gradient(
    hessian: SceneHessian, generator: torch.Generator, progress: Progress | None = None, views: int | None = None
) -> ProductCheck:
    """The relative error of H v for one random v.

    views: how many to take, from the first; all by default.  For some views, P leaves out the quaternions'
    lengths alone: what is flat for all views together need not be flat for each.
    """
    objective = hessian.objective
    leave_out = hessian.project if views is None else partial(_without_lengths, objective.active)
    direction = leave_out(_direction(objective, generator)[:, None])[:, 0]
    shown = range(len(objective.views))[:views]
    operator = ProjectedOperator(SceneHessian(objective, keep_null=True, indices=shown), leave_out)
    found = _differences(operator, objective, direction, progress, views)
    if found.error <= ENOUGH or objective.active.flat.dtype == torch.float64:
        return ProductCheck(found, None)
    double = _in_double(objective, views)
    exact = ProjectedOperator(SceneHessian(double, keep_null=True), partial(_without_lengths, double.active))
    product, reference = operator.apply(direction[:, None]).double(), exact.apply(direction[:, None].double())
    rounding = float((product - reference).norm() / reference.norm().clamp_min(torch.finfo(torch.float64).tiny))
    return ProductCheck(_differences(exact, double, direction.double(), progress, None), rounding)


def _in_double(objective: SceneObjective, views: int | None) -> SceneObjective:
    """The same objective of these views, in float64."""
    return SceneObjective(
        objective.active.to(torch.float64),
        [view.with_image(view.image.double()) for view in objective.views[:views]],
        objective.loss_of_active,
        objective.background.double(),
        objective.settings,
        keep_unseen=True,
    )


def _differences(
    operator: ProjectedOperator,
    objective: SceneObjective,
    direction: Float[Tensor, " p"],
    progress: Progress | None,
    views: int | None,
) -> DerivativeCheck:
    center = objective.active.flat.double()
    steps = [step for step in STEPS if step * len(center) <= MOST_MOVED or step in STEPS[-2:]]
    gradient = _gradient(objective, progress, views, 2 * len(steps))
    return check_gradient(operator, gradient, center, direction, steps, enough=ENOUGH)


def _gradient(
    objective: SceneObjective, progress: Progress | None, views: int | None, most: int
) -> Callable[[Float[Tensor, " p"]], Float[Tensor, " p"]]:
    """The gradient at any theta, in float64, each view composited in its order at the objective's own; most: calls of it."""
    active, settings = objective.active, objective.settings
    double, background = active.to(torch.float64), objective.background.double()
    shown = objective.views[:views]
    losses = [backend_of(double.flat).view_loss(view.image, objective.loss_settings, double.flat) for view in shown]
    depths = [project_by_kernel(active, view.camera, settings).depths.double() for view in shown]
    done = 0

    def gradient(theta: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
        nonlocal done
        at, total = double.with_flat(theta.detach()), double.with_flat(torch.zeros_like(theta))
        regularizers = objective.regularizers(at)
        for view, of_view, order in zip(shown, losses, depths, strict=True):
            size = view.camera.width, view.camera.height
            with torch.no_grad():
                parts = [project(some, view.camera, settings) for _, some in _chunks(at)]
            whole = (torch.cat([getattr(part, each.name) for part in parts]) for each in fields(Splats))
            splats = replace(Splats(*whole), depths=order)
            moving = [getattr(splats, name).requires_grad_() for name in MOVING]
            image, _ = rasterize_by_kernel(splats, background, *size, settings)
            _pull(torch.autograd.grad(view_loss(image, of_view), moving), at, total, view.camera, settings)
            regularizers.add_gradient(total.flat)
        done += 1
        if progress:
            progress(done, most, "gradients in double precision")
        return _without_lengths(double, total.flat[:, None] / len(objective.views))[:, 0]

    return gradient


def _chunks(gaussians: Gaussians) -> Iterator[tuple[slice, Gaussians]]:
    """Autograd's graph of a projection takes a hundred times what its Gaussians do."""
    for start in range(0, len(gaussians), CHUNK):
        rows = slice(start, start + CHUNK)
        yield rows, gaussians.with_flat(torch.cat([each[rows].reshape(-1) for each in gaussians.attributes.values()]))


def _pull(
    adjoints: Sequence[Tensor], at: Gaussians, total: Gaussians, camera: Camera, settings: RenderSettings
) -> None:
    """Add to total what adjoints of the MOVING parts of the splats are in the parameters."""
    for rows, some in _chunks(at):
        splats = project(some.with_flat(some.flat.requires_grad_()), camera, settings)
        found = [getattr(splats, name) for name in MOVING]
        (gradient,) = torch.autograd.grad(found, some.flat, [adjoint[rows] for adjoint in adjoints])
        for sum_of, part in zip(total.attributes.values(), some.with_flat(gradient).attributes.values(), strict=True):
            sum_of[rows] += part


def _without_lengths(gaussians: Gaussians, V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
    """V without its components along the (unit) quaternions: the only null directions in which a gradient has any."""
    V, q = V.clone(), gaussians.quats[:, :, None]
    quats = V[gaussians.blocks["quats"]].view(len(gaussians), 4, -1)
    quats -= q * (q * quats).sum(dim=1, keepdim=True)
    return V


def _direction(objective: SceneObjective, generator: torch.Generator) -> Float[Tensor, " p"]:
    """Normal numbers, those of the means in units of the means' spread."""
    flat = objective.active.flat
    direction = objective.active.with_flat(torch.empty_like(flat).normal_(generator=generator))
    means = objective.active.means
    spread = float((means - means.mean(dim=0)).square().mean().sqrt())
    direction.means.mul_(spread or 1.0)
    return direction.flat
