"""Runs that differ in their seed alone, as groups: mean and spread of every quantity, and what a comparison of them says.

spread      standard deviation over the runs of a group, with n - 1; unknown for one run
apart       two groups of two runs or more are in a quantity where their means differ by more than two standard deviations of
            a difference of two single runs, 2 sqrt(s^2 + t^2).  Of normal quantities with equal means and any spreads, chance
            makes at most P(|T| > 2 sqrt n) of them so, T Student's with n - 1 degrees of freedom, n the smaller number of runs
            (Mickey and Brown, Annals of Mathematical Statistics 37, 1966)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, isfinite, sqrt
from pathlib import Path
from statistics import mean, stdev

from scipy.special import stdtr

from analysis.records.quantities import PLUS_MINUS, measured, quantity
from analysis.records.run_files import CHECKPOINT
from analysis.records.tables import Cell
from analysis.runs.compare_table import CONFIRMED, Entry, Row

TOLD = ("held-out views", "trace", "spectrum", "anisotropy")  # sections whose differences are told
MORE = {"top mass": 1, "participation ratio": -1}  # the sign of an index where curvature is less even
SPREADS = 2.0
SPREAD = "Behind ± of n runs stands the standard deviation over them; without ±, it is below half of the last digit."
EQUAL = 1.1  # largest ratio of numbers of Gaussians that count as the same


@dataclass(frozen=True)
class Group:
    """Runs that are compared as one, and their folders."""

    label: str
    folders: tuple[Path, ...]


def groups_of(runs: Sequence[Path]) -> list[Group]:
    """A group for each run, and for each folder whose sub-folders are runs (a sweep's OUT/SCENE/METHOD)."""
    groups = []
    for path in runs:
        alone = (path / CHECKPOINT).is_file()
        seeds = [] if alone else sorted(found.parent for found in path.glob(f"*/{CHECKPOINT}"))
        groups.append(Group(str(path), tuple(seeds or [path])))
    return groups


def headings(groups: Sequence[Group]) -> list[str]:
    """The groups' labels; with the numbers of runs, where any has several.

    >>> one, two = Group("a", (Path("a"),)), Group("b", (Path("b/0"), Path("b/1")))
    >>> headings([one]), headings([one, two])
    (['a'], ['a (n = 1)', 'b (n = 2)'])
    """
    several = any(len(group.folders) > 1 for group in groups)
    return [f"{group.label} (n = {len(group.folders)})" if several else group.label for group in groups]


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
    alike = len(entries) == 1 or not isinstance(first.value, float)
    if alike and all(entry.value == first.value for entry in entries):
        return first
    numbers = [entry.value for entry in entries if isinstance(entry.value, int | float) and isfinite(entry.value)]
    if not numbers:
        return Entry(None, Cell("\n".join(dict.fromkeys(entry.cell.value for entry in entries)), "", first.cell.note))
    spread = stdev(numbers) if len(numbers) > 1 else None
    parts = [f"{len(numbers)} of {len(entries)} runs"] * (len(numbers) < len(entries))
    if rendered := [entry.cell.bracket for entry in entries if entry.cell.bracket in CONFIRMED.values()]:
        parts.append(f"{CONFIRMED[True]} in {rendered.count(CONFIRMED[True])} of {len(rendered)}")
    text = quantity(mean(numbers)) if spread is None else measured(mean(numbers), spread)
    if spread is not None and all(isinstance(number, int) for number in numbers):
        text = f"{mean(numbers):,.0f}{PLUS_MINUS}{round(spread) or 1:,}"
    cell = Cell(text, "\n".join(parts))
    ends = (None, None) if spread is None else (mean(numbers) - spread, mean(numbers) + spread)
    return Entry(mean(numbers), cell, *ends)


def sayings(rows: Sequence[Row], groups: Sequence[Group]) -> list[str]:
    """Lines on differences from the first group beyond the spread of seeds, and on which is the more anisotropic.

    rows: those of `grouped`.
    """
    told, lines = [row for row in rows if row.section in TOLD and not row.name.startswith(" ")], []
    for i, group in enumerate(groups[1:], start=1):
        seeds = len(group.folders) > 1 and len(groups[0].folders) > 1
        if seeds:
            lines.append(_differences(told, i, [group, groups[0]]))
        lines.append(_verdict(rows, i, group.label, groups[0].label, seeds=seeds))
    return lines


def _differences(rows: Sequence[Row], i: int, pair: Sequence[Group]) -> str:
    """Which quantities of two groups are apart, which are not, and by which rule; others are not tried."""
    larger, within = [], []
    for row in rows:
        here, there = row.entries[i], row.entries[0]
        if isinstance(here.value, float) and isinstance(there.value, float):
            apart = _apart(here, there)
            name = f"trace of {row.name}" if row.section == "trace" else row.name
            (larger if apart else within).append(
                f"{name} ({here.cell.value} and {there.cell.value})" if apart else name
            )
    labels, counts = " and ".join(group.label for group in pair), [len(group.folders) for group in pair]
    chance = 2 * stdtr(min(counts) - 1, -SPREADS * sqrt(min(counts)))
    words = f"{labels} differ by more than the spread of their seeds in {', '.join(larger) or 'nothing'}"
    return (
        f"{words}{'; not in ' + ', '.join(within) if within else ''}. These {len(larger + within)} quantities were tried, no "
        f"others: apart are means with more than 2 √(s² + t²) between them, s and t the standard deviations over n = "
        f"{counts[0]} and {counts[1]} seeds. Of quantities that do not differ, chance makes up to "
        f"{ceil(100 * chance)}% look apart."
    )


def _verdict(rows: Sequence[Row], i: int, label: str, first: str, *, seeds: bool) -> str:
    """Which of two groups is the more anisotropic, or why that is undecided.  seeds: whether both have several runs."""
    votes: dict[str, list[str]] = {label: [], first: []}
    for row in rows:
        here, there = row.entries[i], row.entries[0]
        if row.section == "anisotropy" and row.name in MORE and _apart(here, there):
            assert isinstance(here.value, float) and isinstance(there.value, float)
            votes[label if (here.value - there.value) * MORE[row.name] > 0 else first].append(row.name)
    why = [] if seeds else [
        "a single training of one says nothing of other seeds (landscape sweep trains them; give the folders that hold them)"
    ]  # fmt: skip
    if uneven := _uneven(rows, i):
        why.append(uneven)
    if seeds and not any(votes.values()):
        why.append("no index differs by more than the spread of the seeds")
    if all(votes.values()):
        why.append(
            "the indices contradict each other: "
            + ", but ".join(f"by {' and '.join(names)} it is {which}" for which, names in votes.items())
        )
    if why:
        return f"Undecided which of {label} and {first} is the more anisotropic, because {'; '.join(why)}."
    more = label if votes[label] else first
    return f"{more} is the more anisotropic of {label} and {first}, by {' and '.join(votes[more])}."


def _uneven(rows: Sequence[Row], i: int) -> str:
    """Why numbers of Gaussians forbid a verdict: they are not equal, and what their number alone does is not known."""
    counts = [row.entries for row in rows if (row.section, row.name) == ("run", "Gaussians")]
    here, there = (float(counts[0][j].value or 0) for j in (i, 0)) if counts else (1.0, 1.0)
    split = [row.entries for row in rows if row.section == "anisotropy" and row.name.startswith(" ")]
    if max(here, there) <= EQUAL * min(here, there) or any(row[i].value and row[0].value for row in split):
        return ""
    numbers = " and ".join(counts[0][j].cell.value for j in (i, 0))
    told = "their number alone changes the indices: --split-control measures how much"
    return f"they have {numbers} Gaussians, and {told}"


def _apart(here: Entry, there: Entry) -> bool:
    """Whether the means of two groups are apart by the spreads of their runs."""
    numbers = [here.value, there.value, here.low, here.high, there.low, there.high]
    if not all(isinstance(each, float) and isfinite(each) for each in numbers):
        return False
    a, b, *ends = (float(each or 0.0) for each in numbers)
    return abs(a - b) > SPREADS * sqrt(((ends[1] - ends[0]) / 2) ** 2 + ((ends[3] - ends[2]) / 2) ** 2)
