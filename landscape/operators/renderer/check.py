"""Checks of a renderer for the bridge: whether it repeats itself, jumps, and has the gradient of its image.

noise      standard deviation of the image between equal renders, as a share of its size
kinks      share of |J v|^2 in pixels whose one-sided differences disagree, for a random v
gradient   v . J^T (J v) / |J v|^2 - 1 of each block's random v, J v by differences and J^T by the backward pass: 0.1 where the
           gradient in that parameter is 1.1 times too large.  Its spread is the change at steps twice as long
error      |error of H v| / |H v| for a random v (`ProductErrors.total`)

What makes products meaningless is refused when the operator is made: a NaN, another size, an image without a gradient.
"""

from dataclasses import dataclass
from math import inf

import torch
from torch import Tensor

from landscape.errors import InputError
from landscape.operators.renderer.renderer import ProductErrors, RendererHessian
from landscape.probes import draw_probes

WRONG = 0.03  # of a gradient: on splats the estimate of a right one was off by 0.01 at most
JUMPS = 0.2  # share of the change of an image in pixels that jump: larger ones are worth a sentence
UNRESOLVED = 1.0  # an error of a product as long as the product


@dataclass(frozen=True)
class RendererCheck:
    """Noise, kinks, each block's gradient with its spread, error: see the top of this module.

    unseen: blocks whose random vector changes no image.
    """

    deterministic: bool
    noise: float
    kinks: float
    gradients: dict[str, tuple[float, float]]
    unseen: tuple[str, ...]
    error: float

    @property
    def sentences(self) -> list[str]:
        """What is wrong, and what to do; none for a renderer that passes."""
        found = []
        for name, (off, spread) in self.gradients.items():
            if not abs(off) <= WRONG + 2 * spread:
                found.append(
                    f"expected the gradient in {name!r} to be that of the image, got {1 + off:.3g} times as much along a "
                    "random vector; mend the backward pass, or name the tensor that the image is computed from"
                )
        found += [
            f"expected images that depend on {name!r}, got none that changes; leave it out" for name in self.unseen
        ]
        if not self.deterministic:
            found.append(
                f"expected equal images from equal renders, got a difference of {self.noise:.1e} of their size; fix the "
                "renderer's random numbers, or read errors that include this noise"
            )
        if self.kinks > JUMPS:
            found.append(
                f"expected an image that changes smoothly, got {self.kinks:.0%} of its change in pixels that jump; lower the "
                "thresholds of the renderer, or read its products as rough ones"
            )
        if not self.error < UNRESOLVED:
            found.append(
                f"expected products that steps resolve, got an error of {self.error:.0%} of their length; "
                "use the traces by backward passes alone (gauss_newton_traces)"
            )
        return found


def check_renderer(hessian: RendererHessian, generator: torch.Generator) -> RendererCheck:
    """Check the renderer behind a bridge, for products with 1 + number of blocks vectors, at two steps.  It raises nothing.

    >>> x = torch.tensor([0.5, 2.0], requires_grad=True)
    >>> H = RendererHessian(lambda t: torch.exp(t * x), {"x": x}, lambda image, t: image.square().sum() / 2, [1.0, 3.0])
    >>> check_renderer(H, torch.Generator().manual_seed(0)).sentences
    []
    """
    V = _vectors(hessian, generator)
    product, stated = hessian.measured(V[:, :1])
    length = torch.linalg.vector_norm(product.double())
    once, again = (gradient_ratios(hessian, V[:, 1:], factor) for factor in (1.0, 2.0))
    ratios = {
        name: (a - 1, abs(a - b))
        for name, a, b in zip(hessian.blocks, once, again, strict=True)
        if a is not None and b is not None
    }
    return RendererCheck(
        hessian.deterministic,
        hessian.noise,
        float(stated.kinks),
        ratios,
        tuple(name for name in hessian.blocks if name not in ratios),
        _relative(hessian, stated, length),
    )


def require_resolved(hessian: RendererHessian, generator: torch.Generator) -> float:
    """The error of a product with a random unit vector.  Raises InputError where it is as long as the product."""
    product, stated = hessian.measured(_vectors(hessian, generator)[:, :1])
    relative = _relative(hessian, stated, torch.linalg.vector_norm(product.double()))
    if not relative < UNRESOLVED:
        raise InputError(
            f"expected products that steps resolve, got an error of {relative:.0%} of the length of H v; check_renderer "
            "says why, and gauss_newton_traces needs no step"
        )
    return float(stated.total)


def _relative(hessian: RendererHessian, stated: ProductErrors, length: Tensor) -> float:
    """The error over the length of one product; inf where noise covers all views, 0 where nothing changes."""
    if length:
        return float(stated.total / length)
    return inf if hessian.noise else 0.0


def gradient_ratios(hessian: RendererHessian, V: Tensor, factor: float = 1.0) -> list[float | None]:
    """v . J^T (J v) / |J v|^2 over all views, of each column; None where no view changes.  1 for the gradient of the image."""
    pulled, squares = torch.zeros(2, V.shape[1], dtype=torch.float64)
    with hessian.at_point():
        for index in range(len(hessian.views)):
            view = hessian.linear(index)
            for j, v in enumerate(V.unbind(dim=1)):
                if h := hessian.step(index, view, v):
                    Jv = hessian.change_of_image(index, view, v, factor * h)[0]
                    back = hessian.parameters.vjp(view.image, Jv, keep=True)
                    pulled[j] += float(torch.dot(back.double(), v.double()))
                    squares[j] += float(Jv.double().square().sum())
    return [float(a / b) if b else None for a, b in zip(pulled, squares, strict=True)]


def _vectors(hessian: RendererHessian, generator: torch.Generator) -> Tensor:
    """Random unit vectors, the first over all rows, one over each block after it."""
    V = draw_probes(hessian.dim, 1 + len(hessian.blocks), generator, hessian.dtype)
    for column, rows in zip(V.T[1:], hessian.blocks.values(), strict=True):
        column[: rows.start], column[rows.stop :] = 0, 0
    return V / torch.linalg.vector_norm(V, dim=0)
