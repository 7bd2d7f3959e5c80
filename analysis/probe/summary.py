"""A probe in six lines, for the terminal, and what has to be said beside them."""

from itertools import pairwise
from pathlib import Path

from analysis.records.findings import Line, findings, is_open
from analysis.records.quantities import UNDETERMINED, limits, measured, quantity
from analysis.records.records import ProbeRecord
from analysis.records.schema import Index, Trace

SHORT = {"means": "position", "log_scales": "scale", "quats": "rotation", "opacity_logits": "opacity", "sh": "SH"}


def summary(data: ProbeRecord, report: Path) -> list[str]:
    """What scene, both ends of the spectrum, the traces' order, an index, the checks, and the page to open."""
    counts, made = data.counts, data.provenance
    scene = f"{made.scene or 'scene'} after {made.iteration or 0:,} steps"
    return [
        f"scene   {scene}: {counts.views} views, {counts.visible_gaussians:,} Gaussians in sight",
        f"ends    {_ends(data)}",
        f"traces  {_order(data.traces)}",
        f"index   {_index(data)}",
        f"checks  {_checks(data)}; {data.timing['total']:.0f} s",
        f"report  {report}",
    ]


def remarks(data: ProbeRecord, verbose: bool) -> list[Line]:
    """What failed and what is not known; verbose: every caution."""
    levels = ("failure", "open", "caution") if verbose else ("failure", "open")
    return [line for line in findings(data) if line.level in levels]


def _ends(data: ProbeRecord) -> str:
    texts = []
    for end in (data.eigenvalues.min, data.eigenvalues.max):
        reached = not (end.reason or "").endswith("budget")
        texts.append(measured(end.value, end.residual) if reached else f"{UNDETERMINED} (not reached)")
    return f"curvature from {texts[0]} to {texts[1]}"


def _order(traces: dict[str, Trace]) -> str:
    """Traces by size; ≈ between two that are within two standard errors of each other."""
    ranked = sorted(traces.items(), key=lambda item: -abs(item[1].value or 0.0))
    texts = [f"{SHORT.get(name, name)} {quantity(trace.value)}" for name, trace in ranked]
    signs = []
    for (_, first), (_, second) in pairwise(ranked):
        apart = abs(first.value or 0.0) - abs(second.value or 0.0)
        error = ((first.standard_error or 0.0) ** 2 + (second.standard_error or 0.0) ** 2) ** 0.5
        signs.append(" > " if apart > 2 * error else " ≈ ")
    return "".join(part for pair in zip(texts, [*signs, ""], strict=True) for part in pair)


def _index(data: ProbeRecord) -> str:
    """The first of the literal index and what stands for it that is known, with its bracket."""
    for name, words in (("literal", "λ max / λ min"), ("share", "share of λ max in all curvature")):
        index: Index | None = getattr(data.anisotropy, name) or None
        if index and not is_open(index) and index.low is not None and index.high is not None:
            low, high = limits(index.low, index.high)
            error = max(index.high - (index.value or 0.0), (index.value or 0.0) - index.low)
            narrow = error < 0.1 * abs(index.value or 0.0)
            return f"{words} = " + (
                measured(index.value, error) if narrow else f"{quantity(index.value)}, between {low} and {high}"
            )
    return f"λ max / λ min = {UNDETERMINED}"


def _checks(data: ProbeRecord) -> str:
    passed = sum(check.passed is True for check in data.checks.values())
    if passed == len(data.checks):
        return f"all {passed} passed"
    return f"{passed} of {len(data.checks)} passed"
