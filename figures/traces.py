"""Figure: how steep each attribute is, in a unit that all share, beside the trace of its block of the Hessian as a number.

Traces have the units of their attributes, so they do not compare.  What is drawn is s^2 tr / 2 as a share of the loss: the mean
change of the loss by curvature when every parameter of the attribute moves by +-s at random, s the length of the optimiser's
first step; an orange diamond where renders of such steps have it.  Of a record without s the traces themselves are drawn, and
the title says that they do not compare.

Magnitudes are on a logarithmic axis; the sign is in the marker (filled circle: positive; open square: negative; open
diamond: the interval does not decide it).  An arrow at the left edge is a zero, or an interval that reaches 0.
"""

import math
from typing import Any, TypeGuard

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter
from msgspec import structs

from analysis.records.findings import attribute_name, largest_steps, shares_per_trace
from analysis.records.quantities import measured, power_of_ten, rough
from analysis.records.records import ProbeRecord, Record
from analysis.records.schema import Trace
from figures.style import NEGATIVE, ORANGE, POSITIVE, UNDETERMINED, literal, new_figure, style

SIGNS: dict[str, dict[str, Any]] = {
    "positive": {"color": POSITIVE, "marker": "o", "markerfacecolor": POSITIVE},
    "negative": {"color": NEGATIVE, "marker": "s", "markerfacecolor": "white"},
    "zero": {"color": UNDETERMINED, "marker": "<", "markerfacecolor": UNDETERMINED},
    "undetermined": {"color": UNDETERMINED, "marker": "D", "markerfacecolor": "white"},
}
RENDERED: dict[str, Any] = {"color": ORANGE, "marker": "D", "linestyle": "none", "markersize": 4}


def draw(record: Record[ProbeRecord]) -> Figure:
    """One row an attribute."""
    entries = record.data.traces
    samples = record.arrays.get("traces", {})
    shares = shares_per_trace(record.data)
    with style():
        figure = new_figure(0.95 + 0.31 * len(entries))
        axes = figure.subplots()
        _rows(axes, entries)
        if shares:
            loss, rendered = record.data.objective.value or 1.0, record.data.step_rises or {}
            rises = {name: abs(rise) / loss for name, (rise, _) in rendered.items()}
            _draw_traces(axes, {name: scaled(entry, shares[name]) for name, entry in entries.items()},
                         {name: shares[name] * np.asarray(found) for name, found in samples.items()}, rises)  # fmt: skip
            axes.set_xlabel("share by which the loss changes in a random step\nas long as the optimiser's first")
        else:
            _draw_traces(axes, entries, samples)
            axes.set_xlabel("|trace|; rows have units of their own\nand do not compare")
        figure.suptitle(_title(record.data), x=0.02, ha="left", fontsize=7.5)
        handles = _legend(entries, by="by curvature" if shares else "")
        if shares and record.data.step_rises:
            handles.append(Line2D([], [], label="rendered", **RENDERED))
        figure.legend(handles=handles, loc="outside lower center", ncols=3, handletextpad=0.2, columnspacing=1)
    return figure


def scaled(trace: Trace, factor: float) -> Trace:
    """The trace in another unit."""
    names = ("value", "standard_error", "low", "high")
    found = {name: getattr(trace, name) for name in names}
    return structs.replace(trace, **{name: x if x is None else factor * x for name, x in found.items()})


def _title(data: ProbeRecord) -> str:
    """Name of the steepest attribute, and its ratio to the next where their intervals do not overlap."""
    if len(shares_per_trace(data)) < 2:
        return "Curvature of each attribute"
    if (found := largest_steps(data)) is None:
        return "In no attribute a step changes the loss most for certain"
    first, second, ratio = found
    rendered = "rendered, " if data.step_rises else "by curvature alone, "
    text = f"A step in {attribute_name(first)} changes the loss most:\n{rendered}{rough(ratio)} × "
    return f"{text}{attribute_name(second)}\n(beside the names: traces, each in its own unit)"


def _draw_traces(
    axes: Axes, entries: dict[str, Trace], samples: dict[str, np.ndarray], rendered: dict[str, float] | None = None
) -> None:
    rendered = rendered or {}
    magnitudes = [abs(n) for n in (*(e.value for e in entries.values()), *rendered.values()) if _drawable(n)]
    left = _logarithmic(axes, magnitudes)
    for row, (name, entry) in enumerate(entries.items()):
        axes.plot([rendered.get(name, math.nan)], [row], **RENDERED, zorder=6)
        look = SIGNS[_sign(entry)]
        drawn = np.abs(samples.get(name, np.empty(0)))
        axes.plot(drawn, np.full(len(drawn), row), "|", color=look["color"], alpha=0.35, markersize=6, zorder=1)
        if not _drawable(entry.value):
            if entry.value == 0:
                _arrow(axes, left, row, look)
            continue
        value = abs(entry.value)
        low, high = sorted(abs(end) for end in entry.interval)
        low = left if entry.interval[0] * entry.interval[1] <= 0 else max(low, left)
        axes.plot([low, max(high, value)], [row, row], "-", color=look["color"], linewidth=1.4)
        if low == left:
            _arrow(axes, left, row, {**look, "markerfacecolor": look["color"]})
        axes.plot([value], [row], linestyle="none", **look)


def _rows(axes: Axes, entries: dict[str, Trace]) -> None:
    numbers = {name: measured(entry.value, entry.standard_error) for name, entry in entries.items()}
    axes.set_yticks(range(len(entries)), [f"{literal(attribute_name(k))}\n{n}" for k, n in numbers.items()])
    axes.set_ylim(len(entries) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.grid(True, axis="both")


def _logarithmic(axes: Axes, magnitudes: list[float]) -> float:
    """A logarithmic x axis around the magnitudes, with at most six labelled decades; returns its left end."""
    low, high = (min(magnitudes), max(magnitudes)) if magnitudes else (1.0, 1.0)
    first, last = math.floor(math.log10(low) - 0.5), math.ceil(math.log10(high) + 0.5)
    axes.set_xscale("log")
    axes.set_xlim(10.0**first, 10.0**last)
    stride = max(1, math.ceil((last - first) / 5))
    exponents = range(first, last + 1, stride)
    axes.set_xticks([10.0**k for k in exponents], [power_of_ten(k) for k in exponents])
    axes.xaxis.set_minor_locator(LogLocator(numticks=50) if stride > 1 else LogLocator(subs=range(2, 10)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    return 10.0**first


def _arrow(axes: Axes, left: float, row: int, look: dict[str, Any]) -> None:
    axes.plot([left], [row], linestyle="none", clip_on=False, zorder=5, **{**look, "marker": "<"})


def _sign(trace: Trace) -> str:
    return "undetermined" if trace.value is None or math.isnan(trace.value) else trace.sign


def _drawable(number: float | None) -> TypeGuard[float]:
    return number is not None and math.isfinite(number) and number != 0


def _legend(entries: dict[str, Trace], by: str) -> list[Line2D]:
    """by: of what the marks are; they are told apart by the signs where not all are positive."""
    present = {_sign(entry) for entry in entries.values()}
    if present == {"positive"}:
        return [Line2D([], [], linestyle="none", label=by, **SIGNS["positive"])] if by else []
    labels = {sign: f"{by}, {sign}".removeprefix(", ") for sign in SIGNS if sign in present}
    return [Line2D([], [], linestyle="none", label=words, **SIGNS[sign]) for sign, words in labels.items()]
