"""Traces of the diagonal blocks H_bb of H, each with an interval that covers the truth as often as it says.

    method "hutchinson"  mean of z^T H z over probes z (`hutchinson`); the interval is derived in `quadratic`
        reading "block"  z lives on one block at a time: a matvec per block and probe.  Variance 2 |H_bb|_F^2 for
                         Gaussian z, the same without the diagonal of H_bb for Rademacher z.
        reading "full"   z lives on all rows and every block reads its part of z * (H z): a matvec per probe for all
                         blocks.  Unbiased, because the cross terms vanish in expectation; each other block c adds
                         |H_bc|_F^2 to the variance.
    method "auto"        the default: Hutchinson, unless its first probes tell that XTrace, or every column of the identity,
                         does better (`choice`); with the reading "full" it stays Hutchinson
    method "hutch++"     exact on the range of a sketch H S, Hutchinson on the rest (`sketched`)
    method "xtrace"      every test vector in turn on the rest that the sketch of the others leaves (`sketched`)

The last two pay where a few eigenvalues dominate, with errors that fall like 1 / matvecs and faster; Hutchinson's fall like
1 / sqrt(matvecs), and are the smaller ones on a flat spectrum.  The default keeps up to max_probes / 2 probes with their
products and, as XTrace, twice as many vectors more, within `TraceSettings.memory`.

`PAPER` is StableGS's estimator, Eq. (6): Gaussian z, one block at a time, ten probes.
"""

from collections.abc import Mapping, Sequence
from statistics import NormalDist
from time import monotonic

import torch

from landscape.errors import InputError
from landscape.operators.operator import RestrictedOperator, SymmetricOperator
from landscape.probes import split
from landscape.results import Progress
from landscape.traces.choice import chosen
from landscape.traces.estimate import TraceEstimate
from landscape.traces.hutchinson import Hutchinson, TraceSettings
from landscape.traces.sketched import hutch_plus_plus, xtrace

PAPER = TraceSettings.fixed(10, "gaussian")
"""StableGS's estimator, Eq. (6)."""
ESTIMATORS = {"auto": chosen, "hutch++": hutch_plus_plus, "xtrace": xtrace}


def total_trace(traces: Mapping[str, TraceEstimate]) -> tuple[float, float]:
    """The sum of the traces, and a bound of its standard error: the sum of theirs, as their errors may be correlated.

    Each error is taken from the interval: its half width over the normal quantile, so that few samples count as uncertain.
    """
    errors = [x.half_width / NormalDist().inv_cdf((1 + x.confidence) / 2) for x in traces.values()]
    return sum(x.value for x in traces.values()), sum(errors)


def estimate_traces(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: TraceSettings = TraceSettings(),
    blocks: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> dict[str, TraceEstimate]:
    """The trace of each named block (all of the operator's where None) with its standard error and interval, by name.

    settings: by default to 5% with 95% confidence, from 8 to 100 probes a block.  Progress counts matvecs.  With the reading
    "full" all estimates share probes and matvecs, hence are correlated.  ValueError where a block is not the operator's.

    >>> from landscape.operators.operator import DenseOperator
    >>> H = DenseOperator(torch.diag(torch.tensor([1.0, 2.0, 3.0])))
    >>> estimate_traces(H, torch.Generator().manual_seed(0))["all"].value  # Rademacher is exact on a diagonal
    6.0
    """
    names = list(operator.blocks) if blocks is None else list(blocks)
    unknown = [name for name in names if name not in operator.blocks]
    if unknown:
        raise InputError(f"expected blocks out of {', '.join(operator.blocks)}, got {unknown[0]!r}")
    deadline = monotonic() + settings.max_seconds
    if settings.reading == "full":
        rows = {name: operator.blocks[name] for name in names}
        run = Hutchinson(operator, rows, split(generator), settings, deadline)
        return run.estimate(0, settings.max_probes, progress)
    estimates: dict[str, TraceEstimate] = {}
    most = len(names) * settings.max_probes
    for index, name in enumerate(names):
        block, own, before = RestrictedOperator(operator, name), split(generator), index * settings.max_probes
        # what is left of the time is shared evenly among the blocks to come
        end = monotonic() + max(deadline - monotonic(), 0) / (len(names) - index)
        if settings.method == "hutchinson":
            estimates |= Hutchinson(block, block.blocks, own, settings, end).estimate(before, most, progress)
        else:
            estimates[name] = ESTIMATORS[settings.method](block, own, settings, end, name)
            if progress:
                progress(before + settings.max_probes, most, f"trace of {name}: {estimates[name].matvecs} matvecs")
    return estimates
