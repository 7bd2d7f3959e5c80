"""All figures of a recorded probe or slice: `python -m figures.make_all RUN/probe [--only surface]`."""

import argparse
from collections.abc import Collection
from dataclasses import replace
from functools import partial
from pathlib import Path

from analysis.console.failures import program
from analysis.records.records import ProbeRecord, Record, read_record
from figures import places, slice1d, slice2d, spectrum, surface, traces
from figures.scripts import drawn_by, folder_script
from figures.style import save

FIGURES = {
    "places": places.draw,
    "traces": traces.draw,
    "spectrum": spectrum.draw,
    "slice1d": slice1d.draw,
    "slice2d": slice2d.draw,
    "surface": surface.draw,
}


def recorded_figures(record: Record) -> tuple[str, ...]:
    """Names of the figures that the record has the numbers for."""
    slice = record.data.slice if "slice" in record.arrays else None
    axes = len(slice.directions) if slice else 0
    known = {"traces": isinstance(record.data, ProbeRecord), "spectrum": "spectrum" in record.arrays}
    known |= {"places": "places" in record.arrays}
    known |= {"slice1d": axes == 1, "slice2d": axes == 2, "surface": axes == 2 and bool(slice and slice.is_resolved)}
    return tuple(name for name in FIGURES if known[name])


def draw_probe(folder: str | Path, suffix: str = "png", only: Collection[str] = (), processes: int = 1) -> list[Path]:
    """Draw every figure that the record in `folder` has the numbers for into it; returns the files.

    only: these alone, where any is named.  processes: that draw at a time.  Raises FileNotFoundError or ValueError for a folder
    that holds no readable record, TooLittleMemory where the system ends one of the processes.
    """
    record = read_record(folder)
    names = [name for name in recorded_figures(record) if name in (only or FIGURES)]
    # what the processes are handed: no figure shows the eigenvectors, by far the largest
    used = {group: arrays for group, arrays in record.arrays.items() if group != "eigenvectors"}
    draw = partial(_draw, replace(record, arrays=used), suffix)
    return drawn_by(processes, draw, names)  # the last ones, which are slow, first


def _draw(record: Record, suffix: str, name: str) -> Path:
    return save(FIGURES[name](record), record.folder / f"{name}.{suffix}")


def main() -> int:
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument("--only", choices=FIGURES, action="append", default=[], help="a figure to draw, not all")
    draw = partial(draw_probe, processes=len(FIGURES))
    return folder_script(draw, "all figures of a recorded probe", "probe", [options])


if __name__ == "__main__":
    program(main)
