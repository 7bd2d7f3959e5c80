"""Figures: several probed runs beside each other, a colour a run: `python -m figures.compare OUT`, after `landscape compare`.

compare_traces      |trace| of every attribute with its interval; filled: positive, open: negative, crossed: not decided
compare_densities   the share of directions whose curvature is at most -x (left) or at least x (right), both axes logarithmic;
                    means over the start vectors of the quadrature, thin: each of these alone; dashed: the ends of the
                    spectrum; without nodes that are not resolved from 0
compare_slices      the planes of the two steepest directions, cut to the steps that all slices reach along both, with the same
                    levels; dots: renders
compare_sections    the loss along each of these directions, as far as each slice goes
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from msgspec import UNSET

from analysis.console.failures import program
from analysis.records.findings import attribute_name
from analysis.records.quantities import exponent_of, unit_suffix
from analysis.records.records import ProbeRecord, Record, read_record
from analysis.records.run_files import COMPARISON, read_comparison
from analysis.records.schema import Trace
from figures.density import at_zero, unresolved_share
from figures.manifold import Scale, contours
from figures.plane import plane
from figures.scripts import folder_script
from figures.slice2d import RENDERED
from figures.style import BLACK, COLUMN, RUNS, VERMILION, literal, new_figure, save, style
from landscape.errors import InputError

Records = Mapping[str, Record[ProbeRecord]]
LINES = ("-", "--", ":")  # once the colours are used up
ACROSS = 3  # panels in a row
WIDTH = 5.0  # inches for the panels of a row
END: dict[str, Any] = {"linestyle": (0, (2, 2)), "linewidth": 0.6}
ALONE: dict[str, Any] = {"linewidth": 0.4, "alpha": 0.5, "zorder": 1}
ENDS_ALONE = "the density found none; known\nare the extreme eigenvalues"
BEHIND = {"color": "white", "pad": 1.0}
TALLEST = 3.0  # inches of a panel


def draw_traces(records: Records) -> Figure:
    """A row an attribute, in it one below the other the runs."""
    names = list(dict.fromkeys(name for record in records.values() for name in record.data.traces))
    with style():
        figure = new_figure(0.7 + 0.13 * len(names) * (len(records) + 1), 2 * COLUMN)
        axes = figure.subplots()
        for i, (look, record) in enumerate(zip(_looks(records), records.values(), strict=True)):
            for row, name in enumerate(names):
                y = row + (i + 0.5) / (len(records) + 1) - 0.4
                _draw_trace(axes, record.data.traces.get(name), y, look["color"])
        axes.set_xscale("log")
        axes.set_yticks(range(len(names)), [literal(attribute_name(name)) for name in names])
        axes.set_ylim(len(names) - 0.4, -0.6)
        axes.tick_params(axis="y", length=0)
        axes.grid(True, axis="x")
        axes.set_xlabel("|trace|; attributes have units of their own and do not compare")
        axes.set_title("Trace by attribute", loc="left")
        _legend(figure, records, marker="o")
    return figure


def _draw_trace(axes: Axes, trace: Trace | None, y: float, colour: str) -> None:
    if trace is None or not trace.value or not np.isfinite(trace.value):
        return
    value = trace.value
    ends = [value if end is None else end for end in (trace.low, trace.high)]
    decided = ends[0] * ends[1] > 0
    low, high = sorted(np.abs(ends))
    smallest = abs(value) / 10  # an interval that reaches 0 has no end on a logarithmic axis
    axes.plot([low if decided else smallest, max(high, abs(value))], [y, y], color=colour, linewidth=1.2)
    face = colour if value > 0 else "white"
    axes.plot([abs(value)], [y], "o" if decided else "X", color=colour, markerfacecolor=face)


def draw_densities(records: Records) -> Figure:
    """Both sides of 0 on the same axes."""
    if not any("nodes" in record.arrays.get("spectrum", {}) for record in records.values()):
        raise InputError("expected a spectral density in at least one record, got none")
    with style():
        figure = new_figure(2.6, 2 * COLUMN)
        panels, ends = figure.subplots(1, 2, sharey=True), []
        for look, record in zip(_looks(records), records.values(), strict=True):
            spectrum, found = record.arrays.get("spectrum", {}), record.data.eigenvalues
            for axes, sign, end in zip(panels, (-1, 1), (found.min, found.max), strict=True):
                if "nodes" in spectrum and (sign * spectrum["nodes"] > 0).any():
                    nodes, weights = sign * at_zero(spectrum["nodes"]), spectrum["weights"]
                    axes.step(*beyond(nodes, weights), where="pre", **look)
                    for one in range(len(nodes)):
                        axes.step(*beyond(nodes[one : one + 1], weights[one : one + 1]), where="pre", **look, **ALONE)
                if sign * (end.value or 0.0) > 0:
                    ends.append(axes.axvline(sign * (end.value or 0.0), color=look["color"], **END))
        for axes, words in zip(panels, ("down", "up"), strict=True):
            axes.set(xscale="log", yscale="log", xlabel="|curvature| (loss per squared unit of the parameters)")
            axes.set_title(f"Directions that curve {words}", loc="left")
            axes.grid(True)
            if all(line in ends for line in axes.lines):
                words = ENDS_ALONE if axes.lines else "none found"
                axes.text(0.5, 0.9, words, transform=axes.transAxes, ha="center", va="top", bbox=BEHIND)
        limits = np.array([axes.get_xlim() for axes in panels if axes.lines])
        top = limits[:, 1].max()
        for axes in panels:
            axes.set_xlim(max(limits[:, 0].min(), top * 1e-8), top)
        panels[0].invert_xaxis()
        most = max(record.data.counts.active_parameters for record in records.values())
        panels[0].set_ylim(0.5 / most, 2)  # one direction is a share of 1 / parameters
        panels[0].set_ylabel("share of directions\nat least so curved")
        handles = [Line2D([], [], color=BLACK, label="end of the spectrum", **END)] * bool(ends)
        words = unresolved_share(*(record.arrays.get("spectrum", {}) for record in records.values()))
        handles += [Line2D([], [], linestyle="none", label=words)] * bool(words)
        _legend(figure, records, *handles)
    return figure


def beyond(nodes: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positive nodes in rising order, and the mean over the start vectors of the weight at or above each.

    >>> values, shares = beyond(np.array([[3.0, -1.0], [1.0, 2.0]]), np.array([[0.2, 0.8], [0.6, 0.4]]))
    >>> values.tolist(), shares.round(12).tolist()
    ([1.0, 2.0, 3.0], [0.6, 0.3, 0.1])
    """
    flat, masses = nodes.ravel(), weights.ravel() / len(nodes)
    kept = flat > 0
    order = np.argsort(flat[kept])
    return flat[kept][order], np.cumsum(masses[kept][order][::-1])[::-1]


def draw_slices(records: Records) -> Figure:
    """The planes in the window that all of them have."""
    planes = {label: plane(record) for label, record in records.items() if _has_surface(record)}
    scale = Scale.of(*planes.values())
    rows, columns = -(-len(planes) // ACROSS), min(len(planes), ACROSS)
    with style():
        figure = new_figure(0.4 + (0.3 + min(WIDTH / columns, TALLEST)) * rows, 2 * COLUMN)
        panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
        for axes in panels.ravel()[len(planes) :]:
            axes.set_axis_off()
        for axes, (label, field) in zip(panels.ravel(), planes.items(), strict=False):
            filled = contours(axes, field, scale)
            i, j = np.nonzero(field.dots)
            axes.plot(field.x.steps[i] / 10.0**scale.steps, field.y.steps[j] / 10.0**scale.steps, **RENDERED)
            axes.plot([0], [0], "+", color=VERMILION, markersize=7, markeredgewidth=1.2)
            axes.set_title(literal(label), loc="left")
            axes.label_outer()
        figure.colorbar(filled, ax=panels, label=scale.loss_label, ticks=filled.levels[1:-1:2])  # pyright: ignore
    return figure


def _has_surface(record: Record[ProbeRecord]) -> bool:
    about = record.data.slice
    return "slice" in record.arrays and about is not None and about.is_resolved


def draw_sections(records: Records) -> Figure:
    """The lines through the centres of the planes, as far as each goes."""
    planes = {label: plane(record) if "slice" in record.arrays else None for label, record in records.items()}
    power = exponent_of(*(field.rise.compressed() for field in planes.values() if field is not None))
    steps = exponent_of(*(axis.steps for field in planes.values() if field is not None for axis in (field.x, field.y)))
    with style():
        figure = new_figure(2.6, 2 * COLUMN)
        panels = figure.subplots(1, 2, sharey=True)
        for look, field in zip(_looks(records), planes.values(), strict=True):
            if field is None:
                continue
            for number, (axes, along) in enumerate(zip(panels, (field.x, field.y), strict=True)):
                line = field.through_centre(field.rise, number) / 10.0**power
                axes.plot(along.steps / 10.0**steps, line, **look)
        for axes, which in zip(panels, ("steepest", "second"), strict=True):
            axes.set_xlabel(f"step, units of the parameters{unit_suffix(steps)}")
            axes.set_title(f"Along the {which} direction", loc="left")
            axes.xaxis.set_major_locator(MaxNLocator(5))
            axes.grid(True)
        panels[0].set_ylabel(f"change of loss{unit_suffix(power)}")
        _legend(figure, records)
    return figure


def _looks(records: Records) -> list[dict[str, str]]:
    """Colour and line of each run."""
    numbers = (divmod(i, len(RUNS)) for i in range(len(records)))
    return [{"color": RUNS[colour], "linestyle": LINES[line % len(LINES)]} for line, colour in numbers]


def _legend(figure: Figure, records: Records, *more: Line2D, marker: str = "") -> None:
    looks = zip(records, _looks(records))
    handles = [Line2D([], [], label=literal(label), marker=marker, **look) for label, look in looks]  # pyright: ignore[reportArgumentType]
    handles += more
    figure.legend(handles=handles, loc="outside lower center", ncols=min(4, len(handles)))


FIGURES: dict[str, Callable[[Records], Figure]] = {
    "compare_traces": draw_traces,
    "compare_densities": draw_densities,
    "compare_slices": draw_slices,
    "compare_sections": draw_sections,
}


def draw_comparison(folder: Path, suffix: str = "png") -> list[Path]:
    """Draw what the records of the comparison in the folder have the numbers for; returns the files."""
    if not (folder / COMPARISON).is_file():
        raise FileNotFoundError(f"expected a folder written by `landscape compare` (with {COMPARISON}), got {folder}")
    compared = read_comparison(folder)
    records = {label: read_record(path, ProbeRecord) for label, path in compared.runs.items()}
    for label, record in records.items():
        if record.data.provenance.fingerprint != compared.fingerprints.get(label, UNSET):
            raise InputError(f"expected the record that was compared in {record.folder}, got another; compare again")
    arrays = [record.arrays for record in records.values()]
    known = {"compare_densities": any("nodes" in each.get("spectrum", {}) for each in arrays)}
    known |= {"compare_slices": any(map(_has_surface, records.values()))}
    known |= {"compare_sections": any("slice" in each for each in arrays)}
    return [save(draw(records), folder / f"{name}.{suffix}") for name, draw in FIGURES.items() if known.get(name, True)]


if __name__ == "__main__":
    program(partial(folder_script, draw_comparison, "the figures of a comparison", "compare"))
