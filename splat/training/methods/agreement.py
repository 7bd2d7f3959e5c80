"""The loss between two renders of one view that both depend on parameters: what CoR-GS, DropoutGS and StableGS add.

l(I_0, I_1)    the loss of training (`LossSettings`), each image in place of the other's photograph; symmetric
"""

import torch
from jaxtyping import Float
from torch import Tensor

from splat.losses.reference import LossSettings
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.projection.reference import on_screen
from splat.render.backend import backend_of
from splat.render.loss_and_gradient import ViewPass
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
    passes = [
        ViewPass(field, camera, step.background, step.config.render, scale)
        for field, scale in zip(fields, opacity_scales, strict=True)
    ]
    if not any(on_screen(each.splats, camera).any() for each in passes):
        return None
    first, second = (each.raster for each in passes)
    image = first.crop(first.planes)[:3]
    loss = backend_of(image).image_loss(image, settings or step.config.loss)
    _, cotangents = loss.consistency(first.planes[:3], second.planes[:3])
    of_alpha = torch.zeros_like(first.planes[3:])
    in_first, in_second = (
        each.pull_back(torch.cat([weight * cotangent, of_alpha]))[0]
        for each, cotangent in zip(passes, cotangents, strict=True)
    )
    return in_first, in_second
