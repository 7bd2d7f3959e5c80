"""Groups of seeds: mean and spread, and the sentences that a comparison opens with."""

from pathlib import Path

import numpy as np

from analysis.records.quantities import HARD
from analysis.records.tables import Cell
from analysis.runs.compare_table import CONFIRMED, Entry, Row
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
    assert "; not in trace of opacity. These 2 quantities were tried, no others" in differences
    assert differences.endswith(
        "over n = 3 and 3 seeds. Of quantities that do not differ, chance makes up to 8% look apart."
    )


def test_chance_makes_no_more_of_equal_quantities_look_apart_than_is_said():
    generator = np.random.default_rng(0)
    for n, m, wider, most in ((2, 2, 1.0, 22), (2, 2, 30.0, 22), (2, 5, 30.0, 22), (3, 3, 30.0, 8)):
        first, second = wider * generator.normal(size=(20_000, n)), generator.normal(size=(20_000, m))
        apart = abs(first.mean(axis=1) - second.mean(axis=1))
        seen = np.mean(apart > 2 * np.sqrt(first.var(axis=1, ddof=1) + second.var(axis=1, ddof=1)))
        pair = [Group(name, tuple(map(Path, name * size))) for name, size in (("a", n), ("b", m))]
        told = sayings(grouped([row("trace", "opacity", *map(float, range(n + m)))], pair), pair)[0]
        assert f"chance makes up to {most}% look apart" in told and 100 * seen < most
        assert wider == 1 or 100 * seen > 0.9 * most - 1  # nor many more


def test_of_a_group_it_is_said_in_how_many_runs_renders_confirm_an_end_and_how_many_gaussians_it_has():
    cells = [Cell("1", CONFIRMED[True]), Cell("2", CONFIRMED[False]), Cell("3", CONFIRMED[True])]
    ends = Row("spectrum", "largest eigenvalue", tuple(Entry(float(cell.value), cell) for cell in 2 * cells))
    counts = Row("run", "Gaussians", tuple(Entry(n, Cell(f"{n:,}")) for n in (7367, 7333, 7350, 9, 9, 10)))
    found = [row.entries for row in grouped([ends, counts], PAIR)]
    assert {each.cell.bracket for each in found[0]} == {"confirmed by renders in 2 of 3"}
    assert [each.cell.value.replace(HARD, " ") for each in found[1]] == ["7,350 ± 17", "9 ± 1"]


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
        "Undecided which of sam and plain is the more anisotropic, because a single training of one"
    )


def counts(plain: int, sam: int) -> Row:
    return Row("run", "Gaussians", tuple(Entry(n, Cell(f"{n:,}")) for n in 3 * [plain] + 3 * [sam]))


def test_other_numbers_of_gaussians_decide_nothing_without_a_split_control():
    rows = [steady("anisotropy", SHARE, 0.1, 0.2), counts(8000, 30000)]
    assert said(*rows).endswith(
        "because they have 30,000 and 8,000 Gaussians, and their number alone changes the indices: --split-control measures "
        "how much."
    )
    control = steady("anisotropy", "  split control", 1.1, 1.2)
    assert said(*rows, control).startswith("sam is the more anisotropic")
    assert said(rows[0], counts(8000, 8500)).startswith("sam is the more anisotropic")
