"""Time and memory by size: `python -m notebooks.sizes [--only 100kx24/quick ...] [--seconds LIMIT]`.

Of every cell, Gaussians x views of 504 x 378, a user's commands on a synthetic scene, each a process of its own: a training
from its Gaussians, whose number stays, `landscape probe --quick` and `landscape probe`.  The table is written after each; what
it has is not measured again, so the same command goes on.  Last it prints the tables of docs/accuracy.md.  Its columns:

gaussians, views   of the cell; there are a few Gaussians more or less than the round number
what               step: the median of the training's; its memory that of the whole command.  quick, probe: from the prompt on
seconds, cpu       by the clock, and of all processors together
memory             at its peak, GiB
ended              empty where it ended by itself, else why not: the others are then what was taken until then
threads, machine, lanes (float32 numbers in a vector of the processor), date, commit
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Timer
from time import perf_counter
from typing import cast

import numpy as np
import pandas as pd
from rich.console import Console

from analysis.console.failures import NO_MEMORY, program
from analysis.console.plain import say
from analysis.records.provenance import provenance, usable_cores
from analysis.records.run_files import CHECKPOINT
from landscape.errors import InputError
from splat.backend.cpu.simd import lanes_of
from splat.model.untrusted import read_table, write_atomically

RESULTS = Path(__file__).parents[1] / "results" / "sizes.csv"
CELLS = [f"{gaussians}x{views}" for gaussians in ("10k", "100k", "1000k") for views in (3, 24, 200)]
WHAT = {"step": "a step", "quick": "`probe --quick`", "probe": "`probe`"}
COLUMNS = (
    "gaussians", "views", "what", "seconds", "cpu", "memory", "ended", "threads", "machine", "lanes", "date", "commit",
)  # fmt: skip
WIDTH, HEIGHT, STEPS, EACH = 504, 378, 40, 4  # EACH: steps between two times


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure what the table lacks, write and print; returns the exit code."""
    parser = argparse.ArgumentParser("python -m notebooks.sizes", description="Time and memory by size.")
    parser.add_argument("--only", nargs="+", default=CELLS, metavar="CELL", help="such as 100kx24 or 100kx24/quick")
    parser.add_argument("--seconds", type=float, default=1200, help="after which a command is ended")
    parser.add_argument("--work", type=Path, default=Path("runs/sizes"), help="folder of the scenes and runs")
    parser.add_argument("--out", type=Path, default=RESULTS, help="the table")
    options, console = parser.parse_args(arguments), Console(stderr=True)
    stored = read_table(options.out).to_dict("records") if options.out.exists() else []
    rows = {(row["gaussians"], row["views"], row["what"]): row for row in stored}
    for cell, gaussians, views, what in asked(options.only):
        if (gaussians, views, what) in rows:
            continue
        for row in measured(options.work / cell, gaussians, views, what, options.seconds):
            rows[gaussians, views, row["what"]] = row
            table = pd.DataFrame([rows[key] for key in sorted(rows)], columns=list(COLUMNS))
            write_atomically(options.out, table.to_csv(index=False, float_format="%.4g").encode())
            say(f"{cell}/{row['what']}: {row['cpu']:.3g} s, {row['memory']:.2f} GiB {row['ended']}", console=console)
    say(page(read_table(options.out)), console=Console(width=200))
    return 0


def asked(only: Sequence[str]) -> Iterator[tuple[str, int, int, str]]:
    """Each cell, its Gaussians and views, and what to measure of it.  InputError where a word is not of this form."""
    for word in only:
        match = re.fullmatch(rf"((\d+)(k?)x(\d+))(?:/({'|'.join(WHAT)}))?", word)
        if match is None:
            raise InputError(f"expected --only GAUSSIANSxVIEWS, as 100kx24, or 100kx24/quick, got {word!r}")
        for what in [match[5]] if match[5] else WHAT:
            yield match[1], int(match[2]) * (1000 if match[3] else 1), int(match[4]), what


def measured(folder: Path, gaussians: int, views: int, what: str, limit: float) -> Iterator[dict]:
    """The row; before it that of the step where its training has to be made first."""
    here, run, landscape = provenance(seed=0), folder / "run", ["-m", "analysis.commands.cli"]
    about = {"gaussians": gaussians, "views": views, "machine": here.machine.cpu, "lanes": lanes_of(np.float32)}
    about |= {"threads": min(usable_cores(), int(os.environ.get("OMP_NUM_THREADS") or sys.maxsize))}
    about |= {"date": here.created[:10], "commit": here.commit}
    if what == "step" or not (run / CHECKPOINT).is_file():
        shutil.rmtree(folder, ignore_errors=True)
        size = map(str, (gaussians, views, WIDTH, HEIGHT))
        subprocess.run([sys.executable, "-m", "notebooks.sizes.scene", *size, folder], check=True)
        words = f"--views {views} --iterations {STEPS} --log-every {EACH} --no-densify --device cpu --out".split()
        row = spent([*landscape, "train", folder / "scene", "--from", folder / "start.ply", *words, run], limit)
        log = read_table(run / "train.csv") if (run / "train.csv").is_file() else ()
        if len(log) > 2:  # without the first steps, in which the process gets ready
            row |= {name: np.median(np.diff(log[name])[1:]) / EACH for name in ("seconds", "cpu")} | {"ended": ""}
        yield about | {"what": "step"} | row
    if what != "step" and (run / CHECKPOINT).is_file():
        shutil.rmtree(folder / what, ignore_errors=True)
        words = ["probe", run, "--out", folder / what, "--device", "cpu", *["--quick"] * (what == "quick")]
        yield about | {"what": what} | spent([*landscape, *words], limit)


def spent(words: Sequence[str | Path], limit: float) -> dict:
    """What a command of Python takes, ended after so many seconds.  InputError where it fails, but for want of memory."""
    begun = perf_counter()
    child = subprocess.Popen([sys.executable, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    timer = Timer(limit, child.kill)
    timer.start()
    _, status, used = os.wait4(child.pid, 0)
    timer.cancel()
    child.returncode, seconds = os.waitstatus_to_exitcode(status), perf_counter() - begun
    ended = "memory ran out" if child.returncode in (NO_MEMORY, -9) else ""
    if child.returncode == -9 and seconds >= limit:
        ended = f"more than {limit:g} s"
    elif child.returncode and not ended:
        command = " ".join(["python", *map(str, words)])
        raise InputError(f"expected {command} to end well, got exit code {child.returncode}; run it to see why")
    memory = used.ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)
    return {"seconds": seconds, "cpu": used.ru_utime + used.ru_stime, "memory": memory, "ended": ended}


def page(table: pd.DataFrame) -> str:
    """The tables of docs/accuracy.md, in Markdown: one for each processor and number of threads."""
    lines = []
    for about, rows in table.groupby(["machine", "lanes", "threads"], sort=False):
        machine, lanes, threads = cast(tuple, about)
        dates = " to ".join(sorted({min(rows["date"]), max(rows["date"])}))
        lines += [f"{machine}, {lanes} lanes of float32, threads: {threads}, {dates}:", ""]
        lines += [f"| Gaussians | views | {' | '.join(WHAT.values())} |", "| --- | --- |" + " --- |" * len(WHAT)]
        cells: dict[tuple[int, int], dict[str, str]] = {}
        for row in rows.to_dict("records"):
            cells.setdefault((row["gaussians"], row["views"]), {})[row["what"]] = _text(row)
        for (gaussians, views), texts in sorted(cells.items()):
            lines.append(f"| {gaussians:,} | {views} | {' | '.join(texts.get(what, '') for what in WHAT)} |")
        lines.append("")
    return "\n".join(lines)


def _text(row: dict) -> str:
    time = f"{row['cpu']:.2g} s" if row["what"] == "step" else f"{row['cpu']:,.0f} s"
    ended = row["ended"] if isinstance(row["ended"], str) else ""
    # a limit is one of the clock, the table one of the processor
    return f"{f'more than {time}' if ended.startswith('more') else ended or time}, {row['memory']:.1f} GiB"


if __name__ == "__main__":
    program(main)
