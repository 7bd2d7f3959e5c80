"""H v against differences of the gradient, which other code computes, in double precision.

    |H v - P (g(theta + h v) - g(theta - h v)) / (2 h)| / |H v|,   v random

at the first of three steps h that is good enough for the check, else at the best of them.

g is autograd's, in float64, through the torch specification of the projection and the first-order kernels of
compositing and loss; P leaves the quaternions' lengths out, as the operator does.  The steps are tiny, because the loss
has a kink at each zero residual and a jump wherever a splat's alpha falls under its threshold or a pixel stops: few lie
within 1e-10 of a parameter, where float64 still leaves the differences five digits.  A step on which the order of the
depths changes proves nothing and is skipped; Gaussians at exactly the same place, as cloning leaves them, would change
places on any step and have their means held still.
"""

from collections.abc import Hashable
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from landscape import DerivativeCheck, ProjectedOperator, check_gradient
from landscape.operators.checks import ROUND_OFFS
from landscape.results import Progress
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.losses.autograd import loss_against, view_loss
from splat.model.gaussians import Gaussians
from splat.projection.reference import project
from splat.render.autograd import rasterize_by_kernel

STEPS = (1e-10, 3e-10, 3e-11)  # per parameter; means in units of their spread


def check_against_gradient(
    hessian: SceneHessian, generator: torch.Generator, progress: Progress | None = None, views: int | None = None
) -> DerivativeCheck:
    """The relative error of H v for one random v.

    views: how many to take, from the first of this process; all by default.  For some views, P leaves out the quaternions'
    lengths alone: what is flat for all views together need not be flat for each.
    """
    objective = hessian.objective
    leave_out = hessian.project if views is None else partial(_without_lengths, objective.active)
    operator = ProjectedOperator(SceneHessian(objective, keep_null=True, count=views), leave_out)
    double = objective.active.to(torch.float64)
    background, settings = objective.background.double(), objective.settings
    direction = operator.project(_direction(objective, generator)[:, None])[:, 0]
    losses = [loss_against(view.image, objective.loss_settings, double.flat) for view in objective.views[:views]]
    done = 0

    def gradient(theta: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
        nonlocal done
        flat, total = theta.detach().requires_grad_(), torch.zeros_like(theta)
        for view, of_view in zip(objective.views[:views], losses, strict=True):
            size = view.camera.width, view.camera.height
            splats = project(double.with_flat(flat), view.camera, settings)
            splats = replace(splats, depths=splats.depths.detach())  # for the order alone
            image, _ = rasterize_by_kernel(splats, background, *size, settings)
            total += torch.autograd.grad(view_loss(image, of_view), flat)[0]
        done += 1
        if progress:
            progress(done, 2 * len(STEPS), "gradients in double precision")
        return _without_lengths(double, objective.mean_over_views(total)[:, None])[:, 0]

    def order(theta: Float[Tensor, " p"]) -> Hashable:
        means = double.with_flat(theta).means.cpu()
        cameras = (view.camera for view in objective.views[:views])
        depths = torch.stack([(means - camera.centre) @ camera.forward for camera in cameras])
        return objective.gather_pieces(hash(depths.argsort(dim=1, stable=True).numpy().tobytes()))

    enough = ROUND_OFFS * torch.finfo(torch.float32).eps  # what a probe asks for
    return check_gradient(operator, gradient, double.flat, direction, STEPS, order, enough)


def _without_lengths(gaussians: Gaussians, V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
    """V without its components along the (unit) quaternions: the only null directions in which a gradient has any."""
    V, q = V.clone(), gaussians.quats[:, :, None]
    quats = V[gaussians.blocks["quats"]].view(len(gaussians), 4, -1)
    quats -= q * (q * quats).sum(dim=1, keepdim=True)
    return V


def _direction(objective: SceneObjective, generator: torch.Generator) -> Float[Tensor, " p"]:
    """Normal numbers, those of the means in units of the means' spread; 0 for means that several Gaussians share."""
    flat = objective.active.flat
    direction = objective.active.with_flat(torch.empty_like(flat).normal_(generator=generator))
    means = objective.active.means
    _, place, copies = torch.unique(means, dim=0, return_inverse=True, return_counts=True)
    spread = float((means - means.mean(dim=0)).square().mean().sqrt())
    direction.means.mul_(spread or 1.0)
    direction.means[copies[place] > 1] = 0
    return direction.flat
