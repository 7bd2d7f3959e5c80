"""Directions for slices, as columns (n, d), in the units of the parameters and in the dtype of the argument.

    random, filter-normalised   d_g <- d_g |theta_g| / |d_g| for every group g of parameters (a filter, or one attribute of one
                                item): a step of 1 changes each group by its size (Li et al. 2018, Sec. 4)
    gradient                    g / |g|, the steepest ascent
    line                        theta_1 - theta_0: the coordinate 0 is the first point, 1 the second
    orthonormal                 the same line or plane, from unit directions at right angles; the first one is kept

Eigenvectors come from `landscape.extreme_eigenpairs(...).largest.vectors`.
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float, Int
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import column_lengths, group_sums
from landscape.operators.operator import require_blocks

SMALLEST_SINE = (
    1e-6  # of the angle between two directions that span a plane: a smaller one is mostly round-off in float32
)


def groups_of(blocks: Mapping[str, slice], items: int, n: int) -> Int[Tensor, " n"]:
    """The group of every parameter, for `random_directions`: each item of each block is a separate group.

    blocks: ranges of the n parameters, each of `items` items of equal length one after the other (for a scene: the positions of
    all Gaussians, then all opacities, ...).  Raises ValueError where a block cannot be divided into that many items.

    >>> groups_of({"position": slice(0, 6), "weight": slice(6, 8)}, items=2, n=8)
    tensor([0, 0, 0, 1, 1, 1, 2, 3])
    """
    groups, count = torch.empty(n, dtype=torch.int64), 0
    for name, rows in require_blocks(blocks, n).items():
        length = rows.stop - rows.start
        if items < 1 or length % items:
            raise ValueError(f"expected blocks of {items} items, got {length} parameters in {name}")
        groups[rows] = count + torch.arange(items).repeat_interleave(length // items)
        count += items
    return groups


def random_directions(
    center: Float[Tensor, " n"], groups: Int[Tensor, " n"], generator: torch.Generator, count: int = 2
) -> Float[Tensor, "n {count}"]:
    """`count` Gaussian directions, filter-normalised: in every group as long as the group's parameters.

    groups[i]: the number (from 0) of the group of parameter i.  A group of parameters that are all 0 does not move.

    >>> groups = torch.tensor([0, 0, 1])
    >>> d = random_directions(torch.tensor([3.0, 4.0, -0.5]), groups, torch.Generator().manual_seed(0), count=1)
    >>> d[:2].norm().round(decimals=5), d[2].abs()
    (tensor(5.), tensor([0.5000]))
    """
    if groups.shape != center.shape or center.ndim != 1 or groups.is_floating_point() or (groups < 0).any():
        raise ValueError(
            f"expected one group number, from 0, for each of {center.numel()} parameters, got {groups.dtype} of shape "
            f"{tuple(groups.shape)}"
        )
    d = torch.empty(center.numel(), count, dtype=torch.float64, device=generator.device)
    d, groups = d.normal_(generator=generator).to(center.device), groups.to(center.device)
    sizes = _lengths(center.detach().double()[:, None], groups) / _lengths(d, groups)
    d *= sizes[groups]
    if not (torch.isfinite(d).all() and d.any()):
        raise InputError("expected parameters that are finite and not all zero, got others; normalise by other sizes")
    return d.to(center.dtype)


def _lengths(rows: Float[Tensor, "n k"], groups: Int[Tensor, " n"]) -> Float[Tensor, "g k"]:
    """The norm over each group; 1 for numbers that no parameter has."""
    number = int(groups.max()) + 1
    squares = group_sums(rows.square(), groups, number)
    used = rows.new_zeros(number, dtype=torch.bool).index_fill_(0, groups, True)
    return torch.where(used[:, None], squares.sqrt(), 1.0)


def gradient_direction(gradient: Float[Tensor, " n"]) -> Float[Tensor, "n 1"]:
    """The unit vector of steepest ascent.

    >>> gradient_direction(torch.tensor([0.0, -2.0]))
    tensor([[ 0.],
            [-1.]])
    """
    if gradient.ndim != 1:
        raise ValueError(f"expected a flat gradient, got shape {tuple(gradient.shape)}")
    column = gradient[:, None]
    return (column.double() / column_lengths(column, "gradients")).to(gradient.dtype)


def line_between(start: Float[Tensor, " n"], end: Float[Tensor, " n"]) -> Float[Tensor, "n 1"]:
    """end - start, not normalised: in a slice with center = start, the coordinate 0 is start and 1 is end.

    >>> line_between(torch.tensor([1.0, 2.0]), torch.tensor([1.0, 5.0])).T
    tensor([[0., 3.]])
    """
    if start.ndim != 1 or start.shape != end.shape:
        raise InputError(
            f"expected two checkpoints with the same parameters, got {tuple(start.shape)} and {tuple(end.shape)}; "
            "densification changes their number: compare checkpoints after it has ended"
        )
    difference = end.double() - start.double()
    if not torch.isfinite(difference).all():
        raise InputError("expected two checkpoints with finite parameters, got one that has others")
    if not difference.any():
        raise InputError("expected two checkpoints that differ, got equal ones; name another second one")
    return difference.to(start.dtype)[:, None]


def orthonormal(directions: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
    """Unit directions at right angles: the first one, and the part of each other one that is orthogonal to those before.

    Raises InputError where one is zero or not finite, or lies in the span of earlier ones.

    >>> orthonormal(torch.tensor([[3.0, 1.0], [4.0, 1.0]]))
    tensor([[ 0.6000,  0.8000],
            [ 0.8000, -0.6000]])
    """
    q, r = torch.linalg.qr(directions.double() / column_lengths(directions, "directions"))
    sines = r.diagonal()
    if (sines.abs() < SMALLEST_SINE).any():
        raise InputError(
            f"expected directions that are not parallel, got sines {sines.abs().tolist()} of their angles to those before"
        )
    return (q * sines.sign()).to(directions.dtype)
