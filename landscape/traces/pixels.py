"""Traces, diagonal and blocks of Gauss-Newton, G = J^T l'' J, of a renderer by backward passes alone: no step to choose.

z is a vector of standard normal numbers, one for each number of the image of a view.  Then E z z^T = I and

    u = J^T B z,  c = u                where l'' = B B^T is diagonal, as for sums over pixels; one backward pass
    u = J^T z,    c = J^T l'' z        where l'' couples pixels, as SSIM does, or is negative somewhere; two
    E u c^T = J^T l'' J

Each view has numbers of its own; G is the mean over the views.  That l'' is diagonal is seen from two vectors of random signs
s: the products s * (l'' s) are then equal, and are its diagonal.

**Intervals.**  u . c over a block is a quadratic form z^T S z in the pixels, S = sym(J_b J_b^T l'').  The pairs of samples give
the entries z_i^T S z_j of its Gram matrix, summed over views, and with them the interval of `quadratic`.  It needs normal z.
"""

from collections.abc import Iterator
from math import ceil
from typing import NamedTuple

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import gram
from landscape.operators.operator import require_finite
from landscape.operators.renderer.renderer import LinearView, RendererHessian
from landscape.probes import draw_probes
from landscape.traces.diagonal import DiagonalEstimate, mean_diagonal
from landscape.traces.estimate import TraceEstimate
from landscape.traces.hutchinson import GROUP, LEAST
from landscape.traces.quadratic import FEWEST, PowerSums, mean_interval, power_sums

GIB = 1 << 30
AT_ONCE = 8  # samples whose blocks are kept
SAME = 16  # units of round-off by which two products with a diagonal l'' may differ


class BlockEstimate(NamedTuple):
    """Diagonal blocks of G of groups of rows, with standard errors."""

    values: Float64[Tensor, "g d d"]
    standard_errors: Float64[Tensor, "g d d"]


def gauss_newton_traces(
    hessian: RendererHessian,
    generator: torch.Generator,
    samples: int = 32,
    confidence: float = 0.95,
    memory: float = 2.0,
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
    _require_samples(samples, LEAST)
    groups: dict[str, list[PowerSums]] = {name: [] for name in hessian.blocks}
    values: dict[str, list[Tensor]] = {name: [] for name in hessian.blocks}
    fitting = int(memory * GIB / (2 * hessian.dim * torch.finfo(hessian.dtype).bits / 8))
    for count in _sizes(samples, min(max(fitting, 2 * FEWEST), GROUP)):
        grams = {name: torch.zeros(count, count, dtype=torch.float64) for name in hessian.blocks}
        for U, C in _sampled(hessian, generator, count):
            for name, rows in hessian.blocks.items():
                grams[name] += gram(U[rows], C[rows]).cpu() / len(hessian.views)
        for name, G in grams.items():
            values[name].append(G.diagonal())
            groups[name].append(power_sums(torch.eye(count, dtype=G.dtype), G, "gaussian"))  # I^T G = G
    found = {}
    for name, rows in hessian.blocks.items():
        each = torch.cat(values[name])
        error, low, high = mean_interval(float(each.mean()), samples, groups[name], confidence)
        found[name] = TraceEstimate(
            name, rows.stop - rows.start, float(each.mean()), error, low, high, confidence, samples, samples,
            "matvec budget", each, "pixels",
        )  # fmt: skip
    return found


def gauss_newton_diagonal(hessian: RendererHessian, generator: torch.Generator, samples: int = 32) -> DiagonalEstimate:
    """diag G with a standard error for every entry, from so many samples (3 or more).

    Memory: n x samples numbers in float64.
    """
    _require_samples(samples, 3)
    found = torch.zeros(hessian.dim, samples, dtype=torch.float64, device=hessian.parameters.device)
    for U, C in _sampled(hessian, generator, samples):
        found += U.double() * C.double() / len(hessian.views)
    return mean_diagonal(found, hessian, samples, "pixels")


def gauss_newton_blocks(
    hessian: RendererHessian, generator: torch.Generator, groups: Int64[Tensor, "g d"], samples: int = 32
) -> BlockEstimate:
    """The block of G on each group of d rows, from so many samples (3 or more).

    groups: numbers of rows; for Gaussians, a row for each with the numbers of its 3, 6 or 11 parameters.
    """
    _require_samples(samples, 3)
    if groups.ndim != 2 or groups.is_floating_point() or not ((groups >= 0) & (groups < hessian.dim)).all():
        raise InputError(
            f"expected groups as numbers of rows in 0..{hessian.dim - 1}, of shape (groups, rows of each), got {groups.dtype} "
            f"of shape {tuple(groups.shape)}"
        )
    total = torch.zeros(*groups.shape, groups.shape[1], dtype=torch.float64, device=hessian.parameters.device)
    squares, where = total.clone(), groups.to(total.device)
    for count in _sizes(samples, AT_ONCE):
        parts = torch.zeros(count, *total.shape, dtype=total.dtype, device=total.device)
        for U, C in _sampled(hessian, generator, count):
            for part, u, c in zip(parts, U.double().T, C.double().T, strict=True):
                outer = u[where][:, :, None] * c[where][:, None, :]
                part += (outer + outer.mT) / (2 * len(hessian.views))
        total += parts.sum(dim=0)
        squares += parts.square().sum(dim=0)
    mean = total / samples
    spread = (squares / samples - mean.square()).clamp_min(0) / (samples - 1)
    return BlockEstimate(mean, spread.sqrt())


def _require_samples(samples: int, least: int) -> None:
    if samples < least:
        raise InputError(f"expected at least {least} samples, got {samples}")


def _sizes(samples: int, most: int) -> list[int]:
    """Sizes of groups of at most so many samples, equal to within one."""
    count = ceil(samples / most)
    return [samples // count + (index < samples % count) for index in range(count)]


def _sampled(
    hessian: RendererHessian, generator: torch.Generator, count: int
) -> Iterator[tuple[Float[Tensor, "n count"], Float[Tensor, "n count"]]]:
    """u and c of each view, for so many samples."""
    for index in range(len(hessian.views)):
        view = hessian.linear(index)
        Z = draw_probes(view.free.numel(), count, generator, view.free.dtype)
        diagonal = _diagonal(view, generator)
        columns = [], []
        for z in Z.T:
            z = z.reshape(view.free.shape)
            if diagonal is None:
                pair = hessian.parameters.vjp(view.image, z, keep=True), view.curvature(z)
                columns[0].append(pair[0])
                columns[1].append(hessian.parameters.vjp(view.image, pair[1], keep=True))
            else:
                columns[0].append(hessian.parameters.vjp(view.image, diagonal.sqrt() * z, keep=True))
        U = torch.stack(columns[0], dim=1)
        C = torch.stack(columns[1], dim=1) if columns[1] else U
        require_finite(hessian, bool(torch.isfinite(U).all() and torch.isfinite(C).all()))
        yield U, C


def _diagonal(view: LinearView, generator: torch.Generator) -> Tensor | None:
    """l'' where it is diagonal and not negative, else None."""
    signs = draw_probes(view.free.numel(), 2, generator, view.free.dtype, "rademacher")
    once, again = (s * view.curvature(s) for s in (sign.reshape(view.free.shape) for sign in signs.T))
    tolerance = SAME * torch.finfo(once.dtype).eps * once.abs().max()
    return once if bool((once >= 0).all() and ((once - again).abs() <= tolerance).all()) else None
