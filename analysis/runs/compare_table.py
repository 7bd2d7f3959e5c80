"""Several runs as rows of quantities, a column a run: for the terminal, the page and the file.

OUT/compare.csv     section, quantity, run, value, low, high, note: low and high are the ends of the interval of a trace, of
                    value -+ residual of an eigenvalue, of the bracket of an index
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import pandas as pd
from rich import box
from rich.markup import escape
from rich.table import Table

from analysis.records.findings import attribute_name
from analysis.records.quantities import PLACES, SCORES, measured, quantity
from analysis.records.records import ProbeRecord
from analysis.records.run_files import ENDS, Scores
from analysis.records.schema import INDICES, Anisotropy, Depth, Effect, Eigenvalue, Index, Operator, Trace
from analysis.records.tables import OPERATOR_NAMES, Cell, bracketed, factor
from splat.model.typed import leaves
from splat.training.origin.subject import Checkpoint
from splat.training.state import MethodSettings

FAMILIES = "per_attribute"  # a section that only the page and the file show
DEPTH = "depth over lateral"
CONFIRMED = {True: "confirmed by renders", False: "not confirmed by renders"}


@dataclass(frozen=True)
class Run:
    """A run and its probe: the folder, its name here, its checkpoint, its scores (None: not scored), and the record."""

    folder: Path
    label: str
    checkpoint: Checkpoint
    scores: Scores | None
    data: ProbeRecord


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
    clocks = [run.scores and run.scores.seconds for run in runs]
    yield Row("run", "method", tuple(_method(config.method) for config in configs))
    yield Row("run", "steps", tuple(_plain(run.checkpoint.training.step) for run in runs))
    yield Row("run", "Gaussians", tuple(_plain(run.data.counts.gaussians) for run in runs))
    yield Row("run", "in sight", tuple(_plain(run.data.counts.visible_gaussians) for run in runs))
    yield Row("run", "seconds of training", tuple(_plain(clock and clock.wall) for clock in clocks))
    yield Row("run", "seconds of all processors", tuple(_plain(clock and clock.cpu) for clock in clocks))


def _scores(runs: Sequence[Run]) -> Iterable[Row]:
    for part, words in (("test", "held-out views"), ("train", "training views")):
        for key, name in SCORES.items():
            values = [getattr(getattr(run.scores, part, None), key, None) for run in runs]
            if any(value is not None for value in values):
                yield Row(words, name, tuple(_plain(value, PLACES[key]) for value in values))


def _curvature(runs: Sequence[Run]) -> Iterable[Row]:
    for name in dict.fromkeys(name for run in runs for name in run.data.traces):
        yield Row("trace", attribute_name(name), tuple(_trace(run.data.traces.get(name)) for run in runs))
    for name, end in (("lambda_max", "max"), ("lambda_min", "min")):
        yield Row("spectrum", ENDS[name], tuple(_end(getattr(run.data.eigenvalues, end)) for run in runs))


def _indices(runs: Sequence[Run]) -> Iterable[Row]:
    """Each index of the whole Hessian; beneath it what the split multiplies it by, where that was measured."""
    for name in INDICES:
        entries = tuple(_index(run.data.indices.get(name)) for run in runs)
        yield Row("anisotropy", name.replace("_", " "), entries)
        yield from _split("anisotropy", runs, "hessian", "all", name)


def _depth(runs: Sequence[Run]) -> Iterable[Row]:
    """Positions along the rays over those across them, where a run's probe has that."""
    found = [run.data.depth for run in runs]
    if not any(found):
        return
    yield Row(DEPTH, "gradient", tuple(MISSING if depth is None else _plain(depth.gradient_ratio) for depth in found))
    yield Row(DEPTH, "curvature", tuple(_index(depth and depth.curvature_ratio) for depth in found))
    for pixels in dict.fromkeys(row.pixels for depth in found if depth for row in depth.rises):
        yield Row(DEPTH, f"rise at {pixels:g} px", tuple(_rise(depth, pixels) for depth in found))


def _families(runs: Sequence[Run]) -> Iterable[Row]:
    """Rows of every operator and block that a run has families of."""
    of_runs: list[dict[tuple[Operator, str], Anisotropy]] = [
        {(row.operator, row.block): row.indices for row in run.data.per_attribute or () if not row.split}
        for run in runs
    ]
    for operator, block in dict.fromkeys(key for rows in of_runs for key in rows):
        for name in INDICES:
            words = f"{OPERATOR_NAMES[operator]}, {attribute_name(block)}: {name.replace('_', ' ')}"
            indices = [getattr(rows.get((operator, block)), name, None) or None for rows in of_runs]
            yield Row(FAMILIES, words, tuple(_index(index) for index in indices))
            yield from _split(FAMILIES, runs, operator, block, name)


def _split(section: str, runs: Sequence[Run], operator: Operator, block: str, name: str) -> Iterable[Row]:
    """Factor of splitting every Gaussian in two on an index, where a run has that."""
    effects = [_effect(run.data, operator, block, name) for run in runs]
    if any(effects):
        yield Row(section, "  split control", tuple(_index(effect, factor(effect)) for effect in effects))


def _method(method: MethodSettings) -> Entry:
    """Name of a method, and beneath it the settings that are not the published ones.

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


def _trace(trace: Trace | None) -> Entry:
    if trace is None:
        return MISSING
    return Entry(trace.value, Cell(measured(trace.value, trace.standard_error)), trace.low, trace.high)


def _end(end: Eigenvalue) -> Entry:
    value, residual = end.value, end.residual
    cell = Cell(measured(value, residual), CONFIRMED[not end.doubted] if end.renders else "", end.reason or "")
    if value is None or residual is None:
        return Entry(value, cell)
    return Entry(value, cell, value - residual, value + residual)


def _index(index: Index | None, cell: Cell | None = None) -> Entry:
    """cell: how it is written, where not as `bracketed` has it."""
    return MISSING if index is None else Entry(index.value, cell or bracketed(index), index.low, index.high)


def _rise(depth: Depth | None, pixels: float) -> Entry:
    """The ratio of the rises at steps of this length, with two standard errors."""
    for row in depth.rises if depth else ():
        if row.pixels == pixels and row.ratio is not None and row.ratio_error is not None:
            ends = row.ratio - 2 * row.ratio_error, row.ratio + 2 * row.ratio_error
            return Entry(row.ratio, Cell(measured(row.ratio, row.ratio_error)), *ends)
    return MISSING


def _effect(data: ProbeRecord, operator: Operator, block: str, name: str) -> Effect | None:
    effects = data.split_control.effects if data.split_control else ()
    return next((each for each in effects if (each.operator, each.block, each.index) == (operator, block, name)), None)


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
    """A column a run; the families are left to the page, and what no run has."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("")
    for label in labels:
        table.add_column(escape(label), justify="right")
    section = ""
    for row in rows:
        known = [entry for entry in row.entries if (entry.cell.value, entry.cell.bracket) != (MISSING.cell.value, "")]
        if row.section == FAMILIES or not known:
            continue
        if row.section != section:
            table.add_section()
            section = row.section
        name = f"trace of {row.name}" if row.section == "trace" else row.name
        name = f"depth / lateral {row.name}" if row.section == DEPTH else name
        name += ", training views" if row.section == "training views" else ""
        cells = ("\n".join(filter(None, (entry.cell.value, entry.cell.bracket))) for entry in row.entries)
        table.add_row(*map(escape, [name, *cells]))
    return table
