"""The anisotropy families of a record as text: one line for each operator and block, for the terminal and the report."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from rich import box
from rich.table import Table

from analysis.records.findings import attribute_name
from analysis.records.quantities import UNDETERMINED, limits, measured, quantity

INDICES = ("literal", "saddle", "share", "effective_rank", "mass_quantile")
OPERATOR_NAMES = {"hessian": "Hessian", "gauss-newton": "Gauss-Newton"}
WIDTH = 15  # of a column of the terminal's table, with which it fits into 80
CAPTION = "≥: λ min was not reached, or cannot be told from 0"
NARROW = 0.1  # of the value: a bracket that is written as an error


@dataclass(frozen=True)
class Cell:
    """A number as text, what its bracket leaves open, and a note."""

    value: str
    bracket: str = ""
    note: str = ""


BLANK = (Cell(""), Cell(""))


@dataclass(frozen=True)
class Line:
    """One family, or what the split does to it: ends, two cells, and indices, one of each in INDICES."""

    operator: str
    block: str
    scene: str
    gaussians: str
    directions: str
    ends: tuple[Cell, ...]
    indices: tuple[Cell, ...]


def family_lines(data: Mapping[str, Any]) -> list[Line]:
    """Of every operator and block: the families, that of the split scene beneath the other, and what the split changes."""
    rows = data.get("families", [])
    control = data.get("split_control")
    lines = []
    for row in (row for row in rows if not row["split"]):
        same = [other for other in rows if _key(other) == _key(row)]
        lines += [_line(one, bool(control)) for one in same]
        if control:
            effects = {e["index"]: e for e in control["effects"] if _key(e) == _key(row)}
            factors = tuple(_factor(effects[name]) for name in INDICES)
            lines.append(
                replace(lines[-1], scene="changes by", gaussians="", directions="", ends=BLANK, indices=factors)
            )
    return lines


def family_table(data: Mapping[str, Any]) -> Table:
    """The indices of the lines, brackets beneath the values, within 80 columns: without saddle, which is -literal."""
    title = f"Anisotropy by attribute ({data['families'][0]['unit']})"
    look: dict[str, Any] = {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0), "pad_edge": False, "show_edge": False}
    table = Table(title=title, caption=CAPTION, **look)
    table.add_column("", no_wrap=True)
    shown = [i for i, name in enumerate(INDICES) if name != "saddle"]
    for i in shown:
        table.add_column(INDICES[i].replace("_", " "), justify="right", no_wrap=True)
    operator = ""
    for line in family_lines(data):
        if line.operator != operator:
            table.add_section()
            table.add_row(operator := line.operator, style="bold")
        label = line.block if line.scene in ("", "trained") else f"  {line.scene}"
        cells = [line.indices[i] for i in shown]
        table.add_row(label, *("\n".join(_folded(text) for text in (c.value, c.bracket) if text) for c in cells))
    return table


def _folded(text: str) -> str:
    """In two lines where it is too wide for a column.

    >>> _folded("7.45 × 10⁻⁴ … 1.02 × 10⁴"), _folded("34.1 … 120")
    ('7.45 × 10⁻⁴ …\\n1.02 × 10⁴', '34.1 … 120')
    """
    return text if len(text) <= WIDTH else text.replace(" ± ", "\n± ").replace(" … ", " …\n")


def bracketed(index: Mapping[str, Any]) -> Cell:
    """An index as text: a narrow bracket as an error, and one without upper end as the bound that it is.

    >>> bracketed({"value": 7.0, "low": 34.2, "high": None, "note": "lambda_min is not resolved"}).value
    '≥ 34.2'
    >>> bracketed({"value": 2.0, "low": 1.95, "high": 2.04, "note": ""}).value
    '2.000 ± 0.050'
    """
    value, low, high, note = (index[key] for key in ("value", "low", "high", "note"))
    if (low is None and high is None) or (high is None and low == 0):
        return Cell(UNDETERMINED, "", note)
    if high is None or low is None:
        return Cell(f"≥ {quantity(low)}" if high is None else f"≤ {quantity(high)}", "", note)
    if value is not None and low <= value <= high and high - low < NARROW * abs(value):
        return Cell(measured(value, max(high - value, value - low)), "", note)
    return Cell(quantity(value), " … ".join(limits(low, high)), note)


def _line(row: Mapping[str, Any], several: bool) -> Line:
    ends = tuple(_end(row[f"lambda_{name}"], row.get("beyond"), sign) for name, sign in (("max", 1), ("min", -1)))
    indices = tuple(bracketed(row["indices"][name]) for name in INDICES)
    scene = "" if not several else "split" if row["split"] else "trained"
    operator, block = OPERATOR_NAMES[row["operator"]], attribute_name(row["block"])
    return Line(operator, block, scene, f"{row['gaussians']:,}", f"{row['rank']:,}", ends, indices)


def _end(pair: Mapping[str, Any], beyond: float | None, outwards: int) -> Cell:
    """An end of the spectrum; of one that the budget did not reach, between what it lies.  outwards: 1 for the largest."""
    value, residual, reason = pair["value"], pair["residual"], pair["reason"]
    if not reason.endswith("budget") or value is None or residual is None:
        return Cell(measured(value, residual), "", reason)
    inner = quantity(value - outwards * residual)
    if beyond is None:
        return Cell("not reached", f"{'≥' if outwards > 0 else '≤'} {inner}", reason)
    outer = quantity(value + outwards * (residual + beyond))
    return Cell("not reached", " … ".join((inner, outer)[::outwards]), reason)


def _factor(effect: Mapping[str, Any]) -> Cell:
    """What an index is multiplied by."""
    cell = bracketed(effect)
    return cell if cell.value == UNDETERMINED else Cell(f"× {cell.value}", cell.bracket, cell.note)


def _key(row: Mapping[str, Any]) -> tuple[str, str]:
    return row["operator"], row["block"]
