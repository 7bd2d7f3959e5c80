"""A probe in eight lines, for the terminal, and what has to be said beside them.

Numbers have two digits; the errors beside them are named.  "one training": a number that another seed changes.
"""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

from analysis.records.findings import Line, findings, is_loose, largest_steps, shares_per_trace
from analysis.records.quantities import UNDETERMINED, apart, percent, rough, solved
from analysis.records.records import Check, Counts, ProbeRecord
from analysis.records.schema import Eigenvalue

SHORT = {"means": "position", "log_scales": "scale", "quats": "rotation", "opacity_logits": "opacity", "sh": "colour"}
MOVED = {"means": "moved", "log_scales": "stretched", "quats": "turned", "opacity_logits": "faded", "sh": "recoloured"}
CARRIED = 0.5  # least share of an eigenvector that one Gaussian has where it is said to carry it
ONE = "one training"


def summary(data: ProbeRecord, report: Path) -> list[str]:
    """Lines on the scene, both ends of the spectrum, a step of the optimiser, the spread, the checks, and the page to open."""
    counts, made, ends = data.counts, data.provenance, data.eigenvalues
    lines = {
        "scene": f"{made.scene or 'scene'}, {steps_made(made.iteration or 0, bool(made.origin))}, {_views(counts)}; "
        f"{counts.visible_gaussians:,} Gaussians in sight",
        "steepest": _end(ends.max),
        "negative" if (ends.min.value or 0.0) < 0 else "lowest": _end(ends.min),
        "a step": _step(data),
        "spread": _spread(data),
        "checks": f"{_checks(data)}; {data.timing['total']:.0f} s",
        "seeds": f"{ONE}: other seeds give other extreme eigenvalues (landscape compare, three seeds of each)",
        "report": f"{report}",
    }
    return [f"{name:<9} {text}" for name, text in lines.items() if text]


def steps_made(steps: int, foreign: bool) -> str:
    """Number of steps of the training; a file of another tool, foreign, may not say it.

    >>> steps_made(2000, False), steps_made(0, True), steps_made(0, False)
    ('2,000 steps', 'steps not known', '0 steps')
    """
    return "steps not known" if foreign and not steps else f"{steps:,} steps"


def guess(origin: Mapping[str, Any] | None) -> list[str]:
    """A sentence on training views that nothing names: the first and the last that is printed.  origin: of the checkpoint.

    >>> guess({"views": "guessed: all"}), guess({"views": "as listed"}), guess(None)
    (['the training views are guessed: all; --views or --train-list names them'], [], [])
    """
    views = str((origin or {}).get("views", ""))
    known = f"the training views are {views}; --views or --train-list names them"
    return [known] if views.startswith("guessed") else []


def _views(counts: Counts) -> str:
    """Number of views; where some were left out, what stands beside the numbers."""
    if not counts.views_of:
        return f"{counts.views} views"
    return f"{counts.views} of {counts.views_of} views (∓: what the others may change)"


def remarks(data: ProbeRecord, verbose: bool) -> list[Line]:
    """Remarks on what failed and what is not known; verbose: every caution."""
    levels = ("failure", "open", "caution") if verbose else ("failure", "open")
    return [line for line in findings(data) if line.level in levels]


def _end(end: Eigenvalue) -> str:
    """Eigenvalue, curvature over the optimiser's step, carrier, and what renders say."""
    if not end.is_reached:
        return f"{UNDETERMINED} (not reached)"
    value, renders = end.value or 0.0, end.renders
    notes = [ONE]
    if renders and (value > 0 or renders.confirmed):
        at = renders.at_step
        over = "hidden by round-off" if at is None else rough(at * value)
        notes.insert(0, f"{over} over the optimiser's step")
    text = f"{solved(value, end.residual)}{apart(end.views_error)} ({', '.join(notes)})"
    return f"{text}{_carrier(end)}; {_rendered(end)}"


def _carrier(end: Eigenvalue) -> str:
    carrier = end.carrier
    if not carrier:
        return ""
    if carrier.share < CARRIED:
        return f": over many Gaussians, at most {percent(carrier.share)} on one"
    shape = f"{carrier.shape}, " if carrier.shape else ""
    return f": {percent(carrier.share)} on Gaussian {carrier.gaussian:,}, {shape}{MOVED[carrier.attribute]}"


def _rendered(end: Eigenvalue) -> str:
    renders = end.renders
    if not renders:
        return "not rendered"
    if renders.confirmed:
        return f"renders agree from {rough(renders.low)} to {rough(renders.high)}"
    if renders.confirmed is None:
        return "not resolved: round-off hides it in renders"
    return "not confirmed by renders" + (": no saddle is claimed" if (end.value or 0.0) < 0 else "")


def _step(data: ProbeRecord) -> str:
    """Attributes by the change of the loss in a random step of the optimiser; ≈ where errors leave the order open."""
    shares, traces = shares_per_trace(data), data.traces
    if not shares:
        return ""

    def change(name: str, end: int) -> float:
        return shares[name] * traces[name].magnitudes[end]

    ranked = sorted(shares, key=lambda name: -shares[name] * abs(traces[name].value or 0.0))
    text = SHORT.get(ranked[0], ranked[0])
    for before, name in pairwise(ranked):
        text += (", then " if change(before, 0) > change(name, 1) else " ≈ ") + SHORT.get(name, name)
    first = largest_steps(data)
    times = f" ({first[2]:.2g} times as much as in {SHORT.get(first[1], first[1])})" if first else ""
    return f"of the optimiser changes the loss most in {text}{times}"


def _spread(data: ProbeRecord) -> str:
    """The participation ratio and the steepest direction's part, as far as the density knows them."""
    ratio, share, parts = data.anisotropy.participation_ratio, data.anisotropy.top_mass, []
    if ratio and ratio.value is not None and not is_loose(ratio):
        parts.append(
            f"a participation ratio of {rough(ratio.value)} among {data.counts.active_parameters:,} directions"
        )
    if share and share.value is not None and not is_loose(share):
        parts.append(f"the steepest holds {percent(share.value)} of all curvature")
    return "; ".join(parts)


def _checks(data: ProbeRecord) -> str:
    passed = sum(check.passed is True for check in data.checks.values())
    if passed == len(data.checks):
        return f"all {passed} passed"
    rest = [_not_passed(name, check) for name, check in data.checks.items() if check.passed is not True]
    return f"{passed} of {len(data.checks)} passed, not {' and '.join(rest)}"


def _not_passed(name: str, check: Check) -> str:
    words = name.replace("_", " ")
    return f"{words} ({rough(check.value)} of {rough(check.bound)})" if check.passed is False else words
