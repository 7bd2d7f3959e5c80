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


def test_indices_that_contradict_each_other_are_told():
    def said(*rows: Row) -> str:
        return sayings(grouped(rows, SINGLE), SINGLE)[-1]

    def rank(*values: float, half: float) -> Row:
        return row("anisotropy", "participation ratio", *values, half=half)

    share = row("anisotropy", "top mass", 0.1, 0.2, half=0.01)
    contradict = "by top mass sam is the more anisotropic, but by participation ratio plain is the more anisotropic."
    assert said(share, rank(50.0, 90.0, half=5.0)) == f"The indices contradict each other: {contradict}"
    agree = "The indices that decide ({}) agree: sam is the more anisotropic of sam and plain."
    assert said(share, rank(90.0, 50.0, half=5.0)) == agree.format("top mass, participation ratio")
    assert said(share, rank(50.0, 90.0, half=30.0)) == agree.format("top mass")
    assert said(rank(50.0, 90.0, half=30.0)) == "No index decides whether sam and plain differ in anisotropy."
    assert "not known of groups of one run" in sayings(grouped([share], SINGLE), SINGLE)[0]
