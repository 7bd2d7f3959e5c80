"""A probe in six lines, for the terminal, and what has to be said beside them."""

from itertools import pairwise
from pathlib import Path

from analysis.records.findings import Line, findings, is_loose
from analysis.records.quantities import UNDETERMINED, apart, limits, measured, quantity
from analysis.records.records import Check, Counts, ProbeRecord
from analysis.records.schema import Index, Trace

SHORT = {"means": "position", "log_scales": "scale", "quats": "rotation", "opacity_logits": "opacity", "sh": "SH"}


def summary(data: ProbeRecord, report: Path) -> list[str]:
    """Lines on the scene, both ends of the spectrum, the traces' order, an index, the checks, and the page to open."""
    counts, made = data.counts, data.provenance
    scene = f"{made.scene or 'scene'} after {made.iteration or 0:,} steps"
    return [
        f"scene   {scene}: {_views(counts)}, {counts.visible_gaussians:,} Gaussians in sight",
        f"ends    {_ends(data)}",
        f"traces  {_order(data.traces)}",
        f"index   {_index(data)}",
        f"checks  {_checks(data)}; {data.timing['total']:.0f} s",
        f"report  {report}",
    ]


def _views(counts: Counts) -> str:
    """Number of views; where some were left out, what stands beside the numbers."""
    if not counts.views_of:
        return f"{counts.views} views"
    return f"{counts.views} of {counts.views_of} views (∓: what the others may change)"


def remarks(data: ProbeRecord, verbose: bool) -> list[Line]:
    """Remarks on what failed and what is not known; verbose: every caution."""
    levels = ("failure", "open", "caution") if verbose else ("failure", "open")
    return [line for line in findings(data) if line.level in levels]


def _ends(data: ProbeRecord) -> str:
    texts = []
    for end in (data.eigenvalues.min, data.eigenvalues.max):
        value = measured(end.value, end.residual) + apart(end.views_error)
        texts.append(value if end.is_reached else f"{UNDETERMINED} (not reached)")
    return f"curvature from {texts[0]} to {texts[1]}"


def _order(traces: dict[str, Trace]) -> str:
    """Traces by size; ≈ between two that are within two standard errors of each other, or whose errors are not known."""
    ranked = sorted(traces.items(), key=lambda item: -abs(item[1].value or 0.0))
    texts = [f"{SHORT.get(name, name)} {quantity(trace.value)}{apart(trace.views_error)}" for name, trace in ranked]
    signs = [" > " if first.exceeds(second) else " ≈ " for (_, first), (_, second) in pairwise(ranked)]
    return "".join(part for pair in zip(texts, [*signs, ""], strict=True) for part in pair)


def _index(data: ProbeRecord) -> str:
    """The first of the literal index and what stands for it that is known, with its bracket."""
    for name, words in (("literal", "λ max / λ min"), ("share", "share of λ max in all curvature")):
        index: Index | None = getattr(data.anisotropy, name) or None
        if index and not is_loose(index) and index.low is not None and index.high is not None:
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
    rest = [_not_passed(name, check) for name, check in data.checks.items() if check.passed is not True]
    return f"{passed} of {len(data.checks)} passed, not {' and '.join(rest)}"


def _not_passed(name: str, check: Check) -> str:
    words = name.replace("_", " ")
    return f"{words} ({quantity(check.value)} of {quantity(check.bound)})" if check.passed is False else words
