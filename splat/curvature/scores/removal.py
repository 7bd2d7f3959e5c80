"""Scores of single Gaussians for pruning: the lowest go first.

    removal_error, removal_error_l2   the rise of the loss, and of the mean squared error, when the Gaussian is removed, to
                    second order
    log_det_6       ln det of the 6 x 6 of mean and log-scales in Gauss-Newton of the L2 loss: PUP 3D-GS (Hanson et al. 2025)
    log_det_11      the same of the 11 x 11 of its geometry and opacity, without the quaternion's length
    gn_diagonal     sum of ln of the 11 x 11's diagonal: log_det_11 of a method that keeps the diagonal alone
    opacity         omega = sigmoid(logit)
    size_opacity    omega times the product of the standard deviations, as LightGaussian (Fan et al. 2024) weighs volumes

Removal takes omega to 0.  A pixel is linear in the alpha of every Gaussian over it, so that H_omega,omega has no second
derivative of the image: it is Gauss-Newton's, and with the stored logit z, d omega / d z = omega (1 - omega),

    rise = -omega L_omega + omega^2 / 2 H_omega,omega = -g_z / (1 - omega) + G_zz / (2 (1 - omega)^2)

where G_zz has SSIM's window.  For the L2 loss that is the change itself, but where alpha is cut, capped, or a pixel
stops; under L1 residuals that change sign are not seen.  It is taken at logits of OPAQUE at most, which draw the same pictures
to 1.2e-4: beyond, 1 - omega is soon rounded to 0, and both quotients to 0 / 0.  Eigenvalues below d eps times the block's
largest, which few views determine, count as that much.
"""

from copy import copy
from functools import cached_property

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from landscape.results import Progress
from splat.curvature.fields import eigenvalues, on_complement
from splat.curvature.objective import SceneObjective

EXACT = ("removal_error", "removal_error_l2", "log_det_6", "log_det_11", "gn_diagonal")
SCORES = (*EXACT, "opacity", "size_opacity")
OPAQUE = 9.0  # a logit at which 1 - omega is 1.2e-4, and known to 2.4e-4 of itself in single precision
GONE = -50.0  # a logit with which a Gaussian is drawn nowhere


def removal_scores(objective: SceneObjective, l2: SceneObjective) -> dict[str, Float64[Tensor, " n"]]:
    """Every score of the active Gaussians.  l2: the same scene and views with the L2 loss.

    >>> from splat import LossSettings, SceneObjective, SyntheticSettings, synthetic_scene
    >>> made = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12))
    >>> views, l2 = made.scene.load(), LossSettings("l2", ssim_weight=0)
    >>> scores = removal_scores(SceneObjective(made.truth, views), SceneObjective(made.truth, views, l2))
    >>> tuple(scores) == SCORES, bool((scores["removal_error_l2"] >= 0).all())  # the pictures are renders of these Gaussians
    (True, True)
    """
    active = l2.active
    geometry = l2.exact_gauss_newton_blocks.geometry.double()
    complement = on_complement(geometry, active.quats.double())
    eps = torch.finfo(active.flat.dtype).eps
    diagonal = torch.cat(
        [part for name, part in l2.exact_gauss_newton_blocks.diagonals_across(active.quats).items() if name != "sh"], 1
    )
    omega = active.opacity_logits.double().sigmoid()
    return {
        "removal_error": predicted_rise(objective),
        "removal_error_l2": predicted_rise(l2),
        "log_det_6": floored_log_det(geometry[:, :6, :6], eps),
        "log_det_11": floored_log_det(complement, eps),
        "gn_diagonal": _log_sum(diagonal, eps),
        "opacity": omega,
        "size_opacity": omega * active.log_scales.double().sum(dim=1).exp(),
    }


def predicted_rise(objective: SceneObjective) -> Float64[Tensor, " n"]:
    """The second-order rise of the loss when each active Gaussian alone is removed."""
    objective = _below_opaque(objective)
    z = objective.active.opacity_logits.double()
    slope = objective.gradient[objective.blocks["opacity_logits"]].double()
    curvature = objective.exact_gauss_newton_blocks.geometry[:, 10, 10].double()
    return -slope / (-z).sigmoid() + curvature / (2 * (-z).sigmoid().square())


def _below_opaque(objective: SceneObjective) -> SceneObjective:
    """The objective, with logits of OPAQUE at most."""
    if not (objective.active.opacity_logits > OPAQUE).any():
        return objective
    same, flat = copy(objective), objective.active.flat.clone()
    for name in [name for name in vars(same) if isinstance(getattr(SceneObjective, name, None), cached_property)]:
        del vars(same)[name]  # of the logits as they are
    flat[objective.blocks["opacity_logits"]].clamp_(max=OPAQUE)
    same.active = objective.active.with_flat(flat)
    return same


def removal_errors(
    objective: SceneObjective, chosen: Int64[Tensor, " m"], progress: Progress | None = None
) -> Float64[Tensor, " m"]:
    """The true rise of the loss when each of the chosen active Gaussians alone is removed: a render of all views for each."""
    flat, errors = objective.active.flat, []
    logits = objective.blocks["opacity_logits"].start
    whole = objective.loss(flat)
    for done, index in enumerate(chosen.tolist()):
        without = flat.clone()
        without[logits + index] = GONE
        errors.append(objective.loss(without) - whole)
        if progress:
            progress(done + 1, len(chosen), "Gaussians removed, one at a time")
    return torch.tensor(errors, dtype=torch.float64)


def floored_log_det(matrices: Float64[Tensor, "n d d"], eps: float) -> Float64[Tensor, " n"]:
    """ln det of positive semi-definite matrices; -inf where they are 0."""
    return _log_sum(eigenvalues(matrices), eps)


def _log_sum(values: Float64[Tensor, "n d"], eps: float) -> Float64[Tensor, " n"]:
    return torch.maximum(values, values.shape[1] * eps * values.amax(dim=1, keepdim=True)).log().sum(dim=1)
