"""Eigenpairs of an operator whose products have errors that it can tell: `RendererHessian`.

A Lanczos run sees of these errors only what is not symmetric.  So the error e of a product with a random unit vector is the
floor of the residuals that the run is asked for, and the error of the products with the eigenvectors found is added to theirs:

    some eigenvalue of H is within |H~ v - lambda v| + |e| of lambda       H~ = H with its errors
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.eigen.eigen import extreme_eigenpairs
from landscape.eigen.pairs import EigenEnds, Eigenpairs
from landscape.eigen.ritz import EigenSettings
from landscape.operators.renderer.check import require_resolved
from landscape.operators.renderer.renderer import RendererHessian
from landscape.results import Progress


def renderer_eigenpairs(
    hessian: RendererHessian,
    generator: torch.Generator,
    settings: EigenSettings = EigenSettings(),
    start: Float[Tensor, "n *k"] | None = None,
    progress: Progress | None = None,
) -> EigenEnds:
    """`extreme_eigenpairs` of a renderer's Hessian or Gauss-Newton, with residuals that include the errors of products.

    An end whose residual is above settings' goal because of these has the reason "noise floor".  InputError where steps do not
    resolve the products.

    >>> x = torch.tensor([0.5, 2.0], requires_grad=True, dtype=torch.float64)
    >>> H = RendererHessian(lambda t: torch.exp(t * x), {"x": x}, lambda image, t: image.square().sum() / 2, [1.0])
    >>> ends = renderer_eigenpairs(H, torch.Generator().manual_seed(0))
    >>> value, error = float(ends.largest.values), float(ends.largest.residuals)
    >>> abs(value - 2 * 2.718281828459045**4) < error < 1e-4
    True
    """
    floor = require_resolved(hessian, generator)
    asked = replace(settings, atol=max(settings.atol, floor))
    ends = extreme_eigenpairs(hessian, generator, asked, start, progress)
    return replace(ends, **{name: _widened(getattr(ends, name), hessian, settings) for name in ("largest", "smallest")})


def _widened(pairs: Eigenpairs, hessian: RendererHessian, settings: EigenSettings) -> Eigenpairs:
    """Pairs with the error of the operator in their residuals."""
    if not len(pairs):
        return pairs
    residuals = pairs.residuals + hessian.error(pairs.vectors).total.cpu()
    goal = (settings.rtol * pairs.values.abs()).clamp_min(settings.atol)
    missed = pairs.reason == "tolerance" and bool((residuals > goal).any())
    return replace(pairs, residuals=residuals, reason="noise floor" if missed else pairs.reason)
