"""Eigenpairs at the two ends of the spectrum.

`extreme_eigenpairs` grows one subspace for both ends (`subspace`): by a Lanczos recurrence (`krylov`) or, where an
approximation of the operator is known, by Davidson's method (`davidson`), which then needs half the products and less.  A run
ends when every wanted pair has a residual under max(rtol |lambda|, atol), or under the round-off of the matvec, or at its
budget.
"""

from time import monotonic

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.davidson import Approximation, Davidson
from landscape.krylov import Krylov
from landscape.operator import SymmetricOperator
from landscape.results import EigenEnds, Progress
from landscape.subspace import EigenSettings, Goal, Subspace

__all__ = ["Approximation", "EigenSettings", "extreme_eigenpairs"]


def extreme_eigenpairs(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: EigenSettings = EigenSettings(),
    start: Float[Tensor, "n *k"] | None = None,
    progress: Progress | None = None,
    approximation: Approximation | None = None,
) -> EigenEnds:
    """The largest and smallest eigenvalues with vectors and residuals.

    start: vectors to begin from (those of an earlier checkpoint, say); a recurrence begins at the sum of their directions with
    a random vector of settings.noise of its length, Davidson's method at each of them and a random one.  approximation: of the
    operator, for Davidson's method, where settings.basis has room for it.  Progress counts matvecs.

    >>> from landscape.operator import DenseOperator
    >>> H = DenseOperator(torch.diag(torch.linspace(-1, 3, 50, dtype=torch.float64)))
    >>> ends = extreme_eigenpairs(H, torch.Generator().manual_seed(0), EigenSettings(rtol=1e-8))
    >>> print(f"{float(ends.largest.values):.6f} {float(ends.smallest.values):.6f} {ends.largest.reason}")
    3.000000 -1.000000 tolerance
    """
    n = operator.dim
    if settings.wanted > n:
        raise ValueError(f"expected at most {n} eigenpairs of an operator with {n} rows, got {settings.wanted}")
    space: Subspace
    if approximation is None or not Davidson.fits(settings):
        space = Krylov(operator, generator, settings, start)
    else:
        space = Davidson(operator, generator, settings, approximation, start)
    deadline = monotonic() + settings.max_seconds
    strictness, near = 1.0, False
    while True:
        space.expand(near)
        if space.size < settings.wanted:
            continue
        ritz = space.ritz()
        if progress:
            progress(space.matvecs, settings.max_matvecs, ritz.state())
        spent = space.matvecs + space.most + settings.wanted + 2 > settings.max_matvecs
        late = monotonic() > deadline
        goal = Goal(strictness * settings.rtol, max(strictness * settings.atol, space.floor(ritz)))
        complete = space.size == n
        near, converged = ritz.near(space.seen_noise, goal), complete or (space.certain and not ritz.open(goal))
        if converged or spent or late:
            ends, more = space.measured(ritz, "time budget" if late else "matvec budget", converged)
            if not more or complete or spent or late:
                return ends
            strictness /= 2
        space.aim(ritz, goal)
