"""Traces by sketching: exact on the range of a few products, which the large eigenvalues dominate, by probes on the rest.

Hutch++ (Meyer, Musco, Musco and Woodruff 2021), with a third of the matvecs each for H S, H Q and the probes:

    Q = orth(H S),   tr H = tr(Q^T H Q) + tr(P H P),   P = I - Q Q^T,   the last trace by Hutchinson

XTrace (Epperly, Tropp and Webber 2024, in its resphered form), with s matvecs each for H Omega and H Q.  Every test vector
omega_i serves twice: in the sketch of the others, and as the probe for the sketch that the others make:

    Q_i = orth(H Omega without its column i),   u = (I - Q_i Q_i^T) omega_i
    t_i = tr(Q_i^T H Q_i) + (n - s + 1) / |u|^2 u^T H u,   tr H ~ mean t_i

All t_i follow from one QR decomposition Y = H Omega = Q R: the range of Q_i is that of Q without the unit vector Q s_i, where
s_i is the normalised column i of R^-T.  The factor (n - s + 1) / |u|^2 replaces the squared length of u by its expectation.
For random signs (test vectors taken over from Hutchinson's estimator, `choice.py`) the factor is 1.

**The error.**  The published one, the standard deviation of the t_i over sqrt(s), takes the t_i as independent; they share a
sketch, and it is too small.  With V = Var t_i and C = Cov(t_i, t_j)

    Var(mean) = (V + (s - 1) C) / s,    and the sample variance s_t^2 of the t_i has the expectation V - C

To estimate C, let t_i^j be t_i with j left out of the sketch as well.  Given the other test vectors, t_i^j and t_j^i are
independent and unbiased; t_j is unbiased for any omega_i, and t_i^j depends on omega_i only.  All products but t_i t_j
therefore have the mean (tr H)^2, and

    C = E (t_i - t_i^j) (t_j - t_j^i),      error^2 = s_t^2 / s + |C^|,    C^ the mean over all pairs

This is unbiased except for the modulus, which prevents a C^ that is negative by chance from shortening the interval.  The
interval is Student's with s - 1 degrees of freedom.  All t_i^j follow from the one QR decomposition.

An adaptive run stops only if its error is below the tolerance with one test vector more, too: errors that are small by chance
go with values that are off.

Products are computed in the operator's dtype, small matrices in float64.  Directions of H Omega that are only round-off are
left out of Q and cost nothing: a matrix of low rank r is exact after s + r products.
"""

from dataclasses import replace
from math import sqrt

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import column_dots, gram, is_roundoff, norm
from landscape.operators.operator import ProjectedOperator, SymmetricOperator, products
from landscape.probes import draw_probes
from landscape.results import StopReason, t_quantile
from landscape.traces.estimate import TraceEstimate
from landscape.traces.hutchinson import LEAST, Hutchinson, StoppingRule, TraceSettings

EPS = torch.finfo(torch.float64).eps
GIB = 2**30
VECTORS = 4  # kept for each test vector of XTrace: its columns of Omega, Y, Q and H Q
CONFIRMATION = 1  # test vectors between reaching the tolerance and stopping


def hutch_plus_plus(
    operator: SymmetricOperator, generator: torch.Generator, settings: TraceSettings, name: str = "all"
) -> TraceEstimate:
    """The trace of an operator by Hutch++.

    A third of max_probes goes into the sketch.  An adaptive run may use fewer probes for the rest.

    >>> from landscape.operators.operator import DenseOperator
    >>> v = torch.linspace(-1, 1, 101, dtype=torch.float64)
    >>> H = DenseOperator(torch.outer(v, v))  # of rank 1, with the trace |v|^2 = 34.34
    >>> found = hutch_plus_plus(H, torch.Generator().manual_seed(0), TraceSettings.fixed(24, method="hutch++"))
    >>> round(found.value, 9), found.half_width < 1e-9
    (34.34, True)
    """
    if operator.dim <= settings.max_probes:
        return by_identity(operator, settings, name, generator.device)
    # a third of the products: the range of H, as far as random vectors show it
    sketch = draw_probes(operator.dim, settings.max_probes // 3, generator, operator.dtype, settings.distribution)
    Y = products(operator, sketch, settings.batch)
    Q, rank = torch.linalg.qr(Y).Q, Y.shape[1]
    # a second third: the trace within that range, exactly
    known = float((Q.double() * products(operator, Q, settings.batch).double()).sum())
    # the last third: the trace of the rest, by probes
    rest = ProjectedOperator(operator, lambda V: V - Q @ (Q.T @ V))
    most = settings.max_probes - 2 * rank
    probing = replace(settings, min_probes=min(settings.min_probes, most), max_probes=most, method="hutchinson")
    run = Hutchinson(rest, {name: slice(0, operator.dim)}, generator, probing, known, 2 * rank)
    return replace(run.estimate()[name], method="hutch++")


def xtrace(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: TraceSettings,
    name: str = "all",
    start: tuple[Float[Tensor, "n s"], Float[Tensor, "n s"]] | None = None,
) -> TraceEstimate:
    """The trace of an operator by XTrace.

    start: first test vectors, of settings.distribution, and their products; None: test vectors of uniform direction.

    >>> from landscape.operators.operator import DenseOperator
    >>> v = torch.linspace(-1, 1, 101, dtype=torch.float64)
    >>> H = DenseOperator(torch.outer(v, v))  # of rank 1, with the trace |v|^2 = 34.34
    >>> found = xtrace(H, torch.Generator().manual_seed(0), TraceSettings.fixed(24, method="xtrace"))
    >>> round(found.value, 9), found.half_width < 1e-9, found.matvecs  # 12 test vectors and one direction
    (34.34, True, 13)
    """
    n, most = operator.dim, most_test_vectors(operator, settings)
    if start is None and n <= settings.max_probes:
        return by_identity(operator, settings, name, generator.device)
    if most < LEAST:
        raise InputError(f"expected memory for {VECTORS * LEAST} vectors of {n} numbers, got {settings.memory:g} GiB")
    kind = "gaussian" if start is None else settings.distribution
    count = max(settings.min_probes, settings.least) // 2 if start is None else start[0].shape[1]
    Omega, Y, Q, HQ = (torch.empty(n, 0, dtype=operator.dtype, device=generator.device),) * 4
    rule = StoppingRule(count, most, CONFIRMATION)
    while True:
        if start is None:
            Z = draw_probes(n, count - Omega.shape[1], generator, operator.dtype, kind)
            start = Z, products(operator, Z, settings.batch)
        (Z, HZ), start = start, None
        # the sketch grows by the part of the new products that it does not span yet, and by products with that
        Omega, Y = torch.cat([Omega, Z], dim=1), torch.cat([Y, HZ], dim=1)
        new = added_directions(Q, HZ)
        Q, HQ = torch.cat([Q, new], dim=1), torch.cat([HQ, products(operator, new, settings.batch)], dim=1)
        # each test vector judges the sketch of the others
        samples, without = _leave_out(Omega, Y, Q, HQ, kind == "gaussian")
        value, error, spent = float(samples.mean()), _error(samples, without), count + Q.shape[1]
        half = t_quantile(count - 1, settings.confidence) * error
        # stop at the tolerance, at the budget, or once the sketch spans the range of H
        reached = settings.reached(value, value - half, value + half)
        complete = Q.shape[1] < count  # Q spans the range of H: its trace is that of Q^T H Q
        if (reached and complete) or rule.end(count, reached):
            reason: StopReason = "tolerance" if reached else "matvec budget"
            interval = value, error, value - half, value + half, settings.confidence
            return TraceEstimate(name, n, *interval, count, spent, reason, samples, "xtrace")
        # go on with more test vectors, or with the identity where that costs no more
        count = rule.next
        if spent + n <= 2 * count:
            return by_identity(operator, settings, name, generator.device, spent)


def most_test_vectors(operator: SymmetricOperator, settings: TraceSettings) -> int:
    """Largest number of test vectors of XTrace: each takes two products and the memory of VECTORS vectors."""
    size = max(operator.dim, 1) * torch.empty((), dtype=operator.dtype).element_size()
    return min(settings.max_probes // 2, int(settings.memory * GIB / size) // VECTORS)


def added_directions(Q: Float[Tensor, "n r"], Y: Float[Tensor, "n s"]) -> Float[Tensor, "n a"]:
    """An orthonormal basis of the directions that Y adds to the span of Q, without round-off."""
    rest = Y.clone(memory_format=torch.contiguous_format)
    for _ in range(2):
        rest -= Q @ (Q.T @ rest)
    basis, R = torch.linalg.qr(rest)
    U, sigma, _ = torch.linalg.svd(R.double())
    scale = max(norm(y) for y in Y.T)
    return basis @ U[:, [not is_roundoff(float(x), scale, Y.dtype) for x in sigma]].to(basis.dtype)


def _error(samples: Tensor, without: Tensor) -> float:
    """sqrt(s_t^2 / s + |C^|), with `without` as from `_leave_out`."""
    count = len(samples)
    unit = float(samples.abs().max()) or 1.0  # so that squares stay in the range of floats
    samples, changes = samples / unit, ((samples - without) / unit).fill_diagonal_(0)
    covariance = float((changes * changes.T).sum()) / (count * (count - 1))
    return unit * sqrt(float(samples.var()) / count + abs(covariance))


def _leave_out(
    Omega: Tensor, Y: Tensor, Q: Tensor, HQ: Tensor, spherical: bool
) -> tuple[Float64[Tensor, " s"], Float64[Tensor, "s s"]]:
    """All t_j; and t_j^i, without test vector i in the sketch either, in row i and column j.

    spherical: apply the factor (n - s + 1) / |u|^2.  Without the test vectors in a set P the sketch is Q without Q S_P.  With
    g = S_P^T S_P, b = S_P^T w, y = g^-1 b and w = Q^T omega: u = omega - Q (w - S_P y), so that |u|^2 and u^T H u follow from
    products of small matrices.
    """
    (n, count), rank = Omega.shape, Q.shape[1]
    # all that is large enters by these small products: R = Q^T Y, W = Q^T Omega, core = Q^T H Q, T = Q^T H Omega
    R, W, core, T = gram(Q, Y), gram(Q, Omega), gram(Q, HQ), gram(HQ, Omega)
    found = left_out_directions(R)
    # s_i: what the sketch loses without test vector i (nothing where the others span all of Q)
    S, less = (R.new_zeros(rank, count), 0) if found is None else (found, 1)  # less: dimensions that a test vector adds
    # of every pair of s_i and s_j, or of s_i and u of the whole sketch: angles, projections of Omega, slopes and curvatures
    angles, b, pull, inner = S.T @ S, S.T @ W, S.T @ (T - core @ W), S.T @ core @ S
    # |u|^2 and u . H u with the whole sketch, u = (1 - Q Q^T) omega
    squares = column_dots(Omega, Omega) - W.square().sum(dim=0)
    products = column_dots(Omega, Y) - 2 * (W * T).sum(dim=0) + (W * (core @ W)).sum(dim=0)
    inner_jj, b_jj, pull_jj = inner.diagonal(), b.diagonal(), pull.diagonal()
    # t_j, without s_j: u gains b_jj s_j, which changes |u|^2, u . H u, and the trace within the sketch
    quadratic = products + 2 * b_jj * pull_jj + b_jj.square() * inner_jj
    length = (n - rank + less) / (squares + b_jj.square()) if spherical else 1.0
    t = core.trace() - inner_jj + length * quadratic
    # t_j^i, i in rows and j in columns: P = {i, j}, a 2 x 2 system for y = (y_i, y_j)
    det = (1 - angles.square()).fill_diagonal_(1)
    y_i, y_j = (b - angles * b_jj) / det, (b_jj - angles * b) / det
    # |u|^2 and u . H u gain the parts along s_i and s_j
    squares = squares + b * y_i + b_jj * y_j
    quadratic = products + 2 * (y_i * pull + y_j * pull_jj)
    quadratic = quadratic + y_i.square() * inner_jj[:, None] + 2 * y_i * y_j * inner + y_j.square() * inner_jj
    # the trace within the sketch loses that of the plane of s_i and s_j
    trace = core.trace() - (inner_jj[:, None] + inner_jj - 2 * angles * inner) / det
    length = (n - rank + 2 * less) / squares if spherical else 1.0
    return t.cpu(), (trace + length * quadratic).cpu()


def left_out_directions(R: Float64[Tensor, "r s"]) -> Float64[Tensor, "r s"] | None:
    """Columns of R^-T, normalised: unit vectors s_i such that Q R without its column i spans Q without Q s_i.

    None where R has fewer rows than columns: then the other columns span all of Q.
    """
    if R.shape[0] < R.shape[1]:
        return None
    U, sigma, Vh = torch.linalg.svd(R)
    S = U @ (Vh / (sigma / sigma[0]).clamp_min(EPS)[:, None])  # R^-T times sigma[0]
    return S / S.norm(dim=0)


def by_identity(
    operator: SymmetricOperator, settings: TraceSettings, name: str, device: torch.device, spent: int = 0
) -> TraceEstimate:
    """The exact trace, from the product with every column of the identity.  spent: matvecs used before."""
    identity = torch.eye(operator.dim, dtype=operator.dtype, device=device)
    value = float(products(operator, identity, settings.batch).diagonal().double().sum()) if operator.dim else 0.0
    return TraceEstimate.exact(name, operator.dim, value, settings.confidence, spent + operator.dim)
