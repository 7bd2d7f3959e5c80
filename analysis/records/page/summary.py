"""A probe in ten lines, for the terminal, and what has to be said beside them.

Attributes come first: where errors decide their order, three seeds of fern share it.  Eigenvalues have three digits, as in
every table, other numbers two; the errors beside them are named.  "one training": what another seed changes (half of fern's
curvature lies in 15 to 28 directions, or in 35 to 45).  Where a check of the derivatives failed, no number that is made of them
stands here.
"""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

from analysis.records.findings import Line, changes_by_steps, findings, is_loose, largest_steps, what_renders_say
from analysis.records.quantities import UNDETERMINED, apart, extent, percent, quantity, rough, solved
from analysis.records.records import Check, Counts, ProbeRecord
from analysis.records.schema import Eigenvalue

SHORT = {"means": "position", "log_scales": "scale", "quats": "rotation", "opacity_logits": "opacity", "sh": "colour"}
CARRIED = 0.5  # least share of an eigenvector that one Gaussian has where it is said to carry it
ONE = "one training"


def summary(data: ProbeRecord, report: Path) -> list[str]:
    """The lines for the terminal, with the page to open."""
    return [f"{name:<9} {text}" for name, text in (told(data) | {"report": f"{report}"}).items()]


def told(data: ProbeRecord) -> dict[str, str]:
    """Lines on the scene, a step of the optimiser, the spread, both ends of the spectrum and the checks, by their names."""
    counts, made, ends = data.counts, data.provenance, data.eigenvalues
    lines = {
        "scene": f"{made.scene or 'scene'}, {steps_made(made.iteration or 0, bool(made.origin))}, {_views(counts)}; "
        f"{counts.visible_gaussians:,} Gaussians in sight",
        "a step": _of_one(_step(data)),
        "spread": _of_one(_spread(data)),
        "steepest": _end(ends.max),
        "negative" if (ends.min.value or 0.0) < 0 else "lowest": _end(ends.min),
        "seeds": f"{ONE}: other seeds give other extreme eigenvalues (landscape compare, three seeds of each)",
    }
    if not counts.gaussians:  # of a renderer that is not ours
        lines |= {"scene": f"{made.scene}, {_views(counts)}; {counts.parameters:,} parameters", "seeds": ""}
    if doubtful := _doubtful(data):
        words = f"the check of {' and '.join(doubtful)} failed, which puts every curvature in doubt: none is told"
        lines = {"scene": lines["scene"], "curvature": words}
    lines |= {"checks": _checks(data), "time": f"{total:.0f} s" if (total := data.timing.get("total")) else ""}
    return {name: text for name, text in lines.items() if text}


def _of_one(text: str) -> str:
    return f"{text} ({ONE})" if text else ""


def _doubtful(data: ProbeRecord) -> list[str]:
    """Checks of the derivatives that failed; round-off is an error that numbers have, and leaves them their meaning."""
    failed = [name for name, check in data.checks.items() if check.passed is False and name != "round_off"]
    return [name.replace("_", " ") for name in failed]


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


def remarks(data: ProbeRecord) -> list[Line]:
    """Remarks on what failed and what is not known, without cautions, which the report has."""
    return [line for line in findings(data) if line.level in ("failure", "open")]


def _end(end: Eigenvalue) -> str:
    """Eigenvalue, curvature over the optimiser's step, carrier, and what renders say."""
    if not end.is_reached:
        return f"{UNDETERMINED} (not reached)"
    value, renders = end.value or 0.0, end.renders
    notes = []  # but for the one that stands behind "not confirmed" as the reason
    if renders and renders.optimiser_step and (value > 0 or renders.confirmed):
        at, by_kinks = renders.at_step, renders.bent_by_kinks(value)
        if renders.confirmed is not False or by_kinks or at is None:
            over = "hidden by round-off" if at is None else rough(at * value)
            notes.append(f"{over} over the optimiser's step in renders")
        if renders.kinks and not by_kinks:
            notes.append(f"kinks of L1 add about {rough(renders.kinks)} at short steps")
    text = f"{solved(value, end.residual)}{apart(end.views_error)} ({'; '.join([*notes, ONE])})"
    return f"{text}{_carrier(end)}; {what_renders_say(value, renders) if renders else 'not rendered'}"


def _carrier(end: Eigenvalue) -> str:
    """Who carries an eigenvector, beside a random vector, and whether its neighbours in the spectrum are as narrow."""
    carrier = end.carrier
    if not carrier:
        return ""
    random = f"(a random direction has at most {percent(carrier.random_share)} on each)".replace("at most less", "less")
    if carrier.share < CARRIED:
        return f": over several Gaussians, at most {percent(carrier.share)} on one {random}"
    most = ", ".join(filter(None, (f"most of it in {SHORT[carrier.attribute]}", carrier.shape)))
    text = f": {percent(carrier.share)} on Gaussian {carrier.gaussian:,} {random}, {most}"
    if carrier.wide:
        place, value, _ = carrier.wide
        return f"{text}; number {place} from this end ({quantity(value)}) is the first eigenvector on more than ten Gaussians"
    if carrier.found < 2:
        return text
    return f"{text}; each of the first {carrier.found} eigenvectors from this end lies on at most ten Gaussians"


def _step(data: ProbeRecord) -> str:
    """Attributes by the change of the loss in a random step of the optimiser; ≈ where errors leave the order open."""
    if not (ends := changes_by_steps(data)):
        return ""
    parts = [SHORT.get(name, name) for name in ends]
    joined = [", then " if before[0] > after[1] else " ≈ " for before, after in pairwise(ends.values())]
    by = "" if data.step_rises else ", by curvature alone"
    if first := largest_steps(data):
        text = f"of the optimiser in {parts[0]} changes the loss {rough(first[2])} times as much as in {parts[1]}"
        return text + "".join(map("".join, zip(joined[1:], parts[2:], strict=True))) + by
    rest = "".join(map("".join, zip(joined, parts[1:], strict=True)))
    return f"of the optimiser changes the loss most in {parts[0]}{rest}{by}"


def _spread(data: ProbeRecord) -> str:
    """In how many directions half of all curvature lies, and the participation ratio, as far as the density knows them."""
    known, ratio, parts = data.concentration, data.anisotropy.participation_ratio, []
    if known:
        low, high = map(rough, (known.half.low, known.half.high))
        among = f"at most {high}" if (known.half.low or 0.0) < 1 else " to ".join(dict.fromkeys((low, high)))
        parts.append(f"half of all curvature lies in {among} of {data.counts.active_parameters:,} directions")
    if ratio and ratio.low is not None and ratio.high is not None and not is_loose(ratio):
        parts.append(f"participation ratio {extent((ratio.low, ratio.high))}")
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
