"""Sentences on a record: which attribute carries the curvature, its sign, how anisotropic, what was skipped.

Every sentence follows from numbers of the record and their errors alone; where an error does not decide, it says so.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeGuard

from msgspec import UNSET

from analysis.records import schema
from analysis.records.provenance import Provenance
from analysis.records.quantities import UNDETERMINED, measured, quantity, rough, solved
from analysis.records.records import Check, Counts, ProbeRecord, Skip

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
        *_of_traces(data),
        *_of_ends(data),
        *of_budgets({"max": ends.max.reason, "min": ends.min.reason}),
        *_of_anisotropy(data),
        *_of_open(data),
        *_of_needles(ends.max.lives_on, data.counts),
        *_of_finite_probe(data.finite_probe),
        *_of_depth(data.depth),
        *_of_block_shares(data.block_shares or []),
        *_of_counts(data.counts),
        *_of_skips(data.skipped),
        *of_slice(data.slice, data.provenance),
        *(Line(_sentence(note), "caution") for note in data.notes),
    ]
    return sorted(lines, key=lambda line: line.level != "failure")


def on_top(data: ProbeRecord) -> list[Line]:
    """Sentences on what a summary says too."""
    return [*of_checks(data.checks), *_of_traces(data), *_of_ends(data)]


def of_checks(checks: Mapping[str, Check]) -> list[Line]:
    """Lines on self-checks that failed or could not run, or that all passed."""
    lines = []
    for name, check in checks.items():
        label, note = name.replace("_", " "), _in_brackets(check.note)
        if check.passed is None:
            lines.append(Line(f"The check of {label} could not run{note}.", "caution"))
        elif not check.passed:
            value, bound = quantity(check.value), quantity(check.bound)
            text = f"The check of {label} failed: {value}, where at most {bound} is allowed{note}."
            if name == "round_off" and _is_finite(check.value):
                lines.append(Line(f"{text} Its numbers are uncertain by as much.", "caution"))
            else:
                lines.append(Line(f"{text} Do not trust its numbers.", "failure"))
    if checks and all(check.passed for check in checks.values()):
        lines.append(Line(f"All {len(checks)} checks passed."))
    return lines


def trace_values(data: ProbeRecord) -> dict[str, float]:
    """The finite traces, by attribute."""
    return {name: trace.value for name, trace in data.traces.items() if _is_finite(trace.value)}


def _of_traces(data: ProbeRecord) -> list[Line]:
    traces, values = data.traces, trace_values(data)
    lines = [
        Line(f"The trace of {attribute_name(name)} is {quantity(trace.value)}{_in_brackets(trace.note)}.", "failure")
        for name, trace in traces.items()
        if name not in values
    ]
    if any(values.values()):
        steps = largest_steps(data)
        lines.append(_of_largest_step(*steps) if steps else _of_largest_trace(traces, values))
    elif values:
        lines.append(Line("Every trace is exactly 0."))
    signs = {"negative": "negative: on average the loss curves down there", "undetermined": "not decided by its error"}
    for sign, words in signs.items():
        if named := [attribute_name(name) for name in values if traces[name].sign == sign]:
            lines.append(Line(f"The sign of the trace of {' and '.join(named)} is {words}.", "caution"))
    return lines


def shares_per_trace(data: ProbeRecord) -> dict[str, float]:
    """s^2 / (2 L), by attribute: times the trace, the relative change of the loss L by a random step as long as the
    optimiser's first, s per parameter.  Empty where not known."""
    loss = data.objective.value
    if not data.steps or not loss or not loss > 0 or set(data.traces) - set(data.steps):
        return {}
    return {name: data.steps[name] ** 2 / (2 * loss) for name in data.traces}


def largest_steps(data: ProbeRecord) -> tuple[str, str, float] | None:
    """The two attributes whose curvature changes the loss most in such a step (`shares_per_trace`), and the ratio of the
    changes; None where not known, or where the errors leave open whether another than the first one's is as large."""
    shares, traces = shares_per_trace(data), data.traces
    if len(shares) < 2:
        return None
    least, largest = ({name: share * traces[name].magnitudes[i] for name, share in shares.items()} for i in (0, 1))
    first, second, *_ = sorted(shares, key=lambda name: -least[name])
    if not least[first] > max(largest[name] for name in shares if name != first) > 0:
        return None
    changes = [sum(abs(shares[name] * x) for x in traces[name].interval) for name in (first, second)]
    return first, second, changes[0] / changes[1]


def _of_largest_step(first: str, second: str, ratio: float) -> Line:
    return Line(
        f"By its curvature a random step in {attribute_name(first)}, as long as the optimiser's first, changes the loss "
        f"{rough(ratio)} times as much as one in {attribute_name(second)}, the next."
    )


def _of_largest_trace(traces: Mapping[str, schema.Trace], values: Mapping[str, float]) -> Line:
    """values: the finite traces, not all 0."""
    first, *others = sorted(values, key=lambda name: -abs(values[name]))
    share = abs(values[first]) / sum(map(abs, values.values()))
    part = "most" if share > 0.5 else "the largest part"
    text = (
        f"{attribute_name(first).capitalize()} carries {part} of the curvature: its trace, "
        f"{measured(values[first], traces[first].standard_error)}, is {share:.0%} of the sum of all absolute traces (each in "
        "its own units)."
    )
    if near := [attribute_name(name) for name in others if not traces[first].exceeds(traces[name])]:
        text += f" Its error does not separate it from {' and '.join(near)}."
    return Line(text)


def _of_ends(data: ProbeRecord) -> list[Line]:
    ends, norm = data.eigenvalues, data.objective.gradient_norm
    numbers = [number for end in (ends.max, ends.min) for number in (end.value, end.residual) if _is_finite(number)]
    if len(numbers) < 4:
        return [Line("The extreme eigenvalues were not determined.", "failure")]
    top, top_error, bottom, bottom_error = numbers
    where = f"over {data.counts.active_parameters:,} parameters"
    where += f", with a gradient of norm {quantity(norm)}," if _is_finite(norm) else ""
    text = f"{where} the curvature runs from {solved(bottom, bottom_error)} to {solved(top, top_error)}"
    if bottom + bottom_error < 0 < top - top_error:
        return [Line(f"{_of_negative(ends.min)}; {text}.")]
    if bottom - bottom_error > 0:
        return [Line(f"No direction of negative curvature was found: {text}.")]
    if top + top_error < 0:
        return [Line(f"No direction of positive curvature was found: {text}.")]
    return [Line(f"Whether the Hessian is indefinite is not decided by the residuals: {text}.", "caution")]


def _of_negative(end: schema.Eigenvalue) -> str:
    """What renders say of a negative eigenvalue."""
    if end.renders and end.renders.confirmed:
        return "The Hessian is indefinite, and renders confirm it, so the checkpoint is no basin in every direction"
    said = "with no renders to compare"
    if end.renders:
        said = "but round-off hides it in renders" if end.renders.confirmed is None else "but renders do not confirm it"
    return f"The Hessian is indefinite, {said}: no saddle is claimed"


def of_budgets(reasons: Mapping[str, str | None]) -> list[Line]:
    """Lines on the searches, for the ends "max" and "min", that ended at a budget.

    Their residual bounds the distance to an eigenvalue, not to the end of the spectrum.
    """
    text = "The search for the {} eigenvalue ended at its {}: the end may lie farther out."
    spent = {end: reason for end, reason in reasons.items() if reason and reason.endswith("budget")}
    return [Line(text.format(END_NAMES[end], reason), "caution") for end, reason in spent.items()]


def _of_anisotropy(data: ProbeRecord) -> list[Line]:
    """The ratio of both ends, unless renders refute one, and the part of the steepest direction."""
    lines, share, ratio = [], data.indices.get("top_mass"), data.indices.get("negative_ratio")
    text = "The steepest direction down is {} times as curved as the steepest up{}."
    if ratio and _is_finite(ratio.value) and not is_loose(ratio) and ratio.value:
        lines.append(Line(text.format(quantity(ratio.value), _bracket(ratio))))
    elif ratio and ratio.high:
        text = f"The ratio of the two ends of the spectrum is not determined{_in_brackets(ratio.note)}."
        lines.append(Line(text, "caution"))
    if share and _is_finite(share.value) and not is_loose(share):
        text = f"The steepest direction alone holds {_percent(share.value)} of all absolute curvature"
        lines.append(Line(f"{text}{_bracket(share, _percent)}."))
    return lines


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
    command = made.command or f"landscape probe {made.checkpoint or 'CHECKPOINT'}"
    reasons = {end.reason for end in (ends.max, ends.min)}
    if "time budget" in reasons:
        return f"the same command without --seconds resolves it: {_without(command, '--seconds')}"
    if "matvec budget" in reasons:
        spent = ends.min.matvecs or 1
        return f"more products resolve it: {_with(command, '--end-products', 4 * spent)}"
    if name in ("top_mass", "participation_ratio"):
        products = int((made.fingerprint.question if made.fingerprint else {}).get("settings.density_matvecs") or 108)
        return f"a longer density narrows it: {_with(command, '--density-products', 4 * products)}"
    return "the end is within its error of 0, and no more products resolve it"


def _without(command: str, option: str) -> str:
    return re.sub(rf" {option}[ =]\S+", "", command)


def _with(command: str, option: str, value: int) -> str:
    return f"{_without(_without(command, '--seconds'), option)} {option} {value}"


def _of_open(data: ProbeRecord) -> list[Line]:
    """The indices without a finite or useful bracket: the bracket, and the command that resolves it."""
    lines = []
    for name, index in data.indices.items():
        if is_loose(index):
            text = f"{name.replace('_', ' ').capitalize()}: {UNDETERMINED}{_bracket(index)}; {remedy(data, name)}."
            lines.append(Line(text, "open" if is_open(index) else "caution"))
    return lines


def _of_needles(where: schema.Maybe[schema.LivesOn], counts: Counts) -> list[Line]:
    """The paper's claim that Gaussians with an ill-conditioned projection dominate the steepest directions."""
    if not where:
        return []
    count, share, spread = where.needle_count, where.needles, quantity(where.participation)
    among = f"of {counts.visible_gaussians:,} Gaussians in sight"
    if not count:
        text = f"None {among} has a condition number above 100; the steepest direction is spread over about {spread}."
        return [Line(text)]
    has, holds = ("has", "holds") if count == 1 else ("have", "hold")
    part = "under 1%" if 0 < share < 0.005 else f"{share:.0%}"
    text = f"{count:,} {among} {has} a condition number above 100 and {holds} {part} of the steepest direction"
    return [Line(f"{text}, which is spread over about {spread} Gaussians.")]


def _of_finite_probe(probe: schema.FiniteProbe | None) -> list[Line]:
    if probe is None:
        return []
    along, here = probe.direction or "the direction", quantity(probe.infinitesimal)
    text = f"Along {along} the curvature is {here}; over finite steps it is "
    if probe.best is not None:
        error = math.hypot(probe.round_off[probe.best] or math.inf, probe.truncation[probe.best] or math.inf)
        text += f"{measured(probe.curvatures[probe.best], error)} at ±{quantity(probe.steps[probe.best])} and "
    return [Line(f"{text}{quantity(probe.curvatures[-1])} at ±{quantity(probe.steps[-1])}.")]


def resolved(probe: schema.FiniteProbe) -> list[bool]:
    """Mask of the finite steps at which round-off does not hide the curvature."""
    here = abs(probe.infinitesimal or 0.0)
    pairs = zip(probe.curvatures, probe.round_off, strict=True)
    return [
        value is not None and bound is not None and math.isfinite(value) and bound <= max(abs(value), here) / 2
        for value, bound in pairs
    ]


def _of_depth(depth: schema.Depth | None) -> list[Line]:
    """The paper's statement that the positions' gradient is typically 100 times as large along the rays as across them."""
    if depth is None:
        return []
    lines, ratio = [], depth.curvature_ratio
    if _is_finite(depth.gradient_ratio):
        text = f"In depth, along the rays, the gradient of the positions is {quantity(depth.gradient_ratio)} times"
        text += " what it is in a direction across them (root mean square; the paper says about 100)"
        if _is_finite(ratio.value) and not is_loose(ratio):
            text += f", and their curvature {quantity(ratio.value)} times{_bracket(ratio)}"
        lines.append(Line(f"{text}."))
    if rises := [row for row in depth.rises if _is_finite(row.ratio)]:
        parts = [f"{measured(row.ratio, row.ratio_error)} at {row.pixels:g} px" for row in rises]
        crossed = max(row.depth_crossed for row in rises)
        text = "Steps along the rays raise the loss by this many times what steps as long across them do: "
        text += f"{', '.join(parts)}. They changed the order of the splats in up to {crossed:.0%} of the renders"
        lines.append(Line(f"{text}, which derivatives do not see."))
    return lines


def _of_block_shares(shares: Sequence[schema.BlockShare]) -> list[Line]:
    """How much of an operator its block-diagonal and diagonal approximations keep: shares of its squared entries."""
    names, parts = {"hessian": "the Hessian", "gauss-newton": "Gauss-Newton"}, []
    for one in shares:
        if one.blocks is not None and one.diagonal is not None:
            operator = names[one.operator] + ("" if one.ssim_window else " without SSIM's window")
            share = measured(100 * one.blocks, 100 * one.blocks * one.relative_error)
            parts.append(f"of {operator} {share}% ({one.diagonal:.0%} on the diagonal)")
    text = "Of the sum of all squared entries, this lies within the Gaussians' own blocks (11 x 11, and the diagonal of SH): "
    return [Line(f"{text}{', '.join(parts)}.")] if parts else []


def _of_skips(skipped: Mapping[str, Skip]) -> list[Line]:
    """Work left out, the largest saving first."""
    parts = []
    for name, skip in sorted(skipped.items(), key=lambda item: -(item[1].seconds_saved or 0.0)):
        if skip.count:
            saved = "" if skip.seconds_saved is None else f" ({rough(skip.seconds_saved)} s)"
            parts.append(f"{skip.count:,} {name.replace('_', ' ').replace('gaussian', 'Gaussian')}{saved}")
    return [Line(f"Left out, with the time it saved where that is known: {', '.join(parts)}.")] if parts else []


def _of_counts(counts: Counts) -> list[Line]:
    lines = []
    if unseen := counts.gaussians - counts.visible_gaussians:
        text = f"{unseen:,} of {counts.gaussians:,} Gaussians touch no pixel of any view and were left out."
        lines.append(Line(text))
    if counts.sh_degree_active < counts.sh_degree_stored:
        degrees = f"degree {counts.sh_degree_active} of {counts.sh_degree_stored}"
        text = f"Colour uses spherical harmonics of {degrees}; the bands above were left out."
        lines.append(Line(text))
    used = f"{counts.active_parameters:,} of {counts.parameters:,} parameters"
    views = f"{counts.views} of {counts.views_of}" if counts.views_of else f"{counts.views}"
    return [*lines, Line(f"The operator acts on {used}, over {views} views.")]


def of_slice(plane: schema.Slice | None, made: Provenance) -> list[Line]:
    """Sentences on a slice.  made: the provenance of its record."""
    if plane is None:
        return [Line("No slice of the loss was recorded.", "caution")]
    lines = []
    rendered = plane.points if plane.evaluated_points is None else plane.evaluated_points
    if not plane.is_resolved:
        lines.append(Line(unresolved(plane, made), "caution"))
    elif rendered < plane.points:
        text = f"Of the slice's {plane.points:,} points {rendered:,} are renders, among them all of both axes; the others are "
        lines.append(Line(f"{text}interpolated{_to_tolerance(plane)} ({_errors_of_interpolation(plane)})."))
    if plane.crossed_points:
        share = f"{plane.crossed_points:,} of the slice's {rendered:,} rendered points"
        text = f"At {share} the order of the splats or the set of visible ones is not the checkpoint's"
        lines.append(Line(f"{text}, which derivatives do not see.", "caution"))
    return lines


def _errors_of_interpolation(plane: schema.Slice) -> str:
    bound, count = plane.interpolation_error, plane.holdout_points
    seen = bound if plane.error_seen in (None, UNSET) else plane.error_seen
    size = "without bound" if seen is None else f"at most {_percent(seen)}"
    text = f"the error at {count} random point{'' if count == 1 else 's'}: {size}"
    return text if bound is None else f"{text}; the bound for all: {_percent(bound)}"


def unresolved(plane: schema.Slice, made: Provenance) -> str:
    """Why a plane is not drawn, and the command that resolves it."""
    limited = "--max-renders" in (made.command or "")
    resolving = "leave out --max-renders" if limited else f"landscape slice {made.checkpoint} renders more"
    return (
        f"Between its two sections the plane is not known{_to_tolerance(plane)} from {plane.evaluated_points:,} of "
        f"{plane.points:,} renders, and no surface is drawn; {resolving}."
    )


def _to_tolerance(plane: schema.Slice) -> str:
    return f" to {_percent(plane.tolerance)} of the range of the loss" if plane.tolerance else ""


def _sentence(note: str) -> str:
    return f"{note[:1].upper()}{note[1:]}" + ("" if note.endswith((".", "!", "?")) else ".")


def _is_finite(number: schema.Number) -> TypeGuard[float]:
    return number is not None and math.isfinite(number)


def _bracket(index: schema.Index, written: Callable[[float], str] | None = None) -> str:
    """Its bracket in words; none where its ends look alike.  written: formats an end."""
    ends = index.low, index.high
    texts = [UNDETERMINED if end is None else (written or quantity)(end) for end in ends]
    if None not in ends:
        return f" (between {texts[0]} and {texts[1]})" if texts[0] != texts[1] else ""
    known = [f" (at {words} {text})" for words, end, text in zip(("least", "most"), ends, texts, strict=True) if end]
    return known[0] if known else ""


def _percent(share: float) -> str:
    return f"{rough(100 * share)}%"


def _in_brackets(note: schema.Maybe[str]) -> str:
    return f" ({note})" if note else ""
