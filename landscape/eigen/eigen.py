"""Eigenpairs at the two ends of the spectrum.

`extreme_eigenpairs` grows one subspace for both ends by a Lanczos recurrence (`krylov`).  A run ends when every
wanted pair has a residual under max(rtol |lambda|, atol), or under the round-off of the matvec, or at its budget.

Why not Davidson's method?  Preconditioned by the blocks of single Gaussians it takes half the products or less, but it may
settle beside an end that only the couplings between Gaussians make.  On a scene of 13,000 Gaussians (400 steps on lego) it took
-0.0149 for the least eigenvalue, which is -0.0646, in 5 of 6 runs; on one of 1,356 it took the second least for the least in 4
of 6.  A recurrence comes across such ends by itself: from the same starts it found them in all 12 runs.
"""

from time import monotonic

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.eigen.krylov import Krylov
from landscape.eigen.pairs import EigenEnds
from landscape.eigen.ritz import EigenSettings, Goal
from landscape.errors import InputError
from landscape.operators.operator import SymmetricOperator
from landscape.results import Progress

__all__ = ["EigenSettings", "extreme_eigenpairs"]


def extreme_eigenpairs(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: EigenSettings = EigenSettings(),
    start: Float[Tensor, "n *k"] | None = None,
    progress: Progress | None = None,
) -> EigenEnds:
    """The largest and smallest eigenvalues with vectors and residuals; by default one of each, to 0.1%.

    start: one or more vectors to begin from, such as those of an earlier checkpoint: the first vector of the recurrence is the
    sum of their directions, scaled to length 1, plus a random vector of length settings.noise; None: it is random.  Progress
    counts matvecs.  ValueError where more pairs are asked for than H has rows.  An end that is not found within the budget
    raises nothing: see its `reason` and residuals.

    >>> from landscape.operators.operator import DenseOperator
    >>> H = DenseOperator(torch.diag(torch.linspace(-1, 3, 50, dtype=torch.float64)))
    >>> ends = extreme_eigenpairs(H, torch.Generator().manual_seed(0), EigenSettings(rtol=1e-8))
    >>> print(f"{float(ends.largest.values):.6f} {float(ends.smallest.values):.6f} {ends.largest.reason}")
    3.000000 -1.000000 tolerance
    """
    n = operator.dim
    if settings.wanted > n:
        raise InputError(f"expected at most {n} eigenpairs of an operator with {n} rows, got {settings.wanted}")
    space = Krylov(operator, generator, settings, start)
    deadline = monotonic() + settings.max_seconds
    strictness, near, before = 1.0, False, None
    while True:
        space.expand(near)
        if space.size < settings.wanted:
            continue
        ritz = space.ritz()
        if progress:
            progress(space.matvecs, settings.max_matvecs, ritz.state())
        spent = space.matvecs + settings.block + settings.wanted + 2 > settings.max_matvecs
        late = monotonic() > deadline
        goal = Goal(strictness * settings.rtol, max(strictness * settings.atol, space.floor(ritz)))
        complete = space.size == n
        # of no more values than wanted, the last may be of the other end
        settled = space.size > settings.wanted and not (space.exhausted(ritz, goal) and ritz.moved(before, goal))
        near, converged = ritz.near(space.seen_noise, goal), complete or (settled and not ritz.open(goal))
        before = ritz.values[ritz.wanted]
        if converged or spent or late:
            ends, more = space.measured(ritz, "time budget" if late else "matvec budget", converged)
            if not more or complete or spent or late:
                return ends
            strictness /= 2
        space.make_room(ritz)
