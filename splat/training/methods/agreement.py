"""The loss between two renders of one view that both depend on parameters: what CoR-GS, DropoutGS and StableGS add.

l(I_0, I_1)    the loss of training (`LossSettings`), each image in place of the other's photograph; symmetric
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splat.losses.reference import LossSettings
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.render.backend import backend_of
from splat.render.loss_and_gradient import ViewPass
from splat.training.state import Step


@dataclass(frozen=True, eq=False)
class Agreement:
    """weight l(I_0, I_1), differentiated in both images: `cotangents` of the passes' planes."""

    passes: tuple[ViewPass, ViewPass]
    cotangents: tuple[Tensor, Tensor]

    def gradient(self, field: Literal[0, 1]) -> Float[Tensor, " p"]:
        """The gradient in the parameters of a field, by a backward pass."""
        return self.passes[field].pull_back(self.cotangents[field])[0]


def agreement(
    step: Step,
    fields: tuple[Gaussians, Gaussians],
    camera: Camera,
    opacity_scales: tuple[Float[Tensor, " n"] | None, Float[Tensor, " n"] | None] = (None, None),
    weight: float = 1.0,
    settings: LossSettings | None = None,
) -> Agreement | None:
    """weight l(I_0, I_1) of two fields.  None where neither has a Gaussian in sight.

    settings: of l, where it is not the loss of training.
    """
    passes = tuple(
        ViewPass(field, camera, step.background, step.config.render, scale)
        for field, scale in zip(fields, opacity_scales, strict=True)
    )
    first, second = (each.raster for each in passes)
    if not first.intersections + second.intersections:
        return None
    image = first.crop(first.planes)[:3]
    loss = backend_of(image).image_loss(image, settings or step.config.loss)
    _, of_images = loss.consistency(first.planes[:3], second.planes[:3])
    of_alpha = torch.zeros_like(first.planes[3:])
    one, other = (torch.cat([weight * of_image, of_alpha]) for of_image in of_images)
    return Agreement((passes[0], passes[1]), (one, other))
