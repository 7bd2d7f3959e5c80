"""Traces and blocks of Gauss-Newton, G = J^T l'' J, of a renderer by backward passes alone: no step to choose.

z is a vector of standard normal numbers, one for each number of the image of a view.  As E z z^T = I, E u c^T = J^T l'' J for

    u = J^T B z,  c = u                where l'' = B B^T is diagonal, as for sums over pixels; one backward pass
    u = J^T z,    c = J^T l'' z        where l'' couples pixels, as SSIM does, or is negative somewhere; two

Each view draws its own; G is their mean.  l'' is diagonal where two vectors s of random signs give one s * l'' s, its diagonal.

**Intervals.**  u . c over a block is a quadratic form z^T S z in the pixels, S = sym(J_b J_b^T l'').  The pairs of samples give
the entries z_i^T S z_j of its Gram matrix, summed over views, and with them the interval of `quadratic`.  It needs normal z.
"""

from collections.abc import Iterator
from math import ceil
from typing import NamedTuple

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import gram
from landscape.operators.operator import require_finite
from landscape.operators.renderer import RendererHessian
from landscape.probes import draw_probes
from landscape.traces.estimate import TraceEstimate
from landscape.traces.hutchinson import GROUP, LEAST
from landscape.traces.quadratic import FEWEST, mean_interval, power_sums

AT_ONCE = 8  # samples whose blocks are kept
SAME = 16  # units of round-off by which two products with a diagonal l'' may differ


class BlockEstimate(NamedTuple):
    """Diagonal blocks of G of groups of rows, with standard errors."""

    values: Float64[Tensor, "g d d"]
    standard_errors: Float64[Tensor, "g d d"]


def gauss_newton_traces(
    H: RendererHessian, generator: torch.Generator, samples: int = 32, confidence: float = 0.95, memory: float = 2.0
) -> dict[str, TraceEstimate]:
    """The trace of each block of G with its interval, by name, from so many samples (8 or more).

    A sample costs one or two backward passes of every view.  memory: GiB for the vectors of a group of samples, of at most 32;
    each group renders every view once.  `matvecs` of the estimates count samples.  All blocks are read from the same samples.

    >>> x = torch.tensor([0.5, 2.0], requires_grad=True)
    >>> H = RendererHessian(lambda t: t * x, {"x": x}, lambda image, t: image.square().sum() / 2, [1.0, 3.0])
    >>> found = gauss_newton_traces(H, torch.Generator().manual_seed(0), 400)["x"]  # the mean of 1 and 9, twice
    >>> found.low < 10 < found.high, found.probes
    (True, 400)
    """
    sizes = _sizes(samples, LEAST, min(max(int(memory * 2**30 / (2 * H.point.nbytes)), 2 * FEWEST), GROUP))
    grams = {name: [torch.zeros(size, size, dtype=torch.float64) for size in sizes] for name in H.blocks}
    for group, size in enumerate(sizes):
        for U, C in _sampled(H, generator, size):
            for name, rows in H.blocks.items():
                grams[name][group] += gram(U[rows], C[rows]).cpu() / len(H.views)
    found = {}
    for name, rows in H.blocks.items():
        each = torch.cat([G.diagonal() for G in grams[name]])
        sums = [power_sums(torch.eye(len(G), dtype=G.dtype), G, "gaussian") for G in grams[name]]  # I^T G = G
        value, n, reason = float(each.mean()), rows.stop - rows.start, "matvec budget"
        interval = mean_interval(value, samples, sums, confidence)
        found[name] = TraceEstimate(name, n, value, *interval, confidence, samples, samples, reason, each, "pixels")
    return found


def gauss_newton_blocks(
    H: RendererHessian, generator: torch.Generator, groups: Int64[Tensor, "g d"], samples: int = 32
) -> BlockEstimate:
    """The block of G on each group of d rows, from so many samples (3 or more).

    groups: numbers of rows; for Gaussians, a row for each with the numbers of its 3, 6 or 11 parameters; of one number
    each, they are the diagonal.
    """
    if groups.ndim != 2 or groups.is_floating_point() or not ((groups >= 0) & (groups < H.dim)).all():
        raise InputError(
            f"expected groups x d numbers of rows in 0..{H.dim - 1}, got {groups.dtype} {tuple(groups.shape)}"
        )
    where = groups.to(H.point.device)
    total, squares = torch.zeros(2, *groups.shape, groups.shape[1], dtype=torch.float64, device=where.device)
    for size in _sizes(samples, 3, AT_ONCE):
        parts = torch.zeros(size, *total.shape, dtype=total.dtype, device=total.device)
        for U, C in _sampled(H, generator, size):
            for part, u, c in zip(parts, U.double().T, C.double().T, strict=True):
                outer = u[where][:, :, None] * c[where][:, None, :]
                part += (outer + outer.mT) / (2 * len(H.views))
        total += parts.sum(dim=0)
        squares += parts.square().sum(dim=0)
    variance = (squares / samples - (total / samples).square()).clamp_min(0) / (samples - 1)
    return BlockEstimate(total / samples, variance.sqrt())


def _sizes(samples: int, least: int, most: int) -> list[int]:
    """Sizes of groups of at most so many samples, equal to within one.  InputError for fewer samples than the least."""
    if samples < least:
        raise InputError(f"expected at least {least} samples, got {samples}")
    return [len(part) for part in torch.arange(samples).tensor_split(ceil(samples / most))]


def _sampled(H: RendererHessian, generator: torch.Generator, count: int) -> Iterator[tuple[Tensor, Tensor]]:
    """u and c of each view, for so many samples, as columns."""
    for index in range(len(H.views)):
        view = H.linear(index)
        n, shape, dtype = view.free.numel(), view.free.shape, view.free.dtype
        Z = draw_probes(n, count, generator, dtype).T.reshape(count, *shape)
        signs = draw_probes(n, 2, generator, dtype, "rademacher").T.reshape(2, *shape)
        once, again = (s * view.curvature(s) for s in signs)
        tolerance = SAME * torch.finfo(once.dtype).eps * once.abs().max()
        diagonal = bool((once >= 0).all() and ((once - again).abs() <= tolerance).all())
        cotangents = ((once.sqrt() * z for z in Z),) if diagonal else (Z, map(view.curvature, Z))
        pulled = [torch.stack([H.parameters.vjp(view.image, c, keep=True) for c in some], dim=1) for some in cotangents]
        require_finite(H, all(bool(torch.isfinite(each).all()) for each in pulled))
        yield pulled[0], pulled[-1]
