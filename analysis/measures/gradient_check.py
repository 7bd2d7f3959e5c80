"""H v against differences of the gradient, which other code computes, in double precision: a few views, each by itself.

    |H_m v - P (g_m(theta + h v) - g_m(theta - h v)) / (2 h)| / |H_m v|,   v random, m a view

at the first of four steps h that is good enough for the check, else at the best of them, and for the worst of the views.

g is autograd's, in float64, through the torch specification of the projection and the first-order kernels of
compositing and loss; P leaves the quaternions' lengths out, as the operator does.  H is the Hessian on one smooth piece of the
loss, that of theta, and so are the differences:

order   splats are composited in the order of their depths at theta, in the operator's precision
signs   L1 has a kink at each residual of 0: every residual keeps the sign that it has at theta, in the operator's precision.
        Those that change it from theta - h v to theta + h v are counted
jumps   a pixel jumps where the alpha of a splat passes its threshold, or where it stops: its change is then not 2 h J v.
        A step at which one does is not taken; a view without another step is left out, and counted

Few such jumps lie within 1e-11 of a parameter, where float64 still leaves the differences four digits.

Single precision may decide such cases otherwise than double: a splat at the threshold, and the depths that are equal to
round-off.  Where its H v is not close enough to the differences, the check is made of the operator in float64, and the
difference of the two products is reported apart:

    |H32 v - H64 v| / |H64 v|
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from math import inf, isnan, nan

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.operators.checks import ROUND_OFFS
from landscape.results import Progress
from splat.curvature.hessian import SceneHessian
from splat.curvature.linearize import LinearizedView
from splat.curvature.null.active_spaces import without_lengths
from splat.curvature.objective import SceneObjective
from splat.losses.autograd import view_loss
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.reference import Splats, project
from splat.render.autograd import project_by_kernel, rasterize_by_kernel
from splat.render.backend import backend_of
from splat.scenes.view import View

FEW = 3  # views
STEPS = (1e-10, 3e-11, 1e-11, 3e-12)  # per parameter; means in units of their spread
MOST_MOVED = 5e-4  # sum of a step over all parameters: longer ones cross jumps, which the last two STEPS may
JUMP = 1e-9  # of a colour: a splat at its threshold changes one by 4e-7 to 4e-3, a step of a smooth pixel is known to 1e-12
CHUNK = 1 << 16  # Gaussians that autograd projects at a time
MOVING = ("means", "conics", "opacities", "colours")  # of the splats; their depths give their order alone
ENOUGH = ROUND_OFFS * torch.finfo(torch.float32).eps  # what a probe asks for


@dataclass(frozen=True)
class ProductCheck:
    """error: of H_m v from differences of the gradient, the largest over the views; step: at which.  Both nan where every view
    was left out.  rounding: the largest of H v in single precision from H v in double; 0 where single precision agreed with the
    differences, or was not used.  views, left_out: how many were compared, and were not, as pixels jump at every step.
    signs: residuals that change theirs within the steps."""

    error: float
    step: float
    rounding: float
    views: int
    left_out: int
    signs: int


def check_against_gradient(
    hessian: SceneHessian, generator: torch.Generator, progress: Progress | None = None, views: int = FEW
) -> ProductCheck:
    """The relative error of H_m v for one random v.  views: how many to take, spread evenly over all."""
    objective, found = hessian.objective, []
    direction = _projected(objective.active, _direction(objective, generator))
    count = len(objective.views)
    for index in sorted({round(i) for i in np.linspace(0, count - 1, min(views, count))}):
        found.append(_of_view(objective, index, direction))
        if progress:
            progress(len(found), min(views, count), "views in double precision")
    worst = max(found, key=lambda each: -1.0 if each.left_out else each.error)
    counts = (sum(getattr(each, name) for each in found) for name in ("views", "left_out", "signs"))
    return ProductCheck(worst.error, worst.step, max(each.rounding for each in found), *counts)


def _of_view(objective: SceneObjective, index: int, direction: Float[Tensor, " p"]) -> ProductCheck:
    view = objective.views[index]
    linearized = objective.linearized[index]
    product = _product(linearized, direction)
    error, step, signs = _differences(objective, view, linearized, product, direction)
    rounding = 0.0
    if not error <= ENOUGH and objective.active.flat.dtype == torch.float32:
        double = _in_double(objective, view)
        reference = _product(double.linearized[0], direction.double())
        rounding = float((product - reference).norm() / reference.norm().clamp_min(torch.finfo(torch.float64).tiny))
        error, step, signs = _differences(double, view, double.linearized[0], reference, direction.double())
    left_out = int(isnan(error))
    return ProductCheck(error, step, rounding, 1 - left_out, left_out, signs)


def _in_double(objective: SceneObjective, view: View) -> SceneObjective:
    """The same objective of this view alone, in float64."""
    return SceneObjective(
        objective.active.to(torch.float64),
        [view.with_image(view.image.double())],
        objective.loss_of_active,
        objective.background.double(),
        objective.settings,
        keep_unseen=True,
    )


def _product(view: LinearizedView, direction: Float[Tensor, " p"]) -> Float64[Tensor, " p"]:
    """P H_m v."""
    return _projected(view.gaussians, view.hvp(direction[:, None])[:, 0]).double()


def _differences(
    objective: SceneObjective, view: View, linearized: LinearizedView, product: Float64[Tensor, " p"], direction: Tensor
) -> tuple[float, float, int]:
    """(error, step, signs) of the first step that is good enough, else of the best; (nan, nan, 0) where pixels jump at each."""
    center, v, size = objective.active.flat.double(), direction.double(), float(product.norm())
    change = linearized.jvp(direction[:, None])[0, :3].double()
    gradient, target, best = _Gradient(objective, view, linearized), view.image.to(center), (nan, nan, 0)
    for step in STEPS:
        if step * len(center) > MOST_MOVED and step not in STEPS[-2:]:
            continue
        (ahead, at), (behind, before) = (gradient(center + sign * step * v) for sign in (1, -1))
        if float((at - before - 2 * step * change).abs().max()) > JUMP:
            continue
        difference = float(((ahead - behind) / (2 * step) - product).norm())
        error = difference / size if size else (inf if difference else 0.0)
        if not error >= best[0]:
            best = error, step, int(((at - target).sign() != (before - target).sign()).sum())
        if error <= ENOUGH:
            break
    return best


class _Gradient:
    """The gradient of one view's loss at any theta, in float64, on the smooth piece of the objective's own theta."""

    def __init__(self, objective: SceneObjective, view: View, linearized: LinearizedView) -> None:
        self.active, self.camera, self.settings = objective.active.to(torch.float64), view.camera, objective.settings
        self.background, self.regularizers = objective.background.double(), objective.regularizers
        self.target, loss = view.image.to(self.active.flat), objective.loss_settings
        self.loss = backend_of(self.active.flat).view_loss(view.image, loss, self.active.flat)
        self.depths = project_by_kernel(objective.active, view.camera, objective.settings).depths.double()
        self.signs = (linearized.image - view.image.to(linearized.image)).sign().double()
        self.weight = loss.pixel_weight / self.target.numel() if loss.pixel == "l1" else 0.0

    def __call__(self, theta: Float64[Tensor, " p"]) -> tuple[Float64[Tensor, " p"], Float64[Tensor, "3 h w"]]:
        """Gradient and render."""
        at, total = self.active.with_flat(theta), self.active.with_flat(torch.zeros_like(theta))
        with torch.no_grad():
            parts = [project(some, self.camera, self.settings) for _, some in _chunks(at)]
        splats = Splats(*(torch.cat([getattr(part, each.name) for part in parts]) for each in fields(Splats)))
        splats = replace(splats, depths=self.depths)
        moving = [getattr(splats, name).requires_grad_() for name in MOVING]
        size = self.camera.width, self.camera.height
        image, _ = rasterize_by_kernel(splats, self.background, *size, self.settings)
        turned = self.signs - (image.detach() - self.target).sign()
        loss = view_loss(image, self.loss) + self.weight * (turned * image).sum()
        _pull(torch.autograd.grad(loss, moving), at, total, self.camera, self.settings)
        self.regularizers(at).add_gradient(total.flat)
        return _projected(self.active, total.flat), image.detach()


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
        # a number's gradient: for one of tensors torch imports sympy, a quarter of a second
        parts = [(getattr(splats, name) * each[rows]).sum() for name, each in zip(MOVING, adjoints, strict=True)]
        (gradient,) = torch.autograd.grad(torch.stack(parts).sum(), some.flat)
        for sum_of, part in zip(total.attributes.values(), some.with_flat(gradient).attributes.values(), strict=True):
            sum_of[rows] += part


def _projected(gaussians: Gaussians, v: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
    """P v: the lengths of the quaternions are the only null directions in which a gradient may have a component."""
    return without_lengths(v[:, None], gaussians.quats, gaussians.blocks["quats"])[:, 0]


def _direction(objective: SceneObjective, generator: torch.Generator) -> Float[Tensor, " p"]:
    """Normal numbers, those of the means in units of the means' spread."""
    flat = objective.active.flat
    direction = objective.active.with_flat(torch.empty_like(flat).normal_(generator=generator))
    means = objective.active.means
    spread = float((means - means.mean(dim=0)).square().mean().sqrt())
    direction.means.mul_(spread or 1.0)
    return direction.flat
