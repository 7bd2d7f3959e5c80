"""Checks that an operator is a Hessian, and that a renderer can have one (`check_renderer`), for a few products.

symmetry    rms |G - G^T| off the diagonal over rms |H z|, with G = Z^T H Z for Gaussian Z (n, m).  Its expectation is
            |H - H^T|_F / |H|_F, because E (u . A v)^2 = |A|_F^2 and E |H z|^2 = |H|_F^2
noise       |H (a z) / a - H z| / |H z| with a = 1/3: the change of a product when its input is rounded differently
"""

from dataclasses import dataclass
from math import inf, isfinite, nan

import torch

from landscape.errors import InputError
from landscape.operators.operator import SymmetricOperator
from landscape.operators.renderer import ProductErrors, RendererHessian
from landscape.probes import draw_probes

SCALE = 1 / 3  # not a power of two, so that the scaled vector rounds differently
ROUND_OFFS = 4e3  # units of round-off in a sum of 1.6e7 rounded terms, whose errors add up like a random walk
WRONG = 0.03  # of a gradient: on splats the estimate of a right one was off by 0.01 at most
JUMPS = 0.2  # share of the change of an image in pixels that jump: larger ones are worth a sentence
UNRESOLVED = 1.0  # an error of a product as long as the product


@dataclass(frozen=True)
class OperatorCheck:
    """Asymmetry and round-off of an operator, relative to |H z| of a random vector z.

    symmetry, noise: see the top of this module; nan where a product was not finite.  tolerance: the largest value of either
    that passes.  matvecs: products used.
    """

    symmetry: float
    noise: float
    finite: bool
    tolerance: float
    matvecs: int

    @property
    def passed(self) -> bool:
        return self.finite and self.symmetry <= self.tolerance and self.noise <= self.tolerance


def check_operator(
    operator: SymmetricOperator, generator: torch.Generator, vectors: int = 4, tolerance: float | None = None
) -> OperatorCheck:
    """Symmetry, round-off and finiteness of products, from vectors + 1 matvecs.

    vectors: number of random vectors (2 or more), compared pair by pair.  tolerance: the largest asymmetry and round-off that
    pass, relative to |H z|; 4e3 eps of the operator's dtype where None.  A failed check raises nothing: see `passed`.

    >>> from landscape.operators.operator import DenseOperator
    >>> H = DenseOperator(torch.eye(5, dtype=torch.float64))
    >>> check_operator(H, torch.Generator().manual_seed(0)).passed
    True
    """
    if vectors < 2:
        raise InputError(f"expected at least 2 vectors to compare, got {vectors}")
    tolerance = ROUND_OFFS * torch.finfo(operator.dtype).eps if tolerance is None else tolerance
    Z = draw_probes(operator.dim, vectors, generator, operator.dtype)
    products = operator.apply(torch.cat([Z, SCALE * Z[:, :1]], dim=1))
    HZ, first = products[:, :vectors], products[:, 0].double()
    length, noise = float(first.norm()), float((products[:, vectors].double() / SCALE - first).norm())
    if not torch.isfinite(HZ).all() or not isfinite(noise):
        return OperatorCheck(nan, nan, False, tolerance, vectors + 1)
    G = Z.double().T @ HZ.double()
    pairs = vectors * (vectors - 1)
    asymmetry = float((G - G.T).norm()) / pairs**0.5
    size = float(HZ.double().norm()) / vectors**0.5
    # H = 0 is symmetric, and its products are exact
    return OperatorCheck(
        asymmetry / size if size else 0.0, noise / length if length else 0.0, True, tolerance, vectors + 1
    )


@dataclass(frozen=True)
class RendererCheck:
    """Whether a renderer repeats itself, jumps, and has the gradient of its image.

    noise: standard deviation of equal renders, as a share of the image.  kinks: of a random v (`ProductErrors`).
    gradients: v . J^T (J v) / |J v|^2 - 1 of each block's random v, J v by differences and J^T by the backward pass: 0.1 where
        the gradient in that parameter is 1.1 times too large; and the change of this number at steps twice as long.
    unseen: blocks whose random vector changes no image.  error: |error of H v| / |H v| for a random v.
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
        found = [
            f"expected the gradient in {name!r} to be that of the image, got {1 + off:.3g} times as much along a random "
            "vector; mend the backward pass, or name the tensor that the image is computed from"
            for name, (off, spread) in self.gradients.items()
            if not abs(off) <= WRONG + 2 * spread
        ]
        found += [f"expected images that depend on {one!r}, got none that changes; leave it out" for one in self.unseen]
        others = {
            f"expected equal images from equal renders, got a difference of {self.noise:.1e} of their size; fix the "
            "renderer's random numbers, or read errors that include this noise": not self.deterministic,
            f"expected an image that changes smoothly, got {self.kinks:.0%} of its change in pixels that jump; lower the "
            "thresholds of the renderer, or read its products as rough ones": self.kinks > JUMPS,
            f"expected products that steps resolve, got an error of {self.error:.0%} of their length; "
            "use the traces by backward passes alone (gauss_newton_traces)": not self.error < UNRESOLVED,
        }
        return found + [sentence for sentence, wrong in others.items() if wrong]


def check_renderer(hessian: RendererHessian, generator: torch.Generator) -> RendererCheck:
    """Check the renderer behind a bridge, for products with 1 + number of blocks vectors, at two steps.  It raises nothing.

    >>> x = torch.tensor([0.5, 2.0], requires_grad=True)
    >>> H = RendererHessian(lambda t: torch.exp(t * x), {"x": x}, lambda image, t: image.square().sum() / 2, [1.0, 3.0])
    >>> check_renderer(H, torch.Generator().manual_seed(0)).sentences
    []
    """
    V, stated, error = _random_product(hessian, generator)
    once, twice = (_gradient_ratios(hessian, V[:, 1:], factor) for factor in (1.0, 2.0))
    seen = {name: (once[name] - 1, abs(once[name] - twice[name])) for name in once if name in twice}
    unseen = tuple(name for name in hessian.blocks if name not in seen)
    return RendererCheck(hessian.deterministic, hessian.noise, float(stated.kinks), seen, unseen, error)


def require_resolved(hessian: RendererHessian, generator: torch.Generator) -> float:
    """The error of a product with a random unit vector.  Raises InputError where it is as long as the product."""
    _, stated, error = _random_product(hessian, generator)
    if not error < UNRESOLVED:
        raise InputError(f"expected products that steps resolve, got an error of {error:.0%}; ask check_renderer why")
    return float(stated.total)


def _random_product(hessian: RendererHessian, generator: torch.Generator) -> tuple[torch.Tensor, ProductErrors, float]:
    """Unit vectors over all rows and over each block; errors of the first one's product; error / length, inf for all noise."""
    V = draw_probes(hessian.dim, 1 + len(hessian.blocks), generator, hessian.dtype)
    for column, rows in zip(V.T[1:], hessian.blocks.values(), strict=True):
        column[: rows.start], column[rows.stop :] = 0, 0
    V /= torch.linalg.vector_norm(V, dim=0)
    product, stated = hessian.measured(V[:, :1])
    length = float(torch.linalg.vector_norm(product.double()))
    return V, stated, float(stated.total) / length if length else inf if hessian.noise else 0.0


def _gradient_ratios(hessian: RendererHessian, V: torch.Tensor, factor: float) -> dict[str, float]:
    """v . J^T (J v) / |J v|^2 over all views, of the vector of each block that changes an image."""
    pulled, squares = torch.zeros(2, V.shape[1], dtype=torch.float64)
    with hessian.parameters.restored(hessian.point):
        for index in range(len(hessian.views)):
            view = hessian.linear(index)
            for j, v in enumerate(V.unbind(dim=1)):
                if h := hessian.step(view, v):
                    Jv, *_ = hessian.differences(view, v, factor * h, None)
                    back = hessian.parameters.vjp(view.image, Jv, keep=True)
                    pulled[j] += float(torch.dot(back.double(), v.double()))
                    squares[j] += float(Jv.double().square().sum())
    return {name: float(a / b) for name, a, b in zip(hessian.blocks, pulled, squares, strict=True) if b}
