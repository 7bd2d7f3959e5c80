"""Runs that differ in their seed alone, as groups: mean and spread of every quantity, and what a comparison of them says.

spread      standard deviation over the runs of a group, with n - 1; unknown for one run
apart       two groups of two runs or more are in a quantity where their means differ by more than two standard deviations of
            a difference of two single runs, 2 sqrt(s^2 + t^2); two single runs of one where their intervals do not meet
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, sqrt
from pathlib import Path
from statistics import mean, stdev

from analysis.records.quantities import measured, quantity
from analysis.records.run_files import CHECKPOINT
from analysis.records.tables import Cell
from analysis.runs.compare_table import Entry, Row
from landscape.errors import InputError
from splat.training.origin.subject import Checkpoint

TOLD = ("held-out views", "trace", "spectrum", "anisotropy")  # sections whose differences are told
MORE = {"top mass": 1, "participation ratio": -1}  # the sign of an index where curvature is less even
SPREADS = 2.0


@dataclass(frozen=True)
class Group:
    """Runs that are compared as one, and their folders."""

    label: str
    folders: tuple[Path, ...]


def groups_of(runs: Sequence[Path], named: Sequence[str]) -> list[Group]:
    """A group for each run, for each folder whose sub-folders are runs (a sweep's OUT/SCENE/METHOD), and each LABEL=RUN,RUN."""
    groups = []
    for path in runs:
        seeds = (
            sorted(found.parent for found in path.glob(f"*/{CHECKPOINT}")) if not (path / CHECKPOINT).is_file() else []
        )
        groups.append(Group(str(path), tuple(seeds or [path])))
    for text in named:
        label, _, folders = text.partition("=")
        if not (label and folders):
            raise InputError(f"expected --group LABEL=RUN,RUN, got {text!r}")
        groups.append(Group(label, tuple(Path(folder) for folder in folders.split(","))))
    return groups


def identical(labels: Sequence[str], checkpoints: Sequence[Checkpoint]) -> list[str]:
    """Lines on runs with the parameters of an earlier one, to the bit."""
    first: dict[bytes, int] = {}
    lines = []
    for i, checkpoint in enumerate(checkpoints):
        flat = checkpoint.training.gaussians.flat.detach().cpu()
        j = first.setdefault(hashlib.sha256(flat.contiguous().numpy().tobytes()).digest(), i)
        if j < i:
            methods = {each.training.config.method.name for each in (checkpoint, checkpoints[j])}
            why = "the method never acted: " if len(methods) > 1 else ""
            lines.append(f"{labels[i]}: {why}parameters are identical to {labels[j]}.")
    return lines


def grouped(rows: Sequence[Row], groups: Sequence[Group]) -> list[Row]:
    """The rows with a column for each group: mean and spread of its runs."""
    result = []
    for row in rows:
        entries, start = [], 0
        for group in groups:
            entries.append(_together(row.entries[start : start + len(group.folders)]))
            start += len(group.folders)
        result.append(Row(row.section, row.name, tuple(entries)))
    return result


def _together(entries: Sequence[Entry]) -> Entry:
    """One run as it is; of several mean and spread of the numbers, the text that all have, or all texts."""
    first = entries[0]
    if all(entry.value == first.value for entry in entries) and (
        len(entries) == 1 or not isinstance(first.value, float)
    ):
        return first
    numbers = [entry.value for entry in entries if isinstance(entry.value, int | float) and isfinite(entry.value)]
    if not numbers:
        return Entry(None, Cell("\n".join(dict.fromkeys(entry.cell.value for entry in entries))))
    spread = stdev(numbers) if len(numbers) > 1 else None
    part = "" if len(numbers) == len(entries) else f"{len(numbers)} of {len(entries)} runs"
    cell = Cell(quantity(mean(numbers)) if spread is None else measured(mean(numbers), spread), part)
    ends = (None, None) if spread is None else (mean(numbers) - spread, mean(numbers) + spread)
    return Entry(mean(numbers), cell, *ends)


def sayings(rows: Sequence[Row], groups: Sequence[Group]) -> list[str]:
    """Lines on differences from the first group beyond the spread of seeds, and on indices that contradict each other.

    rows: those of `grouped`.
    """
    several = all(len(group.folders) > 1 for group in groups)
    told = [row for row in rows if row.section in TOLD and not row.name.startswith(" ")]
    lines = [] if several else [
        "Whether a difference is larger than the spread of seeds is not known of groups of one run: train with other "
        "seeds (landscape sweep), and give the folders that hold them, or --group LABEL=RUN,RUN."
    ]  # fmt: skip
    for i, group in enumerate(groups[1:], start=1):
        pair = f"{group.label} and {groups[0].label}"
        if len(group.folders) > 1 and len(groups[0].folders) > 1:
            lines.append(_differences(told, i, pair))
        seeds = len(group.folders) > 1 and len(groups[0].folders) > 1
        lines.append(_contradictions(told, i, group.label, groups[0].label, seeds))
    return lines


def _differences(rows: Sequence[Row], i: int, pair: str) -> str:
    larger, within = [], []
    for row in rows:
        here, there = row.entries[i], row.entries[0]
        if isinstance(here.value, float) and isinstance(there.value, float):
            apart = _apart(here, there, True)
            name = f"trace of {row.name}" if row.section == "trace" else row.name
            (larger if apart else within).append(
                f"{name} ({here.cell.value} and {there.cell.value})" if apart else name
            )
    words = f"{pair} differ by more than the spread of their seeds in {', '.join(larger)}" if larger else (
        f"{pair} differ in nothing by more than the spread of their seeds"
    )  # fmt: skip
    return f"{words}{'; not in ' + ', '.join(within) if larger and within else ''}."


def _contradictions(rows: Sequence[Row], i: int, label: str, first: str, seeds: bool) -> str:
    """Lines on indices that disagree about which of two groups is more anisotropic.  seeds: whether both have several runs."""
    pair = f"{label} and {first}"
    votes: dict[str, list[str]] = {label: [], first: []}
    for row in rows:
        here, there = row.entries[i], row.entries[0]
        if row.section == "anisotropy" and row.name in MORE and _apart(here, there, seeds):
            assert isinstance(here.value, float) and isinstance(there.value, float)
            votes[label if (here.value - there.value) * MORE[row.name] > 0 else first].append(row.name)
    if not any(votes.values()):
        return f"No index decides whether {pair} differ in anisotropy."
    if not all(votes.values()):
        more = label if votes[label] else first
        return f"The indices that decide ({', '.join(votes[more])}) agree: {more} is the more anisotropic of {pair}."
    return "The indices contradict each other: " + ", but ".join(
        f"by {' and '.join(names)} {which} is the more anisotropic" for which, names in votes.items()
    ) + "."  # fmt: skip


def _apart(here: Entry, there: Entry, seeds: bool) -> bool:
    """Whether two entries are apart, by their spreads, or as single runs by their intervals."""
    numbers = [here.value, there.value, here.low, here.high, there.low, there.high]
    if not all(isinstance(each, float) and isfinite(each) for each in numbers):
        return False
    a, b, *ends = (float(each or 0.0) for each in numbers)
    if seeds:
        return abs(a - b) > SPREADS * sqrt(((ends[1] - ends[0]) / 2) ** 2 + ((ends[3] - ends[2]) / 2) ** 2)
    return ends[0] > ends[3] or ends[2] > ends[1]
