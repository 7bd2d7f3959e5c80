"""Traces of the diagonal blocks H_bb of H, each with a confidence interval.

    method "hutchinson"  mean of z^T H z over probes z (`hutchinson`); its interval is derived in `quadratic`
        reading "block"  z is zero outside one block: a matvec for each block and probe.  Variance 2 |H_bb|_F^2 for Gaussian z,
                         the same without the diagonal of H_bb for Rademacher z
        reading "full"   z covers all rows, and each block sums its part of z * (H z): a matvec for each probe.  Unbiased, as
                         the cross terms have mean zero; each other block c adds |H_bc|_F^2 to the variance
    method "auto"        the default: Hutchinson, until its probes show that XTrace or every column of the identity does better
                         (`choice`).  With the reading "full" it is always Hutchinson
    method "hutch++"     exact on the range of a sketch H S, Hutchinson on the rest (`sketched`)
    method "xtrace"      each test vector in turn is the probe for what the sketch of the others leaves out (`sketched`)

The last two pay where a few eigenvalues dominate: their errors fall like 1 / matvecs or faster, and Hutchinson's like
1 / sqrt(matvecs), with a smaller constant on a flat spectrum.  The default keeps at most max_probes / 2 probes with their
products, and XTrace twice as many vectors more, within `TraceSettings.memory`.
"""

from collections.abc import Mapping, Sequence
from statistics import NormalDist

import torch

from landscape.errors import InputError
from landscape.operators.operator import RestrictedOperator, SymmetricOperator
from landscape.probes import spawn
from landscape.results import Progress
from landscape.traces.choice import chosen
from landscape.traces.estimate import TraceEstimate
from landscape.traces.hutchinson import Hutchinson, TraceSettings
from landscape.traces.sketched import hutch_plus_plus, xtrace

PAPER = TraceSettings.fixed(10, "gaussian")
"""StableGS's estimator, Eq. (6): ten Gaussian probes on one block at a time."""
ESTIMATORS = {"auto": chosen, "hutch++": hutch_plus_plus, "xtrace": xtrace}


def total_trace(traces: Mapping[str, TraceEstimate]) -> tuple[float, float]:
    """The sum of the traces, and a bound on its standard error.

    The bound is the sum of all errors, because these may be correlated.  An error is half the width of the interval over the
    normal quantile, which is larger than the standard error where there are few samples.
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
    """The trace of each named block (None: of all blocks) with standard error and interval, by name.

    settings: by default, to 5% with 95% confidence from 8 to 100 probes a block.  Progress counts matvecs.  With the reading
    "full" all estimates share probes and matvecs, and so are correlated.  Raises InputError for an unknown block.

    >>> from landscape.operators.operator import DenseOperator
    >>> H = DenseOperator(torch.diag(torch.tensor([1.0, 2.0, 3.0])))
    >>> estimate_traces(H, torch.Generator().manual_seed(0))["all"].value  # Rademacher probes are exact for a diagonal matrix
    6.0
    """
    names = list(operator.blocks) if blocks is None else list(blocks)
    unknown = [name for name in names if name not in operator.blocks]
    if unknown:
        raise InputError(f"expected blocks out of {', '.join(operator.blocks)}, got {unknown[0]!r}")
    if settings.reading == "full":
        rows = {name: operator.blocks[name] for name in names}
        return Hutchinson(operator, rows, spawn(generator), settings).estimate(progress)
    estimates: dict[str, TraceEstimate] = {}
    most = len(names) * settings.max_probes
    for index, name in enumerate(names):
        block, stream = RestrictedOperator(operator, name), spawn(generator)
        before = index * settings.max_probes
        report = progress and (lambda done, _, state, before=before: progress(before + done, most, state))
        if settings.method == "hutchinson":
            estimates |= Hutchinson(block, block.blocks, stream, settings).estimate(report)
        else:
            estimates[name] = ESTIMATORS[settings.method](block, stream, settings, name)
            if report:
                report(settings.max_probes, most, f"trace of {name}: {estimates[name].matvecs} matvecs")
    return estimates
