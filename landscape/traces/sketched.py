"""Traces by sketching: what a few eigenvalues dominate is taken exactly, and only the rest is left to chance.

Hutch++ (Meyer, Musco, Musco and Woodruff 2021), a third of the matvecs each for S, Q and the probes:

    Q = orth(H S),   tr H = tr(Q^T H Q) + tr(P H P),   P = I - Q Q^T,   the last trace by Hutchinson

XTrace (Epperly, Tropp and Webber 2024, in its resphered form), s matvecs each for Omega and Q; no vector
serves one task alone, because each omega_i in turn is the probe for the sketch of the others:

    Q_i = orth(H Omega without its column i),   u = (I - Q_i Q_i^T) omega_i
    t_i = tr(Q_i^T H Q_i) + (n - s + 1) / |u|^2 u^T H u,   tr H ~ mean t_i

All t_i come from one QR: with Y = H Omega = Q R, Q_i spans Q less the unit vector Q s_i, s_i ~ R^-T e_i.  The squared
length of u, replaced by the one it has on average, is random no more.

**Its error.**  The published one, the spread of the t_i over sqrt(s), takes them as independent.  They share their sketch:

    Var(mean) = (V + (s - 1) C) / s,    V = Var t_i,  C = Cov(t_i, t_j);    the spread s_t^2 of the t_i is V - C on average

C is known, too.  Let t_i^j be t_i with j left out of the sketch as well.  Given the other test vectors, t_i^j and t_j^i are
independent and unbiased; so is t_j for any omega_i, of which alone t_i^j depends.  All products but one thus have the mean
(tr H)^2, and

    C = E (t_i - t_i^j) (t_j - t_j^i),      error^2 = s_t^2 / s + |C^|,    C^ the mean over all pairs

without bias but for the modulus, which keeps a C^ that is below zero by chance from shortening the interval.  All t_i^j follow
from the one QR.  Student's interval with s - 1 degrees of freedom covers (2,000 seeds, n = 60, 8 to 27 test vectors, nominal
95%): 93.6 to 96.7% on power laws, clustered, indefinite and flat spectra, and with one dominant eigenvalue; up to 98% where the
spectrum falls exponentially, and above where it has a step at the very size of the sketch.  The published error covers
77 to 93%.

An adaptive run believes an error below its tolerance only if one test vector more leaves it there: errors that are small by
luck go with values that are off (twelve eigenvalues of 1, 12 test vectors, 10%: one run in fourteen ended so, 60% of them
covered; confirmed ones 96.5%, without being wider).

Test vectors are signs where they were probes before (`choice`), and their squared lengths are left as they are.

Products are taken in the operator's dtype, the small matrices in float64.  Directions of H Omega that are round-off alone
are no part of Q and cost nothing: a matrix of low rank r is exact after s + r products.
"""

from dataclasses import replace
from math import inf, sqrt
from time import monotonic

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import column_dots, gram, is_roundoff, norm
from landscape.operators.operator import ProjectedOperator, SymmetricOperator, product
from landscape.probes import draw_probes
from landscape.results import StopReason, t_quantile
from landscape.traces.estimate import TraceEstimate
from landscape.traces.hutchinson import LEAST, Hutchinson, StoppingRule, TraceSettings

EPS = torch.finfo(torch.float64).eps
GIB = 2**30
VECTORS = 4  # kept for each test vector of XTrace
CONFIRMATION = 1  # test vectors more between reaching the tolerance and believing it


def hutch_plus_plus(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: TraceSettings,
    deadline: float = inf,
    name: str = "all",
) -> TraceEstimate:
    """The trace of an operator.

    A third of max_probes, or of the time, goes into the sketch; an adaptive run saves probes on the rest.
    """
    if operator.dim <= settings.max_probes:
        return by_identity(operator, settings, name, generator.device)
    sketch = draw_probes(operator.dim, settings.max_probes // 3, generator, operator.dtype, settings.distribution)
    start, Y = monotonic(), sketch[:, :0]
    for vectors in sketch.split(settings.batch, dim=1):
        Y = torch.cat([Y, _products(operator, vectors, settings)], dim=1)
        if monotonic() - start > (deadline - start) / 3:
            break
    Q, rank = torch.linalg.qr(Y).Q, Y.shape[1]
    known = float((Q.double() * _products(operator, Q, settings).double()).sum())
    rest = ProjectedOperator(operator, lambda V: V - Q @ (Q.T @ V))
    most = settings.max_probes - 2 * rank
    probing = replace(settings, min_probes=min(settings.min_probes, most), max_probes=most, method="hutchinson")
    run = Hutchinson(rest, {name: slice(0, operator.dim)}, generator, probing, deadline, known, 2 * rank)
    return replace(run.estimate()[name], method="hutch++")


def xtrace(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: TraceSettings,
    deadline: float = inf,
    name: str = "all",
    start: tuple[Float[Tensor, "n s"], Float[Tensor, "n s"]] | None = None,
) -> TraceEstimate:
    """The trace of an operator.

    start: test vectors of settings.distribution with their products, to go on from; else their directions are uniform.
    """
    n, most = operator.dim, most_test_vectors(operator, settings)
    if start is None and n <= settings.max_probes:
        return by_identity(operator, settings, name, generator.device)
    if most < LEAST:
        raise InputError(f"expected memory for {VECTORS * LEAST} vectors of {n} numbers, got {settings.memory:g} GiB")
    kind = "gaussian" if start is None else settings.distribution
    count = max(settings.min_probes, settings.least) // 2 if start is None else start[0].shape[1]
    empty = torch.empty(n, 0, dtype=operator.dtype, device=generator.device if start is None else start[0].device)
    Omega, Y, Q, HQ = (empty,) * 4
    looks = StoppingRule(count, most, CONFIRMATION)
    while True:
        Z = draw_probes(n, count - Omega.shape[1], generator, operator.dtype, kind) if start is None else start[0]
        HZ = _products(operator, Z, settings) if start is None else start[1]
        start, Omega, Y = None, torch.cat([Omega, Z], dim=1), torch.cat([Y, HZ], dim=1)
        new = added_directions(Q, HZ)
        Q, HQ = torch.cat([Q, new], dim=1), torch.cat([HQ, _products(operator, new, settings)], dim=1)
        samples, without = _leave_out(Omega, Y, Q, HQ, kind == "gaussian")
        value, error, spent = float(samples.mean()), _error(samples, without), count + Q.shape[1]
        half = t_quantile(count - 1, settings.confidence) * error
        late, reached = monotonic() > deadline, settings.reached(value, value - half, value + half)
        complete = Q.shape[1] < count  # H has no more directions: the trace is that of Q^T H Q
        if late or (reached and complete) or looks.end(count, reached):
            reason: StopReason = "tolerance" if reached else "time budget" if late else "matvec budget"
            interval = value, error, value - half, value + half, settings.confidence
            return TraceEstimate(name, n, *interval, count, spent, reason, samples, "xtrace")
        count = looks.next
        if spent + n <= 2 * count:
            return by_identity(operator, settings, name, generator.device, spent)


def most_test_vectors(operator: SymmetricOperator, settings: TraceSettings) -> int:
    """How many XTrace may have: two products and VECTORS vectors each."""
    size = max(operator.dim, 1) * torch.empty((), dtype=operator.dtype).element_size()
    return min(settings.max_probes // 2, int(settings.memory * GIB / size) // VECTORS)


def added_directions(Q: Float[Tensor, "n r"], Y: Float[Tensor, "n s"]) -> Float[Tensor, "n a"]:
    """Orthonormal directions that Y adds to those of Q, round-off left out."""
    rest = Y.clone(memory_format=torch.contiguous_format)
    for _ in range(2):
        rest -= Q @ (Q.T @ rest)
    basis, R = torch.linalg.qr(rest)
    U, sigma, _ = torch.linalg.svd(R.double())
    scale = max(norm(y) for y in Y.T)
    return basis @ U[:, [not is_roundoff(float(x), scale, Y.dtype) for x in sigma]].to(basis.dtype)


def _error(samples: Tensor, without: Tensor) -> float:
    """The root of the spread of the mean and the modulus of the covariance."""
    count = len(samples)
    unit = float(samples.abs().max()) or 1.0  # of squares that leave the range of floats
    samples, changes = samples / unit, ((samples - without) / unit).fill_diagonal_(0)
    covariance = float((changes * changes.T).sum()) / (count * (count - 1))
    return unit * sqrt(float(samples.var()) / count + abs(covariance))


def _leave_out(
    Omega: Tensor, Y: Tensor, Q: Tensor, HQ: Tensor, spherical: bool
) -> tuple[Float64[Tensor, " s"], Float64[Tensor, "s s"]]:
    """t_j of every test vector; and in row i, column j that without the i-th one.

    Without the columns in P the sketch spans Q less Q S_P; all of Q where Y has a lower rank than columns, as any columns
    but one span it then.  With g = S_P^T S_P, b = S_P^T w, y = g^-1 b and w = Q^T omega: u = omega - Q (w - S_P y), whose
    square and whose u^T H u follow from products of small matrices.  spherical: lengths of u are replaced.
    """
    (n, count), rank = Omega.shape, Q.shape[1]
    R, W, core, T = gram(Q, Y), gram(Q, Omega), gram(Q, HQ), gram(HQ, Omega)
    S, less = R.new_zeros(rank, count), 0
    if rank == count:
        U, sigma, Vh = torch.linalg.svd(R)
        S, less = U @ (Vh / (sigma / sigma[0]).clamp_min(EPS)[:, None]), 1  # R^-T, but for its length
        S = S / S.norm(dim=0)
    angles, b, pull, inner = S.T @ S, S.T @ W, S.T @ (T - core @ W), S.T @ core @ S
    squares = column_dots(Omega, Omega) - W.square().sum(dim=0)
    products = column_dots(Omega, Y) - 2 * (W * T).sum(dim=0) + (W * (core @ W)).sum(dim=0)
    own, b_own, pull_own = inner.diagonal(), b.diagonal(), pull.diagonal()
    quadratic = products + 2 * b_own * pull_own + b_own.square() * own
    length = (n - rank + less) / (squares + b_own.square()) if spherical else 1.0
    t = core.trace() - own + length * quadratic
    # row i is left out, column j tested
    det = (1 - angles.square()).fill_diagonal_(1)
    y, y_own = (b - angles * b_own) / det, (b_own - angles * b) / det
    squares = squares + b * y + b_own * y_own
    quadratic = products + 2 * (y * pull + y_own * pull_own)
    quadratic = quadratic + y.square() * own[:, None] + 2 * y * y_own * inner + y_own.square() * own
    left = core.trace() - (own[:, None] + own - 2 * angles * inner) / det
    length = (n - rank + 2 * less) / squares if spherical else 1.0
    return t.cpu(), (left + length * quadratic).cpu()


def by_identity(
    operator: SymmetricOperator, settings: TraceSettings, name: str, device: torch.device, spent: int = 0
) -> TraceEstimate:
    """Where all of a small matrix costs no more than the estimate.  spent: matvecs that it took to know."""
    identity = torch.eye(operator.dim, dtype=operator.dtype, device=device)
    value = float(_products(operator, identity, settings).diagonal().double().sum()) if operator.dim else 0.0
    return TraceEstimate.exact(name, operator.dim, value, settings.confidence, spent + operator.dim)


def _products(operator: SymmetricOperator, V: Tensor, settings: TraceSettings) -> Tensor:
    """H V, `batch` vectors at a time."""
    if V.shape[1] == 0:
        return V
    result = torch.empty_like(V)
    for part, vectors in zip(result.split(settings.batch, dim=1), V.split(settings.batch, dim=1), strict=True):
        part.copy_(product(operator, vectors))
    return result
