"""Sentences on a record: what failed, what is not known and what resolves it.  The numbers are in `tables`.

Every sentence follows from numbers of the record and their errors alone; where an error does not decide, it says so.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal, TypeGuard

from msgspec import UNSET

from analysis.records import schema
from analysis.records.provenance import Provenance
from analysis.records.quantities import UNDETERMINED, quantity, rough, solved
from analysis.records.records import Check, ProbeRecord

ATTRIBUTES = {
    "means": "position",
    "log_scales": "log scale",
    "quats": "rotation",
    "opacity_logits": "opacity",
    "sh": "colour (SH)",
}
END_NAMES = {"max": "largest", "min": "smallest"}
WIDEST = 10.0  # ratio of a bracket's ends up to which a value is shown with it


@dataclass(frozen=True)
class Line:
    """One sentence.  level: "failure" of a check that failed or a number that is not finite; "open" where a number is not
    known, with what resolves it."""

    text: str
    level: Literal["fact", "caution", "open", "failure"] = "fact"


def attribute_name(attribute: str) -> str:
    """The paper's name of an attribute; other names are returned unchanged."""
    return ATTRIBUTES.get(attribute, attribute)


def findings(data: ProbeRecord) -> list[Line]:
    """The sentences of a record, failures first."""
    ends = data.eigenvalues
    lines = [
        *of_checks(data.checks),
        *_of_traces(data.traces),
        *_of_ends(data),
        *of_budgets({"max": ends.max.reason, "min": ends.min.reason}),
        *_of_open(data),
        *of_slice(data.slice, data.provenance),
        *(Line(note[:1].upper() + note[1:] + "." * (note[-1:] not in ".!?"), "caution") for note in data.notes),
    ]
    return sorted(lines, key=lambda line: line.level != "failure")


def of_checks(checks: Mapping[str, Check]) -> list[Line]:
    """Lines on self-checks that failed or could not run."""
    lines = []
    for name, check in checks.items():
        label, note = name.replace("_", " "), f" ({check.note})" if check.note else ""
        if check.passed is None:
            lines.append(Line(f"The check of {label} could not run{note}.", "caution"))
        elif not check.passed:
            value, bound = quantity(check.value), quantity(check.bound)
            text = f"The check of {label} failed: {value}, where at most {bound} is allowed{note}."
            if name == "round_off" and _is_finite(check.value):
                lines.append(Line(f"{text} Its numbers are uncertain by as much.", "caution"))
            else:
                lines.append(Line(f"{text} Do not trust its numbers.", "failure"))
    return lines


def _of_traces(traces: Mapping[str, schema.Trace]) -> list[Line]:
    lines = [
        Line(f"The trace of {attribute_name(name)} is {quantity(trace.value)}.", "failure")
        for name, trace in traces.items()
        if not _is_finite(trace.value)
    ]
    signs = {"negative": "negative: on average the loss curves down there", "undetermined": "not decided by its error"}
    for sign, words in signs.items():
        those = [name for name, trace in traces.items() if trace.sign == sign and _is_finite(trace.value)]
        if named := [*map(attribute_name, those)]:
            lines.append(Line(f"The sign of the trace of {' and '.join(named)} is {words}.", "caution"))
    return lines


def shares_per_trace(data: ProbeRecord) -> dict[str, float]:
    """s^2 / (2 L), by attribute: times the trace, the relative change of the loss L by a random step as long as the
    optimiser's first, s per parameter.  Empty where not known."""
    loss = data.objective.value
    if not data.steps or not loss or not loss > 0 or set(data.traces) - set(data.steps):
        return {}
    return {name: data.steps[name] ** 2 / (2 * loss) for name in data.traces}


def changes_by_steps(data: ProbeRecord) -> dict[str, tuple[float, float]]:
    """The least and the largest size, by attribute, of the change of the loss in such a step: rendered, in units of the loss,
    where the record has renders; else by curvature alone, as a share.  The largest first; empty where not known."""
    if data.step_rises:
        ends = {
            n: (max(abs(rise) - 2 * error, 0.0), abs(rise) + 2 * error) for n, (rise, error) in data.step_rises.items()
        }
    else:
        shares, traces = shares_per_trace(data), data.traces
        sizes = {name: (share, *traces[name].magnitudes) for name, share in shares.items()}
        ends = {name: (share * least, share * most) for name, (share, least, most) in sizes.items()}
    return dict(sorted(ends.items(), key=lambda each: -sum(each[1])))


def largest_steps(data: ProbeRecord) -> tuple[str, str, float] | None:
    """The two attributes in which such a step changes the loss most, and the ratio of the changes; None where not known, or
    where the errors leave open whether another than the first one's is as large."""
    ends = changes_by_steps(data)
    if len(ends) < 2:
        return None
    (first, (least, most)), (second, other), *rest = ends.items()
    if not least > max(high for _, (_, high) in [(second, other), *rest]) > 0:
        return None
    return first, second, (least + most) / sum(other)


def optimiser_steps(renders: schema.Renders, *steps: float) -> str:
    """Lengths along an eigenvector in words: as multiples of the optimiser's step, which are powers of 2, where it is known.

    >>> found = schema.Renders(confirmed=None, optimiser_step=0.008, steps=[0.008], ratios=[1.0], errors=[0.0])
    >>> optimiser_steps(found, 0.002, 0.032)
    "1/4 to 4 × the optimiser's step"
    """
    step = renders.optimiser_step
    known = [str(Fraction(each / step).limit_denominator(1000)) if step else rough(each) for each in steps]
    unit = "× the optimiser's step" if step else "units of the parameters"
    return f"{' to '.join(known)} {unit}"


def what_renders_say(value: float, renders: schema.Renders) -> str:
    """Over which steps renders agree with an eigenvalue, or why they do not: in these words wherever it is told."""
    if renders.confirmed:
        steps = optimiser_steps(renders, renders.low or 0.0, renders.high or 0.0)
        return f"renders agree within a factor of 2 at {steps}"
    if renders.confirmed is None:
        return f"not resolved: round-off hides it in renders at up to {optimiser_steps(renders, renders.hidden)}"
    ratio, why = renders.at_step, ""
    if renders.bent_by_kinks(value):
        why = f", as kinks of L1, which the eigenvalue leaves out, curve by {rough(renders.kinks)}"
    elif ratio is not None:
        why = f", by which it is {rough(ratio * value)} over the optimiser's step"
    if value >= 0:
        return f"not confirmed by renders{why}"
    falls = "they fall too, but not as it says, and " if ratio and ratio > 0 else ""
    return f"not confirmed by renders{why}: {falls}no saddle is claimed"


def _of_ends(data: ProbeRecord) -> list[Line]:
    ends = data.eigenvalues
    numbers = [number for end in (ends.max, ends.min) for number in (end.value, end.residual) if _is_finite(number)]
    if len(numbers) < 4:
        return [Line("The extreme eigenvalues were not determined.", "failure")]
    top, top_error, bottom, bottom_error = numbers
    if bottom + bottom_error < 0 < top - top_error or bottom - bottom_error > 0 or top + top_error < 0:
        return []
    text = f"the curvature runs from {solved(bottom, bottom_error)} to {solved(top, top_error)}"
    return [Line(f"Whether the Hessian is indefinite is not decided by the residuals: {text}.", "caution")]


def of_budgets(reasons: Mapping[str, str | None]) -> list[Line]:
    """Lines on the searches, for the ends "max" and "min", that ended at a budget.

    Their residual bounds the distance to an eigenvalue, not to the end of the spectrum.
    """
    text = "The search for the {} eigenvalue ended at its {}: it may lie farther out."
    spent = {end: reason for end, reason in reasons.items() if reason and reason.endswith("budget")}
    return [Line(text.format(END_NAMES[end], reason), "caution") for end, reason in spent.items()]


def is_open(index: schema.Index) -> bool:
    """Whether its bracket lacks an end; False where value and both ends are None, as it is then undefined."""
    missing = [index.low, index.high].count(None)
    return missing == 1 or (missing == 2 and index.value is not None)


def is_wide(index: schema.Index) -> bool:
    """Whether its bracket includes 0 or its ends differ by more than WIDEST: no value is shown."""
    if index.low is None or index.high is None:
        return False
    near, far = sorted((abs(index.low), abs(index.high)))
    return (index.low > 0) != (index.high > 0) or far > WIDEST * near


def is_loose(index: schema.Index) -> bool:
    """Whether its bracket is open or wide: no value is shown."""
    return is_open(index) or is_wide(index)


def remedy(data: ProbeRecord, name: str) -> str:
    """The command that resolves an index, as far as any does."""
    made, ends = data.provenance, data.eigenvalues
    command = made.command or made.other_command("probe")
    reasons = {end.reason for end in (ends.max, ends.min)}
    if "matvec budget" in reasons:
        spent = ends.min.matvecs or 1
        return f"more products resolve it: {_with(command, '--end-products', 4 * spent)}"
    if name in ("top_mass", "participation_ratio"):
        products = int((made.fingerprint.question if made.fingerprint else {}).get("settings.density_matvecs") or 108)
        return f"a longer density narrows it: {_with(command, '--density-products', 4 * products)}"
    return "the smallest eigenvalue is within its error of 0, and no more products resolve it"


def _with(command: str, option: str, value: int) -> str:
    without = re.sub(rf" {option}[ =]\S+", "", command)
    return f"{without} {option} {value}"


def _of_open(data: ProbeRecord) -> list[Line]:
    """The indices without a finite or useful bracket: the bracket, and the command that resolves it."""
    lines = []
    for name, index in data.indices.items():
        if is_loose(index):
            text = f"{name.replace('_', ' ').capitalize()}: {UNDETERMINED}{_bracket(index)}; {remedy(data, name)}."
            lines.append(Line(text, "open" if is_open(index) else "caution"))
    return lines


def resolved(probe: schema.FiniteProbe) -> list[bool]:
    """Mask of the finite steps at which round-off does not hide the curvature."""
    here = abs(probe.infinitesimal or 0.0)
    pairs = zip(probe.curvatures, probe.round_off, strict=True)
    return [
        value is not None and bound is not None and math.isfinite(value) and bound <= max(abs(value), here) / 2
        for value, bound in pairs
    ]


def of_slice(plane: schema.Slice | None, made: Provenance) -> list[Line]:
    """Sentences on a slice.  made: the provenance of its record."""
    if plane is None:
        return [Line("No slice of the loss was recorded.", "caution")]
    lines = []
    rendered = plane.points if plane.evaluated_points is None else plane.evaluated_points
    if not plane.is_resolved:
        lines.append(Line(unresolved(plane, made), "caution"))
    elif rendered < plane.points:
        text = f"Of the slice's {plane.points:,} points {rendered:,} are renders; the others are "
        lines.append(Line(f"{text}interpolated, {_errors_of_interpolation(plane)}."))
    if plane.crossed_points:
        share = f"{plane.crossed_points:,} of the slice's {rendered:,} rendered points"
        text = f"At {share} the order of the splats or the set of visible ones is not the checkpoint's"
        lines.append(Line(f"{text}, which derivatives do not see.", "caution"))
    return lines


def _errors_of_interpolation(plane: schema.Slice) -> str:
    bound, count = plane.interpolation_error, plane.holdout_points
    seen = bound if plane.error_seen in (None, UNSET) else plane.error_seen
    at = f"at {count} random point{'' if count == 1 else 's'}"
    if seen is None:
        return f"{at} without bound"
    everywhere = "" if bound is None else f", everywhere to {_percent(bound)}"
    return f"{at} to {_percent(seen)}{everywhere} of the range of the loss"


def unresolved(plane: schema.Slice, made: Provenance) -> str:
    """Why a plane is not drawn, and the command that resolves it."""
    accuracy = f" to {_percent(plane.tolerance)} of the range of the loss" if plane.tolerance else ""
    return (
        f"Between its two sections the plane is not known{accuracy} from {plane.evaluated_points:,} of "
        f"{plane.points:,} renders, and no surface is drawn; {made.other_command('slice')} renders more."
    )


def _is_finite(number: schema.Number) -> TypeGuard[float]:
    return number is not None and math.isfinite(number)


def _bracket(index: schema.Index) -> str:
    """Its bracket in words; none where its ends look alike."""
    ends = index.low, index.high
    if None not in ends:
        low, high = map(quantity, ends)
        return f" (between {low} and {high})" if low != high else ""
    known = [f" (at {words} {quantity(end)})" for words, end in zip(("least", "most"), ends, strict=True) if end]
    return known[0] if known else ""


def _percent(share: float) -> str:
    return f"{rough(100 * share)}%"
