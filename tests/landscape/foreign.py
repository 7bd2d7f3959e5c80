"""A renderer that stands for other people's: bumps on a line in plain torch.

It can be differentiated twice, which no bridge uses: its exact Hessian is the oracle.  Our own rasteriser in that place is
`notebooks.renderer.scenes`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from landscape import ObjectiveHessian, RendererHessian

PIXELS = torch.linspace(-1, 1, 40, dtype=torch.float64)


@dataclass
class Bumps:
    """Six bumps on a line, seen from places that shift near ones more; their parameters are `named`.

    cut: weights below it are dropped, a jump as of a splat's footprint.  change: applied to each image.
    """

    dtype: torch.dtype = torch.float64
    cut: float = 0.0
    change: Callable[[Tensor], Tensor] = lambda image: image
    views: tuple[float, ...] = (-0.3, 0.0, 0.4)
    renders: int = 0
    named: dict[str, Tensor] = field(init=False)

    def __post_init__(self) -> None:
        generator = torch.Generator().manual_seed(0)
        start = {"places": torch.linspace(-0.8, 0.8, 6), "depths": torch.rand(6, generator=generator)}
        start |= {"widths": torch.full((6,), -1.5), "heights": torch.randn(6, generator=generator)}
        self.named = {name: value.to(self.dtype).requires_grad_() for name, value in start.items()}

    def image(self, named: dict[str, Tensor], view: float) -> Tensor:
        offsets = PIXELS.to(self.dtype) - (named["places"] + view * named["depths"])[:, None]
        weights = torch.exp(-((offsets / named["widths"].exp()[:, None]) ** 2) / 2)
        return (named["heights"][:, None] * torch.where(weights < self.cut, 0.0, weights)).sum(dim=0)

    def render(self, view: float) -> Tensor:
        self.renders += 1
        return self.change(self.image(self.named, view))

    @staticmethod
    def loss(image: Tensor, view: float) -> Tensor:
        """Couples neighbouring pixels, and is not convex in the image."""
        target = torch.sin(3 * PIXELS + view).to(image)
        return ((image - target) ** 2).mean() - (image[1:] * image[:-1]).cos().mean()

    def hessian(self, **options: Any) -> RendererHessian:
        return RendererHessian(self.render, self.named, self.loss, self.views, **options)

    def exact(self) -> ObjectiveHessian:
        """The Hessian by double backward."""
        sizes = [value.numel() for value in self.named.values()]

        def mean_loss(theta: Tensor) -> Tensor:
            named = dict(zip(self.named, theta.split(sizes), strict=True))
            return torch.stack([self.loss(self.image(named, view), view) for view in self.views]).mean()

        return ObjectiveHessian(mean_loss, torch.cat([value.detach() for value in self.named.values()]))
