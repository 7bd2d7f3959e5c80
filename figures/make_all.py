"""All figures of a recorded probe or slice: `python -m figures.make_all RUN/probe` or `draw_probe(folder)`."""

from functools import partial
from pathlib import Path

from analysis.records import Record, read_record
from figures import slice1d, slice2d, spectrum, surface, traces
from figures.style import folder_script, save

FIGURES = {
    "traces": traces.draw,
    "spectrum": spectrum.draw,
    "slice1d": slice1d.draw,
    "slice2d": slice2d.draw,
    "surface": surface.draw,
}


def recorded_figures(record: Record) -> tuple[str, ...]:
    """Names of the figures that the record has the numbers for."""
    axes = len(record.data["slice"]["directions"]) if record.data.get("slice") and "slice" in record.arrays else 0
    known = {"traces": "traces" in record.data, "spectrum": "spectrum" in record.arrays}
    known |= {"slice1d": axes == 1, "slice2d": axes == 2, "surface": axes == 2}
    return tuple(name for name in FIGURES if known[name])


def draw_probe(folder: str | Path, suffix: str = "png") -> list[Path]:
    """Draw every figure that the record in `folder` has the numbers for into it; returns the files.

    Warns with `figures.surface.RendererMissing` where the surface had to be drawn without the off-screen renderer.
    Raises FileNotFoundError or ValueError for a folder that holds no readable record.
    """
    record = read_record(folder)
    names = recorded_figures(record)
    begun = {"surface": surface.begin(record)} if "surface" in names else {}  # its renderer works beside the others
    figures = {name: partial(FIGURES[name], picture=begun[name]) if name in begun else FIGURES[name] for name in names}
    return [save(draw(record), record.folder / f"{name}.{suffix}") for name, draw in figures.items()]


def main() -> None:
    """`python -m figures.make_all RUN/probe`"""
    folder_script(draw_probe, "all figures of a recorded probe", "probe")


if __name__ == "__main__":
    main()
