"""The bridge to other people's renderers, measured where the truth is known: `python -m notebooks.renderer [RUN ...]`.

A synthetic scene (`demo`) in float64 and float32, surfels in plain torch in float64, then each RUN, a folder of `landscape
train`, in float32: the renderer gives images and their gradients, and the exact operators are the truth.  The table (columns:
`notebooks.renderer.measure`) is written after each part; what it has of a scene and part is not measured again, so the same
command goes on.  Last it prints the tables of docs/why-finite-differences-fail.md.

    landscape train data/fern --views 3 --iterations 2000 --seed 0 --out runs/fern
    python -m notebooks.renderer runs/fern --each 3 --seeds 2 --cover 0 --out notebooks/results/renderer.csv

repeats the stored table, once its rows are taken out.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd
import torch
from rich.console import Console

from analysis.console.failures import program
from analysis.console.plain import say
from analysis.records.provenance import provenance
from notebooks.renderer.measure import Row, Sizes, best_step, ends, products, traces
from notebooks.renderer.scenes import Scene, demo, trained
from notebooks.renderer.surfels import Surfels
from notebooks.renderer.surfels import trained as surfels
from splat.model.untrusted import read_table, write_atomically

RESULTS = Path(__file__).parents[1] / "results" / "renderer.csv"
COLUMNS = (
    "scene", "gaussians", "type", "part", "way", "direction", "step", "error", "stated", "within", "of",
    "value", "low", "high", "exact", "date", "machine", "commit",
)  # fmt: skip
PARTS = ("products", "ends", "traces")


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what the table lacks, write and print; returns the exit code."""
    parser = argparse.ArgumentParser("python -m notebooks.renderer", description="The bridge on our own renderer.")
    parser.add_argument("runs", type=Path, nargs="*", help="folders of landscape train")
    parser.add_argument("--part", action="append", choices=PARTS, help="measure this alone")
    parser.add_argument("--each", type=int, default=10, help="vectors of each kind")
    parser.add_argument("--seeds", type=int, default=40, help="seeds of lambda max")
    parser.add_argument("--samples", type=int, default=32, help="samples of the traces")
    parser.add_argument("--cover", type=int, default=500, help="seeds of the traces; 0 for one")
    parser.add_argument("--out", type=Path, default=RESULTS, help="the table")
    options = parser.parse_args(arguments)
    sizes = Sizes(options.each, options.seeds, options.samples, options.cover)
    rows: list[Row] = read_table(options.out).to_dict("records") if options.out.exists() else []
    small = demo()
    for scene in [small, replace(small, dtype=torch.float32), surfels(), *map(trained, options.runs)]:
        for part in options.part or PARTS:
            if not _of(rows, scene, part):
                rows += _measured(scene, part, sizes, rows)
                options.out.parent.mkdir(parents=True, exist_ok=True)
                table = pd.DataFrame(rows, columns=list(COLUMNS)).to_csv(index=False, float_format="%.4g")
                write_atomically(options.out, table.encode())
    say(page(read_table(options.out)), console=Console(width=200))
    return 0


def _measured(scene: Scene | Surfels, part: str, sizes: Sizes, before: Sequence[Row]) -> Iterator[Row]:
    """The rows of a part, complete."""
    here = provenance(seed=0)
    about = {"scene": scene.name, "gaussians": scene.gaussians, "type": scene.type}
    about |= {"date": here.created[:10], "machine": here.machine.cpu, "commit": here.commit, "part": part}
    step = best_step(_of(before, scene, "products"))
    make = {
        "products": lambda: products(scene, sizes),
        "ends": lambda: ends(scene, sizes, step),
        "traces": lambda: traces(scene, sizes),
    }
    for row in make[part]():
        yield about | row


def _of(rows: Sequence[Row], scene: Scene | Surfels, part: str) -> list[Row]:
    """The rows of a scene and part."""
    return [row for row in rows if (row["scene"], row["type"], row["part"]) == (scene.name, scene.type, part)]


def page(table: pd.DataFrame) -> str:
    """The tables of the page, in Markdown: products with the naive differences at their best step, ends, traces."""
    lines = []
    for scene, kind in table[["scene", "type"]].drop_duplicates().itertuples(index=False, name=None):
        rows = pd.DataFrame(table[(table["scene"] == scene) & (table["type"] == kind)])
        at, ends, traces, covers = (
            pd.DataFrame(rows[rows["part"] == part]) for part in ("products", "ends", "traces", "cover")
        )
        lines += [f"{scene}, {kind}, {int(rows['gaussians'].iloc[0])} Gaussians:", ""]
        lines += [
            "| direction | naive, best step | split (stated) | Gauss-Newton (stated) |",
            "| --- | --- | --- | --- |",
        ]
        for name, each in at.groupby("direction", sort=False):
            ways = {way: pd.DataFrame(found).sort_values("error").iloc[0] for way, found in each.groupby("way")}
            cells = [f"{ways['naive']['error']:.2g}"]
            cells += [f"{ways[way]['error']:.2g} ({ways[way]['stated']:.2g})" for way in ("split", "gauss_newton")]
            lines.append(f"| {name} | {' | '.join(cells)} |")
        if len(ends):
            lines += ["", "| lambda max | found | exact | error, worst seed | within the stated error |"]
            lines += ["| --- | --- | --- | --- | --- |"]
        for row in ends.to_dict("records"):
            within = f"{int(row['within'])} of {int(row['of'])}" if row["of"] == row["of"] else "none is stated"
            lines.append(f"| {row['way']} | {row['value']:.4g} | {row['exact']:.4g} | {row['error']:.2g} | {within} |")
        if len(traces):
            lines += ["", "| trace of Gauss-Newton | found | interval | exact | seeds whose interval holds it |"]
            lines += ["| --- | --- | --- | --- | --- |"]
        cover = {row["direction"]: row for row in covers.to_dict("records")}
        for row in traces.to_dict("records"):
            held = cover.get(row["direction"], row)
            lines.append(
                f"| {row['direction']} | {row['value']:.4g} | {row['low']:.4g} to {row['high']:.4g} | {row['exact']:.4g} | "
                f"{int(held['within'])} of {int(held['of'])} |"
            )
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    program(main)
