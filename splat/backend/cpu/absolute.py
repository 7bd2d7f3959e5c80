"""|A| of many small symmetric matrices: their eigenvalues' absolute values, by Jacobi's rotations, a matrix in every lane.

A rotation of rows and columns p < q by the angle whose tangent is t makes a_pq 0 (Golub and Van Loan, Sec. 8.5):

    tau = (a_qq - a_pp) / (2 a_pq),   t = sign(tau) / (|tau| + sqrt(1 + tau^2)),   c = 1 / sqrt(1 + t^2),   s = t c

All pairs are a sweep; sweeps end where what is beside the diagonal is round-off of every matrix.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.simd import any_lane, broadcast, lanes_of, load, maximum, select, sqrt, store
from splat.backend.cpu.threads import over_range

MOST_SWEEPS = 20


@formula
def rotate_pair(a, i, j, c, s):
    """Vectors x at i and y at j to c x - s y and s x + c y."""
    x, y = load(a, i), load(a, j)
    store(a, i, c * x - s * y)
    store(a, j, s * x + c * y)


@formula
def rotation(a, pp, qq, pq):
    """c and s that make the entries at pq 0; 1 and 0 where they are."""
    beside, zero = load(a, pq), broadcast(a, 0.0)
    any_angle = maximum(beside, -beside) > zero
    tau = (load(a, qq) - load(a, pp)) / select(any_angle, beside + beside, broadcast(a, 1.0))
    size = maximum(tau, -tau)
    t = 1.0 / (size + sqrt(size * size + 1.0))
    t = select(any_angle, select(tau < zero, -t, t), zero)
    c = 1.0 / sqrt(t * t + 1.0)
    return c, t * c


@formula
def unfinished(a, d, width, tolerance):
    """Whether any matrix has more than round-off beside its diagonal."""
    beside, whole = broadcast(a, 0.0), broadcast(a, 0.0)
    for p in range(d):
        for q in range(d):
            x = load(a, (p * d + q) * width)
            whole = whole + x * x
            if p != q:
                beside = beside + x * x
    return any_lane(beside > whole * (tolerance * tolerance))


@kernel
def absolute_groups(start, stop, groups, d, width, tolerance, sweeps):
    """Replace the matrices of each group, (d * d * width), entry by entry with the lanes last."""
    for g in range(start, stop):
        a = groups[g]
        v = np.zeros_like(a)
        for p in range(d):
            store(v, (p * d + p) * width, broadcast(a, 1.0))
        for _ in range(sweeps):
            if not unfinished(a, d, width, tolerance):
                break
            for p in range(d - 1):
                for q in range(p + 1, d):
                    c, s = rotation(a, (p * d + p) * width, (q * d + q) * width, (p * d + q) * width)
                    for k in range(d):
                        rotate_pair(a, (k * d + p) * width, (k * d + q) * width, c, s)
                    for k in range(d):
                        rotate_pair(a, (p * d + k) * width, (q * d + k) * width, c, s)
                        rotate_pair(v, (p * d + k) * width, (q * d + k) * width, c, s)
        scaled = np.empty_like(a)  # rows of v are the eigenvectors
        for k in range(d):
            value = load(a, (k * d + k) * width)
            value = maximum(value, -value)
            for p in range(d):
                store(scaled, (k * d + p) * width, value * load(v, (k * d + p) * width))
        for p in range(d):
            for q in range(d):
                total = broadcast(a, 0.0)
                for k in range(d):
                    total = total + load(v, (k * d + p) * width) * load(scaled, (k * d + q) * width)
                store(a, (p * d + q) * width, total)


def absolute_values(A: Float[Tensor, "n d d"]) -> Float[Tensor, "n d d"]:
    """|A| of finite symmetric matrices on the CPU.

    >>> absolute_values(torch.tensor([[[2.0, 0.0], [0.0, -3.0]]])).tolist()
    [[[2.0, 0.0], [0.0, 3.0]]]
    """
    n, d = A.shape[:2]
    if not n:
        return A
    dtype = torch.empty(0, dtype=A.dtype).numpy().dtype
    width = lanes_of(dtype)
    padded = torch.nn.functional.pad(A.flatten(1), (0, 0, 0, -n % width))
    groups = padded.view(-1, width, d * d).mT.contiguous()
    tolerance = dtype.type(torch.finfo(A.dtype).eps * d)
    over_range(len(groups), absolute_groups, groups.flatten(1).numpy(), d, width, tolerance, MOST_SWEEPS)
    return groups.mT.reshape(-1, d, d)[:n]
