"""What a record says, in sentences: who carries the curvature, saddle or basin, how anisotropic, what was skipped.

Every sentence follows from numbers of the record and their errors alone; where an error does not decide, it says so.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from analysis.records.quantities import UNDETERMINED, limits, measured, quantity

ATTRIBUTES = {
    "means": "position",
    "log_scales": "log scale",
    "quats": "rotation",
    "opacity_logits": "opacity",
    "sh": "colour (SH)",
}


@dataclass(frozen=True)
class Line:
    """One sentence; a failure is a check that did not hold or a number that is none."""

    text: str
    level: Literal["fact", "caution", "failure"] = "fact"


def attribute_name(attribute: str) -> str:
    """The attribute in the paper's words; a name that is none of the five stays as it is."""
    return ATTRIBUTES.get(attribute, attribute)


def verdict(data: Mapping[str, Any]) -> list[Line]:
    """The sentences of a record's data, failures first."""
    lines = [
        *_of_checks(data["checks"]),
        *_of_traces(data["traces"]),
        *_of_ends(data["eigenvalues"]),
        *of_budgets(data["eigenvalues"]),
        *_of_anisotropy(data["anisotropy"]),
        *_of_needles(data["eigenvalues"]["max"].get("lives_on"), data["counts"]),
        *_of_finite_probe(data.get("finite_probe")),
        *_of_depth(data.get("depth")),
        *_of_counts(data["counts"]),
        *_of_skips(data.get("skipped", {})),
        *of_slice(data.get("slice")),
        *(Line(_sentence(note), "caution") for note in data.get("notes", ())),
    ]
    return sorted(lines, key=lambda line: line.level != "failure")


def _of_checks(checks: Mapping[str, Any]) -> list[Line]:
    lines = []
    for name, check in checks.items():
        label, note = name.replace("_", " "), _in_brackets(check)
        if check["passed"] is None:
            lines.append(Line(f"The check of {label} could not run{note}.", "caution"))
        elif not check["passed"]:
            measured, bound = quantity(check["value"]), quantity(check["bound"])
            text = f"The check of {label} failed: {measured}, where at most {bound} is allowed{note}."
            lines.append(Line(f"{text} Do not trust the numbers below.", "failure"))
    if checks and all(check["passed"] for check in checks.values()):
        lines.append(Line(f"All {len(checks)} checks passed."))
    return lines


def _of_traces(traces: Mapping[str, Any]) -> list[Line]:
    finite = {name: entry for name, entry in traces.items() if _is_finite(entry["value"])}
    lines = [
        Line(
            f"The trace of {attribute_name(name)} is {quantity(traces[name]['value'])}{_in_brackets(traces[name])}.",
            "failure",
        )
        for name in traces
        if name not in finite
    ]
    total = sum(abs(entry["value"]) for entry in finite.values())
    if total > 0:
        lines.append(_of_largest_trace(finite, total))
    elif finite:
        lines.append(Line("Every trace is exactly 0."))
    signs = {"negative": "negative: on average the loss curves down there", "undetermined": "not decided by its error"}
    for sign, words in signs.items():
        if named := [attribute_name(name) for name, entry in finite.items() if entry["sign"] == sign]:
            lines.append(Line(f"The sign of the trace of {' and '.join(named)} is {words}.", "caution"))
    return lines


def _of_largest_trace(traces: Mapping[str, Any], total: float) -> Line:
    """traces: those that are numbers; total: the sum of their magnitudes."""
    first, *others = sorted(traces, key=lambda name: -abs(traces[name]["value"]))
    value, share = traces[first]["value"], abs(traces[first]["value"]) / total
    part = "most" if share > 0.5 else "the largest part"
    text = (
        f"{attribute_name(first).capitalize()} carries {part} of the curvature: its trace, "
        f"{measured(value, traces[first]['standard_error'])}, is {share:.0%} of the sum of all absolute traces (each in its "
        "own stored units)."
    )
    if near := [attribute_name(name) for name in others if _overlap(traces[first], traces[name])]:
        text += f" Its error does not separate it from {' and '.join(near)}."
    return Line(text)


def _of_ends(ends: Mapping[str, Any]) -> list[Line]:
    top, bottom = ends["max"], ends["min"]
    numbers = [top["value"], top["residual"], bottom["value"], bottom["residual"]]
    if not all(_is_finite(number) for number in numbers):
        return [Line("The ends of the spectrum were not determined.", "failure")]
    high, low = measured(top["value"], top["residual"]), measured(bottom["value"], bottom["residual"])
    ends_text = f"the curvature runs from {low} to {high}"
    if bottom["value"] + bottom["residual"] < 0 < top["value"] - top["residual"]:
        return [Line(f"The Hessian is indefinite, so the checkpoint is no basin in every direction: {ends_text}.")]
    if bottom["value"] - bottom["residual"] > 0:
        return [Line(f"No direction of negative curvature was found: {ends_text}.")]
    if top["value"] + top["residual"] < 0:
        return [Line(f"No direction of positive curvature was found: {ends_text}.")]
    return [Line(f"Whether the Hessian is indefinite is not decided by the residuals: {ends_text}.", "caution")]


def of_budgets(ends: Mapping[str, Any]) -> list[Line]:
    """A residual says that an eigenvalue is near, not that none lies beyond: of that only a search that converged is a sign."""
    reasons = {name: ends[end].get("reason") or "" for end, name in (("max", "largest"), ("min", "smallest"))}
    return [
        Line(f"The search for the {name} eigenvalue ended at its {reason}: the end may lie farther out.", "caution")
        for name, reason in reasons.items()
        if reason.endswith("budget")
    ]


def _of_anisotropy(family: Mapping[str, Any]) -> list[Line]:
    lines = []
    saddle, share = family.get("saddle"), family.get("share")
    if saddle and _is_finite(saddle["value"]):
        text = f"The steepest direction up is {quantity(saddle['value'])} times as curved as the steepest down"
        lines.append(Line(f"{text}{_bracket(saddle)}."))
    elif saddle and _is_finite(saddle["low"]) and saddle["low"] > 0:
        text = f"The steepest direction up is at least {quantity(saddle['low'])} times as curved as the steepest down"
        lines.append(Line(f"{text}{_in_brackets(saddle)}."))
    elif saddle:
        lines.append(
            Line(f"The ratio of the two ends of the spectrum is not determined{_in_brackets(saddle)}.", "caution")
        )
    if share and _is_finite(share["value"]):
        bracket = _bracket(share, "{:.2%}".format)
        lines.append(
            Line(f"The steepest direction alone holds {share['value']:.2%} of all absolute curvature{bracket}.")
        )
    return lines


def _of_needles(where: Mapping[str, Any] | None, counts: Mapping[str, int]) -> list[Line]:
    """The paper's claim that Gaussians with an ill-conditioned projection dominate the steepest directions."""
    if where is None:
        return []
    count, share, spread = where["needle_count"], where["needles"], quantity(where["participation"])
    among = f"of {counts['visible_gaussians']:,} Gaussians in sight"
    if not count:
        text = f"None {among} has a condition number above 100; the steepest direction is spread over about {spread}."
        return [Line(text)]
    has, holds = ("has", "holds") if count == 1 else ("have", "hold")
    held = "under 1%" if 0 < share < 0.005 else f"{share:.0%}"
    text = f"{count:,} {among} {has} a condition number above 100 and {holds} {held} of the steepest direction"
    return [Line(f"{text}, which is spread over about {spread} Gaussians.")]


def _of_finite_probe(probe: Mapping[str, Any] | None) -> list[Line]:
    if probe is None:
        return []
    here, best = probe["infinitesimal"], probe["best"]
    text = f"Along {probe['direction']} the curvature is {quantity(here)}; over finite steps it is "
    far = probe["curvatures"][-1]
    if best is not None:
        error = math.hypot(probe["round_off"][best] or math.inf, probe["truncation"][best] or math.inf)
        text += f"{measured(probe['curvatures'][best], error)} at ±{quantity(probe['steps'][best])} and "
    return [Line(f"{text}{quantity(far)} at ±{quantity(probe['steps'][-1])}.")]


def resolved(probe: Mapping[str, Any]) -> list[bool]:
    """Of which finite steps round-off does not hide the curvature."""
    here = abs(probe["infinitesimal"])
    pairs = zip(probe["curvatures"], probe["round_off"], strict=True)
    return [_is_finite(value) and _is_finite(bound) and bound <= max(abs(value), here) / 2 for value, bound in pairs]


def _of_depth(depth: Mapping[str, Any] | None) -> list[Line]:
    """The paper's statement that the positions' gradient is typically 100 times as large along the rays as across them."""
    if depth is None:
        return []
    lines = []
    if _is_finite(depth["gradient_ratio"]):
        text = f"In depth, along the rays, the gradient of the positions is {quantity(depth['gradient_ratio'])} times"
        text += " what it is in a direction across them (root mean square; the paper says about 100)"
        if _is_finite(depth["curvature_ratio"]["value"]):
            ratio = depth["curvature_ratio"]
            text += f", and their curvature {quantity(ratio['value'])} times{_bracket(ratio)}"
        lines.append(Line(f"{text}."))
    rises = [row for row in depth["rises"] if _is_finite(row["ratio"])]
    if rises:
        parts = [f"{measured(row['ratio'], row['ratio_error'])} at {row['pixels']:g} px" for row in rises]
        crossed = max(row["depth_crossed"] for row in rises)
        text = "Steps along the rays raise the loss by this many times what steps as long across them do: "
        text += f"{', '.join(parts)}. They changed the order of the splats in up to {crossed:.0%} of the renders"
        lines.append(Line(f"{text}, which derivatives do not see."))
    return lines


def _of_skips(skipped: Mapping[str, Mapping[str, Any]]) -> list[Line]:
    """What was left out, the largest saving first."""
    present = {name: skip for name, skip in skipped.items() if skip["count"]}
    order = sorted(present, key=lambda name: -(present[name]["seconds_saved"] or 0.0))
    parts = []
    for name in order:
        count, seconds = present[name]["count"], present[name]["seconds_saved"]
        saved = "" if seconds is None else f" ({seconds:.1f} s)"
        parts.append(f"{count:,} {name.replace('_', ' ').replace('gaussian', 'Gaussian')}{saved}")
    return [Line(f"Left out, with the time it saved where that was measured: {', '.join(parts)}.")] if parts else []


def _of_counts(counts: Mapping[str, int]) -> list[Line]:
    lines = []
    unseen = counts["gaussians"] - counts["visible_gaussians"]
    if unseen:
        lines.append(
            Line(f"{unseen:,} of {counts['gaussians']:,} Gaussians touch no pixel of any view and were left out.")
        )
    if counts["sh_degree_active"] < counts["sh_degree_stored"]:
        degrees = f"degree {counts['sh_degree_active']} of {counts['sh_degree_stored']}"
        lines.append(Line(f"Colour uses spherical harmonics of {degrees}; the bands above were left out."))
    used = counts["active_parameters"], counts["parameters"]
    lines.append(Line(f"The operator acts on {used[0]:,} of {used[1]:,} parameters, over {counts['views']} views."))
    return lines


def of_slice(plane: Mapping[str, Any] | None) -> list[Line]:
    """The sentences of a slice alone."""
    if plane is None:
        return [Line("No slice of the loss was recorded.", "caution")]
    lines, points, rendered = [], plane.get("points", 0), plane.get("evaluated_points", plane.get("points", 0))
    error = plane.get("interpolation_error")
    if rendered < points:
        count = plane["holdout_points"]
        size = f"of at most {100 * error:.2g}% of the range of the loss" if error is not None else "without bound"
        lines.append(
            Line(
                f"Of the slice's {points:,} points {rendered:,} are renders; the others are interpolated, with an error at "
                f"{count} random point{'' if count == 1 else 's'} {size}."
            )
        )
    if plane.get("crossed_points"):
        share = f"{plane['crossed_points']:,} of the slice's {rendered:,} rendered points"
        lines.append(Line(f"At {share} the order of the splats or the set of visible ones is not the checkpoint's."))
    return lines


def _sentence(note: str) -> str:
    return f"{note[:1].upper()}{note[1:]}" + ("" if note.endswith((".", "!", "?")) else ".")


def _is_finite(number: float | None) -> bool:
    return number is not None and math.isfinite(number)


def _overlap(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Whether two standard errors of the difference of the sizes reach 0; an infinite error always does."""
    errors = [entry["standard_error"] for entry in (first, second)]
    if not all(_is_finite(error) for error in errors):
        return True
    return abs(abs(first["value"]) - abs(second["value"])) < 2 * math.hypot(*errors)


def _bracket(entry: Mapping[str, Any], written: Callable[[float], str] | None = None) -> str:
    """Between which numbers it lies.  written: how one of them is, where not as `limits` has them."""
    ends = entry["low"], entry["high"]
    texts = limits(*ends) if written is None else [UNDETERMINED if end is None else written(end) for end in ends]
    return "" if ends == (None, None) else f" (between {texts[0]} and {texts[1]})"


def _in_brackets(entry: Mapping[str, Any]) -> str:
    return f" ({entry['note']})" if entry.get("note") else ""
