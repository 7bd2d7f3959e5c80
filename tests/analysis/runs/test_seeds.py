"""Groups of seeds: mean and spread, and the sentences that a comparison opens with."""

from pathlib import Path

from analysis.records.tables import Cell
from analysis.runs.compare_table import Entry, Row
from analysis.runs.seeds import Group, grouped, sayings

PAIR = [Group("plain", (Path("a"), Path("b"), Path("c"))), Group("sam", (Path("d"), Path("e"), Path("f")))]
SINGLE = [Group("plain", (Path("a"),)), Group("sam", (Path("d"),))]


def row(section: str, name: str, *values: float, half: float = 0.0) -> Row:
    return Row(section, name, tuple(Entry(v, Cell(str(v)), v - half, v + half) for v in values))


def test_a_group_has_the_mean_and_the_spread_of_its_runs():
    (found,) = grouped([row("trace", "position", 1.0, 2.0, 3.0, 10.0, 10.0, 10.0)], PAIR)
    first, second = found.entries
    assert (first.value, first.low, first.high) == (2.0, 1.0, 3.0)  # the standard deviation of 1, 2, 3 is 1
    assert (second.value, second.low, second.high) == (10.0, 10.0, 10.0)


def test_runs_without_a_number_are_counted():
    missing, (one, three) = Entry(None, Cell("-")), (Entry(float(v), Cell(str(v))) for v in (1, 3))
    first, second = grouped([Row("trace", "position", (one, missing, three, *[missing] * 3))], PAIR)[0].entries
    assert first.value == 2.0 and first.cell.bracket == "2 of 3 runs" and second == missing


def test_a_difference_is_told_where_it_is_larger_than_the_spread_of_seeds():
    rows = [
        row("held-out views", "PSNR (dB)", 20.0, 20.1, 20.2, 21.0, 21.1, 21.2),
        row("trace", "opacity", 20.0, 20.1, 20.2, 20.2, 20.3, 20.4),  # 0.2 apart; 2 sqrt(0.1^2 + 0.1^2) = 0.28
    ]
    (differences, _) = sayings(grouped(rows, PAIR), PAIR)
    assert differences.startswith("sam and plain differ by more than the spread of their seeds in PSNR (dB) (21.1")
    assert differences.endswith("; not in trace of opacity.")


def steady(section: str, name: str, plain: float, sam: float) -> Row:
    return row(section, name, *(plain + step for step in (-0.01, 0, 0.01)), *(sam + step for step in (-0.01, 0, 0.01)))


def said(*rows: Row, groups: list[Group] = PAIR) -> str:
    return sayings(grouped(rows, groups), groups)[-1]


RANK, SHARE = "participation ratio", "top mass"


def test_a_verdict_names_the_indices_that_differ_by_more_than_the_seeds():
    share, rank = steady("anisotropy", SHARE, 0.1, 0.2), steady("anisotropy", RANK, 90.0, 50.0)
    assert said(share, rank) == f"sam is the more anisotropic of sam and plain, by {SHARE} and {RANK}."
    undecided = "Undecided which of sam and plain is the more anisotropic, because "
    assert said(share, steady("anisotropy", RANK, 50.0, 90.0)) == (
        f"{undecided}the indices contradict each other: by {SHARE} it is sam, but by {RANK} it is plain."
    )
    assert said(steady("anisotropy", RANK, 50.0, 50.01)) == (
        f"{undecided}no index differs by more than the spread of the seeds."
    )


def test_one_training_of_each_decides_nothing():
    told = sayings(grouped([row("anisotropy", SHARE, 0.1, 0.2, half=0.001)], SINGLE), SINGLE)
    assert len(told) == 1 and told[0].startswith(
        "Undecided which of sam and plain is the more anisotropic, because one training"
    )


def test_other_numbers_of_gaussians_decide_nothing_without_a_split_control():
    rows = [steady("anisotropy", SHARE, 0.1, 0.2), steady("run", "Gaussians", 8000.0, 30000.0)]
    assert said(*rows).endswith(
        "because 30,000 Gaussians against 8,000 make an anisotropy of their own, which --split-control would measure."
    )
    control = steady("anisotropy", "  split control", 1.1, 1.2)
    assert said(*rows, control).startswith("sam is the more anisotropic")
    assert said(rows[0], steady("run", "Gaussians", 8000.0, 8500.0)).startswith("sam is the more anisotropic")
