"""Eigenpairs at the two ends of the spectrum.

`extreme_eigenpairs` grows one subspace for both ends by a Lanczos recurrence (`krylov`).  A run ends when the
reported residual of every wanted pair is at most max(rtol |lambda|, atol), or at the noise of a matvec, when the basis spans
the whole space, or when the matvecs are spent.  Where the basis spans an invariant subspace, one more step must leave
the wanted values unchanged.

Davidson's method, preconditioned by diagonal blocks, would take fewer products.  But it can miss an extreme eigenvalue that
only the entries outside these blocks make, and converge to its neighbour; a Lanczos recurrence is not blind to them.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.eigen.krylov import Krylov
from landscape.eigen.pairs import EigenEnds
from landscape.eigen.ritz import EigenSettings, Goal
from landscape.errors import InputError
from landscape.operators.checks import require_resolved
from landscape.operators.operator import SymmetricOperator
from landscape.operators.renderer import RendererHessian
from landscape.results import Progress

__all__ = ["EigenSettings", "extreme_eigenpairs", "renderer_eigenpairs"]


def extreme_eigenpairs(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: EigenSettings = EigenSettings(),
    start: Float[Tensor, "n *k"] | None = None,
    progress: Progress | None = None,
) -> EigenEnds:
    """The largest and smallest eigenvalues with vectors and residuals; by default one of each, to a residual of 0.1% of it.

    start: a warm start from one or more vectors, such as eigenvectors of an earlier checkpoint.  The first vector of the
    recurrence is then the sum of their directions, scaled to length 1, plus a random vector of length settings.noise; None: a
    random vector alone.  Progress counts matvecs.  Raises InputError where the operator has fewer rows than
    there are wanted pairs.  An end that is not found within the budget raises nothing: see its `reason` and residuals.

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
    strictness, near, before = 1.0, False, None
    while True:
        space.expand(near)
        if space.size < settings.wanted:
            continue
        ritz = space.ritz()
        if progress:
            progress(space.matvecs, settings.max_matvecs, ritz.state())
        # no room for a step (block), its noise (1), one product of all pairs together (1) and one of each (wanted)
        spent = space.matvecs + settings.block + settings.wanted + 2 > settings.max_matvecs
        # below the noise of a product no residual is asked for
        goal = Goal(strictness * settings.rtol, max(strictness * settings.atol, space.floor(ritz)))
        complete = space.size == n
        # with no more values than wanted pairs, the last one may belong to the other end; in an invariant subspace a copy of
        # a wanted value may be missing until the values stand still
        settled = space.size > settings.wanted and not (space.exhausted(ritz, goal) and ritz.moved(before, goal))
        # an open residual may be the noise of a product: then the next step measures that
        near = ritz.near(space.seen_noise, goal)
        converged = complete or (settled and not ritz.open(goal))
        before = ritz.values[ritz.wanted]
        if converged or spent:
            ends, more = space.measured(ritz, "matvec budget", converged)
            if not more or complete or spent:
                return ends
            # the reported residuals miss the goal that those of the recurrence meet: halve the recurrence's goal
            strictness /= 2
        space.make_room(ritz)


def renderer_eigenpairs(
    hessian: RendererHessian,
    generator: torch.Generator,
    settings: EigenSettings = EigenSettings(),
    start: Float[Tensor, "n *k"] | None = None,
    progress: Progress | None = None,
) -> EigenEnds:
    """`extreme_eigenpairs` of a renderer's Hessian or Gauss-Newton, with residuals that include the errors of products.

    Some eigenvalue of H is within |H~ v - lambda v| + |e| of lambda, for products H~ v with errors e, of which the search sees
    only what is not symmetric: its floor is the error of a random unit vector, and those of the eigenvectors are added.  Where
    they miss the settings' goal, the reason is "noise floor".  InputError where steps do not resolve the products.

    >>> x = torch.tensor([0.5, 2.0], requires_grad=True, dtype=torch.float64)
    >>> H = RendererHessian(lambda t: torch.exp(t * x), {"x": x}, lambda image, t: image.square().sum() / 2, [1.0])
    >>> found = renderer_eigenpairs(H, torch.Generator().manual_seed(0)).largest
    >>> abs(float(found.values) - 2 * 2.718281828459045**4) < float(found.residuals) < 1e-4
    True
    """
    asked, widened = replace(settings, atol=max(settings.atol, require_resolved(hessian, generator))), {}
    ends = extreme_eigenpairs(hessian, generator, asked, start, progress)
    for name in ("largest", "smallest"):
        if len(pairs := getattr(ends, name)):
            residuals = pairs.residuals + hessian.error(pairs.vectors).total.cpu()
            goal = (settings.rtol * pairs.values.abs()).clamp_min(settings.atol)
            missed = pairs.reason == "tolerance" and bool((residuals > goal).any())
            widened[name] = replace(pairs, residuals=residuals, reason="noise floor" if missed else pairs.reason)
    return replace(ends, **widened)
