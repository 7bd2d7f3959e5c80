"""Tables of a probe's record: all numbers, for the report; the anisotropy families, for the terminal and the report."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from msgspec import UNSET, UnsetType
from rich import box
from rich.markup import escape
from rich.table import Table

from analysis.records.findings import attribute_name, is_open, is_wide
from analysis.records.quantities import UNDETERMINED, apart, folded, limits, measured, percent, quantity, rough
from analysis.records.records import Check, Counts, ProbeRecord
from analysis.records.schema import INDICES, BlockAnisotropy, Depth, Effect, End, Index, Number

ENDS = {
    "max": "largest eigenvalue",
    "second": "second largest",
    "min": "smallest eigenvalue",
    "power_max": "power iteration, max",
    "power_min": "power iteration, min",
}
NEEDS_DENSITY = "needs the spectral density, which was left out"  # note of an index
OPERATOR_NAMES = {"hessian": "Hessian", "gauss-newton": "Gauss-Newton"}
CAPTION = "≥: λ min was not reached, or cannot be told from 0"
LEAST = 0.005  # share of an attribute in an eigenvector that is told
WIDTH = 15  # of a column of the families' table, with which it fits into 80
MEASURES = {
    "order_fragility": "mean change of a colour when depths change by 1% at random, which only the order of Gaussians sees",
    "field_sharpness": "rise of the loss, at new poses change of a colour, by a random field over the Gaussians",
    "critical_sharpness": "2 / η; η: of the optimiser's next step, at which the loss is again what it is now",
    "adam_sharpness": "largest eigenvalue as the optimiser scales its next step; full steps oscillate beyond 38",
    "open_curvature": "mean variance of a pixel of new poses that the training views leave open",
    "open_ratio": "the same over that at the training poses",
}
NARROW = 0.1  # width of a bracket, over the value, below which it is written as an error
Row = tuple[str, str, str]


def number_rows(data: ProbeRecord) -> dict[str, list[Row]]:
    """Rows of all numbers, by section: name, value ± error, what else is known."""
    sections = {
        "Curvature by attribute": _trace_rows(data),
        "Extreme eigenvalues": _end_rows(data),
        "Anisotropy": _index_rows(data),
        "Positions along and across the rays": _depth_rows(data.depth),
        "Beyond derivatives at the training views": _measure_rows(data.measures or {}),
        "Sizes": _count_rows(data.counts),
        "Checks": _check_rows(data.checks),
    }
    return {name: known for name, rows in sections.items() if (known := list(rows))}


def _trace_rows(data: ProbeRecord) -> Iterator[Row]:
    for name, trace in data.traces.items():
        made = f", {trace.probes} samples" if trace.probes else ""
        about = (
            f"{limits(trace.low, trace.high)}, {trace.sign}, τ {quantity(trace.tau)}, dim {trace.dim:,}, {trace.method}"
            f"{made}{_reason(trace.reason)}{_of_views(trace.views_error)}"
        )
        yield f"trace of {attribute_name(name)}", measured(trace.value, trace.standard_error), about


def _end_rows(data: ProbeRecord) -> Iterator[Row]:
    """Rows of the eigenvalues; one whose search ended at a budget has its value among the words."""
    for name, end in data.eigenvalues.items():
        shares = ", ".join(f"{share:.0%} {attribute_name(of)}" for of, share in end.shares.items() if share >= LEAST)
        value, made = measured(end.value, end.residual), f"{end.matvecs} products" if end.matvecs else ""
        known = ", ".join(filter(None, (shares, end.method, made)))
        about = f"{known}{_reason(end.reason)}{_of_views(end.views_error)}"
        if not end.is_reached:
            value, about = UNDETERMINED, f"at {value} so far; {about}"
        yield ENDS[name], value, about
    if where := data.eigenvalues.max.lives_on:
        among = f"which {where.needle_count:,} of the {data.counts.visible_gaussians:,} Gaussians in sight are"
        yield "share of e₁ on needles", percent(where.needles), among
    for name, of in (("max", "e₁"), ("min", "eₘᵢₙ")):
        if where := getattr(data.eigenvalues, name).lives_on:
            yield f"Gaussians that {of} is spread over", rough(where.participation), ""


def _index_rows(data: ProbeRecord) -> Iterator[Row]:
    """Rows of the indices, but for those that the record's notes name as left out."""
    for name, index in data.indices.items():
        if index.note != NEEDS_DENSITY:
            yield name.replace("_", " "), *_index(index)


def _count_rows(counts: Counts) -> Iterator[Row]:
    yield "Gaussians in sight", f"{counts.visible_gaussians:,}", f"of {counts.gaussians:,}"
    yield "active parameters", f"{counts.active_parameters:,}", f"of {counts.parameters:,}"
    yield "SH degree in use", f"{counts.sh_degree_active}", f"of {counts.sh_degree_stored}"


def _check_rows(checks: Mapping[str, Check]) -> Iterator[Row]:
    for name, check in checks.items():
        outcome = {None: "could not run", True: "passed", False: "FAILED"}[check.passed]
        note = f" ({check.note})" if check.note else ""
        yield (name.replace("_", " "), quantity(check.value), f"{outcome}, at most {quantity(check.bound)}{note}")


def _reason(reason: str | None) -> str:
    """Why an estimate stopped, unless it reached its tolerance."""
    return "" if reason in ("tolerance", "exact") else f", {reason}"


def _of_views(error: float | UnsetType | None) -> str:
    """Standard error for the views left out, where some were."""
    return "" if error is UNSET else f", views left out{apart(error)}"


def _depth_rows(depth: Depth | None) -> Iterator[Row]:
    """Rows of the positions' derivatives and rises along the rays, over those in one direction across them."""
    if depth is None:
        return
    median = f"median {quantity(depth.gradient_median)}, {depth.pairs:,} pairs of Gaussian and view"
    yield "depth gradient / lateral", quantity(depth.gradient_ratio), median
    yield "depth curvature / lateral", *_index(depth.curvature_ratio)
    for kind, trace in depth.curvature.items():
        yield f"trace of curvature, {kind}", measured(trace.value, trace.standard_error), f"dim {trace.dim:,}"
    for row in depth.rises:
        rises = f"{measured(row.depth, row.depth_error)} over {measured(row.lateral, row.lateral_error)}"
        rises += f"; order changed in {row.depth_crossed:.0%} and {row.lateral_crossed:.0%} of the renders"
        yield f"depth / lateral rise, {row.pixels:g} px", measured(row.ratio, row.ratio_error), rises


def columns_of(found: Mapping[str, tuple[Number, Number]]) -> dict[str, Number]:
    """A row of a table: each number by its name, and its error, where it has one, behind it as name_error."""
    row: dict[str, Number] = {}
    for name, (value, error) in found.items():
        row |= {name: value} | ({} if error is None else {f"{name}_error": error})
    return row


def _measure_rows(found: Mapping[str, tuple[Number, Number]]) -> Iterator[Row]:
    for name, number in found.items():
        kind = name.removesuffix("_new")
        about = MEASURES[kind] + (", at new poses" if name != kind else "")
        yield kind.replace("_", " "), quantity(number[0]) if name == "open_ratio" else measured(*number), about


def _index(index: Index) -> tuple[str, str]:
    """Value, and its bracket with the note; a value with an open bracket is not written (`bracketed`)."""
    cell = bracketed(index)
    if index.low is None and index.high is None:
        return UNDETERMINED, index.note
    if is_open(index):
        return UNDETERMINED, f"{cell.value} ({index.note})"
    bracket = cell.bracket.replace(" … ", " to ")
    return cell.value, f"{bracket} ({index.note})" if bracket and index.note else bracket or index.note


@dataclass(frozen=True)
class Cell:
    """A number as text, its bracket and a note."""

    value: str
    bracket: str = ""
    note: str = ""


BLANK = (Cell(""), Cell(""))


@dataclass(frozen=True)
class FamilyLine:
    """One family, or the factors by which the split changes it.  ends: largest, smallest; indices: in the order of INDICES."""

    operator: str
    block: str
    scene: str
    gaussians: str
    directions: str
    ends: tuple[Cell, ...]
    indices: tuple[Cell, ...]


def family_lines(data: ProbeRecord) -> list[FamilyLine]:
    """Lines of every operator and block: the trained scene's, the split scene's, and the factors between them."""
    rows, control = data.per_attribute or [], data.split_control
    lines = []
    for row in (row for row in rows if not row.split):
        lines += [_line(each, bool(control)) for each in rows if _key(each) == _key(row)]
        if control:
            effects = {effect.index: effect for effect in control.effects if _key(effect) == _key(row)}
            factors = tuple(factor(effects.get(name)) for name in INDICES)
            lines.append(
                replace(lines[-1], scene="changes by", gaussians="", directions="", ends=BLANK, indices=factors)
            )
    return lines


def family_table(data: ProbeRecord) -> Table:
    """The indices of all lines, brackets below, within 80 columns; without negative_ratio, -1 / eigenvalue_ratio."""
    title = escape(f"Anisotropy by attribute ({data.per_attribute[0].unit})") if data.per_attribute else None
    look: dict[str, Any] = {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0), "pad_edge": False, "show_edge": False}
    table = Table(title=title, caption=CAPTION, **look)
    table.add_column("", no_wrap=True)
    shown = [i for i, name in enumerate(INDICES) if name != "negative_ratio"]
    for i in shown:
        table.add_column(INDICES[i].replace("_", " "), justify="right", no_wrap=True)
    operator = ""
    for line in family_lines(data):
        if line.operator != operator:
            table.add_section()
            table.add_row(operator := line.operator, style="bold")
        label = line.block if line.scene in ("", "trained") else f"  {line.scene}"
        cells = [line.indices[i] for i in shown]
        texts = ("\n".join(folded(text, WIDTH) for text in (c.value, c.bracket) if text) for c in cells)
        table.add_row(escape(label), *texts)
    return table


def bracketed(index: Index | None) -> Cell:
    """An index as text: with a narrow bracket as its error; the bound alone of an open bracket; a wide bracket alone.

    >>> bracketed(Index(value=7.0, low=34.2, high=None, note="lambda_min is not resolved")).value
    '≥ 34.2'
    >>> print(bracketed(Index(value=2.0, low=1.95, high=2.04, note="")).value.replace("\N{NO-BREAK SPACE}", " "))
    2.00 ± 0.05
    >>> bracketed(Index(value=2.0, low=1.0, high=30.0, note=""))
    Cell(value='–', bracket='1.00 … 30.0', note='')
    """
    if index is None:
        return Cell(UNDETERMINED)
    value, low, high, note = index.value, index.low, index.high, index.note
    if (low is None and high is None) or (high is None and low == 0):
        return Cell(UNDETERMINED, "", note)
    if high is None or low is None:
        return Cell(f"≥ {quantity(low)}" if high is None else f"≤ {quantity(high)}", "", note)
    if value is not None and low <= value <= high and high - low < NARROW * abs(value):
        return Cell(measured(value, max(high - value, value - low)), "", note)
    return Cell(UNDETERMINED if is_wide(index) else quantity(value), limits(low, high), note)


def factor(effect: Effect | None) -> Cell:
    """Factor of the split on an index."""
    cell = bracketed(effect)
    return cell if cell.value == UNDETERMINED else replace(cell, value=f"× {cell.value}")


def _line(row: BlockAnisotropy, several: bool) -> FamilyLine:
    ends = _end(row.lambda_max, row.beyond, 1), _end(row.lambda_min, row.beyond, -1)
    indices = tuple(bracketed(getattr(row.indices, name) or None) for name in INDICES)
    scene = "" if not several else "split" if row.split else "trained"
    operator, block = OPERATOR_NAMES[row.operator], attribute_name(row.block)
    return FamilyLine(operator, block, scene, f"{row.gaussians:,}", f"{row.rank:,}", ends, indices)


def _end(end: End, beyond: Number, outwards: int) -> Cell:
    """An end of the spectrum, or the bounds of one whose search ran out of its budget.  outwards: 1 of the largest, else -1."""
    value, residual, reason = end.value, end.residual, end.reason or ""
    if end.is_reached or value is None or residual is None:
        return Cell(measured(value, residual), "", reason)
    inner = quantity(value - outwards * residual)
    if beyond is None:
        return Cell("not reached", f"{'≥' if outwards > 0 else '≤'} {inner}", reason)
    outer = quantity(value + outwards * (residual + beyond))
    return Cell("not reached", " … ".join((inner, outer)[::outwards]), reason)


def _key(row: BlockAnisotropy | Effect) -> tuple[str, str]:
    return row.operator, row.block
