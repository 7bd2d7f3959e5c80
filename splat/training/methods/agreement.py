"""The loss between two renders of one view that both depend on parameters: what CoR-GS, DropoutGS and StableGS add.

l(I_0, I_1)    the loss of training (`LossSettings`), each image in place of the other's photograph; symmetric
"""

import torch
from jaxtyping import Float
from torch import Tensor

from splat.losses.autograd import consistency_loss
from splat.losses.reference import LossSettings
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.projection.reference import on_screen
from splat.render.render import render
from splat.training.state import Step


def agreement_gradients(
    step: Step,
    fields: tuple[Gaussians, Gaussians],
    camera: Camera,
    opacity_scales: tuple[Float[Tensor, " n"] | None, Float[Tensor, " n"] | None] = (None, None),
    weight: float = 1.0,
    settings: LossSettings | None = None,
) -> tuple[Float[Tensor, " p"], Float[Tensor, " q"]] | None:
    """The gradients of weight l(I_0, I_1) in the parameters of either field.  None where neither has a Gaussian in sight.

    settings: of l, where it is not the loss of training.
    """
    flats = [field.flat.detach().requires_grad_() for field in fields]
    renders = [
        render(field.with_flat(flat), camera, step.background, step.config.render, opacity_scale=scale)
        for field, flat, scale in zip(fields, flats, opacity_scales, strict=True)
    ]
    if not any(on_screen(each.splats.detach(), camera).any() for each in renders):
        return None
    loss = weight * consistency_loss(renders[0].image, renders[1].image, settings or step.config.loss)
    first, second = torch.autograd.grad(loss, flats)
    return first, second
