"""Several runs as rows of quantities, a column a run: for the terminal, the page and the file.

OUT/compare.csv     section, quantity, run, value, low, high, note: low and high are the ends of the interval of a trace, of
                    value -+ residual of an eigenvalue, of the bracket of an index
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from rich import box
from rich.markup import escape
from rich.table import Table

from analysis.records.family_table import INDICES, OPERATOR_NAMES, Cell, bracketed
from analysis.console.overrides import leaves
from analysis.records.quantities import PLACES, SCORES, measured, quantity
from analysis.records.findings import attribute_name
from splat.training.checkpoint import Checkpoint
from splat.training.state import Method

FAMILIES = "families"  # a section that only the page and the file show
DEPTH = "depth over lateral"


@dataclass(frozen=True)
class Run:
    """A run and its probe: the folder, what it is called here, its checkpoint, and the data of metrics and record."""

    folder: Path
    label: str
    checkpoint: Checkpoint
    metrics: Mapping[str, Any]
    data: Mapping[str, Any]


@dataclass(frozen=True)
class Entry:
    """A number of a run, the ends of its interval, and how it is written."""

    value: float | str | None
    cell: Cell
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Row:
    """One quantity, an entry for each run."""

    section: str
    name: str
    entries: tuple[Entry, ...]


MISSING = Entry(None, Cell(quantity(None)))


def comparison(runs: Sequence[Run]) -> list[Row]:
    """All quantities, section by section."""
    return [*_about(runs), *_scores(runs), *_curvature(runs), *_indices(runs), *_depth(runs), *_families(runs)]


def _about(runs: Sequence[Run]) -> Iterable[Row]:
    configs = [run.checkpoint.training.config for run in runs]
    seconds = [run.metrics.get("seconds") or {} for run in runs]
    yield Row("run", "method", tuple(_method(config.method) for config in configs))
    yield Row("run", "steps", tuple(_plain(run.checkpoint.training.step) for run in runs))
    yield Row("run", "Gaussians", tuple(_plain(run.data["counts"]["gaussians"]) for run in runs))
    yield Row("run", "in sight", tuple(_plain(run.data["counts"]["visible_gaussians"]) for run in runs))
    for clock, name in (("wall", "seconds of training"), ("cpu", "seconds of all processors")):
        yield Row("run", name, tuple(_plain(each.get(clock)) for each in seconds))


def _scores(runs: Sequence[Run]) -> Iterable[Row]:
    for part, words in (("test", "held-out views"), ("train", "training views")):
        for key, name in SCORES.items():
            values = [(run.metrics.get(part) or {}).get(key) for run in runs]
            if any(value is not None for value in values):
                yield Row(words, name, tuple(_plain(value, PLACES[key]) for value in values))


def _curvature(runs: Sequence[Run]) -> Iterable[Row]:
    for name in runs[0].data["traces"]:
        entries = tuple(_trace(run.data["traces"][name]) for run in runs)
        yield Row("trace", attribute_name(name), entries)
    for end, words in (("max", "largest eigenvalue"), ("min", "smallest eigenvalue")):
        yield Row("spectrum", words, tuple(_end(run.data["eigenvalues"][end]) for run in runs))


def _indices(runs: Sequence[Run]) -> Iterable[Row]:
    """Each index of the whole Hessian; beneath it what the split multiplies it by, where that was measured."""
    for name in INDICES:
        yield Row("anisotropy", name.replace("_", " "), tuple(_index(run.data["anisotropy"].get(name)) for run in runs))
        factors = tuple(_effect(run.data, "hessian", "all", name) for run in runs)
        if any(entry is not MISSING for entry in factors):
            yield Row("anisotropy", "  split control", factors)


def _depth(runs: Sequence[Run]) -> Iterable[Row]:
    """Positions along the rays over those across them, where a run's probe has that."""
    found = [run.data.get("depth") for run in runs]
    if not any(found):
        return
    gradients = tuple(MISSING if depth is None else _plain(depth["gradient_ratio"]) for depth in found)
    yield Row(DEPTH, "gradient", gradients)
    curvatures = tuple(MISSING if depth is None else _index(depth["curvature_ratio"]) for depth in found)
    yield Row(DEPTH, "curvature", curvatures)
    lengths = dict.fromkeys(row["pixels"] for depth in found if depth for row in depth["rises"])
    for pixels in lengths:
        entries = tuple(_rise(depth, pixels) for depth in found)
        yield Row(DEPTH, f"rise at {pixels:g} px", entries)


def _families(runs: Sequence[Run]) -> Iterable[Row]:
    """Of every operator and block that a run has families of."""
    rows = [row for run in runs for row in run.data.get("families", []) if not row["split"]]
    for operator, block in dict.fromkeys((row["operator"], row["block"]) for row in rows):
        for index in INDICES:
            entries = tuple(_family(run.data, operator, block, index) for run in runs)
            words = f"{OPERATOR_NAMES[operator]}, {attribute_name(block)}: {index.replace('_', ' ')}"
            yield Row(FAMILIES, words, entries)
            factors = tuple(_effect(run.data, operator, block, index) for run in runs)
            if any(entry is not MISSING for entry in factors):
                yield Row(FAMILIES, "  split control", factors)


def _method(method: Method) -> Entry:
    """Its name, and beneath it the settings that are not the published ones.

    >>> from splat.training.methods.stablegs.stablegs import StableGS
    >>> _method(StableGS(vsp_weight=0.0)).cell
    Cell(value='stablegs', bracket='vsp_weight 0.0', note='')
    >>> _method(StableGS(vsp_weight=0.0, warm_up=50)).value
    'stablegs warm_up 50, vsp_weight 0.0'
    """
    published, chosen = leaves(asdict(type(method)())), leaves(asdict(method))
    changed = [f"{name} {value}" for name, value in chosen.items() if value != published[name]]
    return Entry(f"{method.name} {', '.join(changed)}".strip(), Cell(method.name, "\n".join(changed)))


def _plain(value: float | str | None, places: int | None = None) -> Entry:
    match value:
        case None:
            return MISSING
        case str():
            return Entry(value, Cell(value))
        case int():
            return Entry(value, Cell(f"{value:,}"))
    number = float(value)
    return Entry(number, Cell(quantity(number) if places is None else f"{number:.{places}f}"))


def _trace(entry: Mapping[str, Any]) -> Entry:
    cell = Cell(measured(entry["value"], entry["standard_error"]), "", entry.get("note", ""))
    return Entry(entry["value"], cell, entry.get("low"), entry.get("high"))


def _end(entry: Mapping[str, Any]) -> Entry:
    value, residual = entry["value"], entry["residual"]
    cell = Cell(measured(value, residual), "", entry.get("reason", ""))
    if value is None or residual is None:
        return Entry(value, cell)
    return Entry(value, cell, value - residual, value + residual)


def _index(entry: Mapping[str, Any] | None) -> Entry:
    return MISSING if entry is None else Entry(entry["value"], bracketed(entry), entry["low"], entry["high"])


def _rise(depth: Mapping[str, Any] | None, pixels: float) -> Entry:
    """The ratio of the rises at steps of this length, with two standard errors."""
    for row in depth["rises"] if depth else ():
        if row["pixels"] == pixels and row["ratio"] is not None and row["ratio_error"] is not None:
            ratio, error = row["ratio"], row["ratio_error"]
            return Entry(ratio, Cell(measured(ratio, error)), ratio - 2 * error, ratio + 2 * error)
    return MISSING


def _family(data: Mapping[str, Any], operator: str, block: str, index: str) -> Entry:
    for row in data.get("families", []):
        if (row["operator"], row["block"], row["split"]) == (operator, block, False):
            return _index(row["indices"][index])
    return MISSING


def _effect(data: Mapping[str, Any], operator: str, block: str, index: str) -> Entry:
    """What splitting every Gaussian in two multiplies an index by."""
    for effect in (data.get("split_control") or {}).get("effects", []):
        if (effect["operator"], effect["block"], effect["index"]) == (operator, block, index):
            found = _index(effect)
            known = found.cell.value != quantity(None)
            return (
                Entry(found.value, Cell(f"× {found.cell.value}", found.cell.bracket), found.low, found.high)
                if known
                else found
            )
    return MISSING


def frame(rows: Sequence[Row], labels: Sequence[str]) -> pd.DataFrame:
    """A line for every row and run; a split control carries the name of the index above it."""
    lines, above = [], ""
    for row in rows:
        name = f"{above}, split control" if row.name.startswith(" ") else row.name
        above = name if not row.name.startswith(" ") else above
        for label, entry in zip(labels, row.entries, strict=True):
            numbers = {"value": entry.value, "low": entry.low, "high": entry.high}
            lines.append({"section": row.section, "quantity": name, "run": label, **numbers, "note": entry.cell.note})
    return pd.DataFrame(lines)


def compare_table(rows: Sequence[Row], labels: Sequence[str]) -> Table:
    """A column a run; the families are left to the page."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("")
    for label in labels:
        table.add_column(escape(label), justify="right")
    section = ""
    for row in rows:
        if row.section == FAMILIES:
            continue
        if row.section != section:
            table.add_section()
            section = row.section
        name = f"trace of {row.name}" if row.section == "trace" else row.name
        name = f"depth / lateral {row.name}" if row.section == DEPTH else name
        name += ", training views" if row.section == "training views" else ""
        cells = ("\n".join(filter(None, (entry.cell.value, entry.cell.bracket))) for entry in row.entries)
        table.add_row(name, *(escape(cell) for cell in cells))
    return table
