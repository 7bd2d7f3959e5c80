"""The verdicts on the stored study, found a second time from its rows by code that shares nothing with the statements'."""

import csv
from collections import defaultdict
from math import exp, log
from pathlib import Path
from statistics import fmean, stdev

import pytest
from scipy.stats import t

from notebooks.paper.statements import judgements
from notebooks.paper.study import study

STORED = Path(__file__).parents[2] / "notebooks" / "results" / "study.csv"
RUNS: list[dict[str, str]] = list(csv.DictReader(STORED.open(encoding="utf-8")))
KEYS, AND_PROCESSOR = ("scene", "seed"), ("scene", "seed", "machine", "threads")
STABLE, ALONE = "stablegs", "stablegs vsp_weight=0"


def of(column: str, method: str, keys: tuple[str, ...] = KEYS) -> dict[tuple[str, ...], float]:
    """A method's numbers by scene and seed, or more columns; repeats are averaged."""
    found = defaultdict(list)
    for run in RUNS:
        if run["method"] == method and run[column]:
            found[tuple(run[key] for key in keys)].append(float(run[column]))
    return {key: fmean(values) for key, values in found.items()}


def interval(
    values: list[float], deviation: float | None = None, freedom: int | None = None
) -> tuple[float, float, float, int]:
    n = len(values)
    half = float(t.ppf(0.975, freedom or n - 1)) * (stdev(values) if deviation is None else deviation) / n**0.5
    return fmean(values), fmean(values) - half, fmean(values) + half, n


def ratio(column: str, method: str = STABLE, sign: int = 1, then: str | None = None) -> tuple[float, float, float, int]:
    """Over 3DGS, a mean of logarithms.  then: the column over which the column is taken first."""
    keys = AND_PROCESSOR if column == "cpu_seconds" else KEYS
    ours, base = of(column, method, keys), of(column, "3dgs", keys)
    logs = {key: log(abs(ours[key] / base[key])) for key in ours.keys() & base.keys()}
    if then:
        below, under = of(then, method), of(then, "3dgs")
        logs = {key: value - log(abs(below[key] / under[key])) for key, value in logs.items()}
    pairs = defaultdict(list)
    for key, value in logs.items():
        pairs[key[:2]].append(sign * value)
    value, low, high, n = interval([fmean(each) for each in pairs.values()])
    return exp(value), exp(low), exp(high), n


def gained(method: str, over: str = "3dgs") -> tuple[float, float, float, int]:
    """PSNR over another method's, with the deviation of all methods' gains over it."""
    base, within, of_method = of("psnr", over), [], {}
    for name in {run["method"] for run in RUNS} - {over}:
        ours = of("psnr", name)
        gains = [ours[key] - base[key] for key in ours.keys() & base.keys()]
        of_method[name] = gains
        if len(gains) > 1:
            within.append([gain - fmean(gains) for gain in gains])
    freedom = sum(map(len, within)) - len(within)
    deviation = (sum(x * x for each in within for x in each) / freedom) ** 0.5
    return interval(of_method[method], deviation, freedom)


def verdict(found: tuple[float, float, float, int], null: float, claimed: float) -> str:
    """By the words of the table in the docstring of `effects`."""
    low, high = found[1:3] if claimed >= null else (-found[2], -found[1])
    null, claimed = (null, claimed) if claimed >= null else (-null, -claimed)
    if low > null:
        return "holds" if high >= claimed else "holds in part"
    return "undecided" if high >= claimed else "does not hold"


def every(column: str) -> list[float]:
    return [float(run[column]) for run in RUNS if run[column]]


def test_every_stored_verdict_is_found_a_second_time():
    depth, opacity = interval([log(x) for x in every("depth_gradient")]), interval(every("opacity_one_view"))
    depth = exp(depth[0]), exp(depth[1]), exp(depth[2]), depth[3]
    null = fmean(of("needle_count", "3dgs").values())
    needles = [interval([*of(f"needles_{name}", "3dgs").values()]) for name in ("quats", "log_scales")]
    dominant = {verdict(each, null, 0.5) for each in needles}
    index, flat, elongated = (
        ratio("eigenvalue_ratio"), ratio("lambda_max", sign=-1), ratio("lambda_max", sign=-1, then="lambda_second"),
    )  # fmt: skip
    basin = {verdict(each, 1.0, 1.0) for each in (flat, elongated)}
    alone, stable, rival = gained(f"{ALONE} probe.attributes=means"), gained(STABLE), gained(STABLE, "dropgaussian")
    time = ratio("cpu_seconds")
    expected = {
        1: (index, verdict(index, 1.0, 0.26)), 2: (depth, verdict(depth, 1.0, 100.0)),
        3: (needles[0], dominant.pop() if len(dominant) == 1 else "holds in part"), 4: (alone, verdict(alone, 0.0, 2.46)),
        5: (opacity, verdict(opacity, 0.0, 0.0)),
        7: (flat, basin.pop() if len(basin) == 1 else "holds in part" if "holds" in basin else "does not hold"),
        8: (time, "does not hold" if time[1] > 1.45 else "undecided"), 9: (stable, verdict(stable, 0.0, 4.73)),
        10: (rival, verdict(rival, 0.0, 0.43)),
    }  # fmt: skip
    names = [f"hutchinson_{name}" for name in ("means", "log_scales", "quats", "opacity_logits", "sh")]
    least, most = ([interval([log(x) for x in every(name + end)]) for name in names] for end in ("", "_most"))
    worst, enough = max(most), all(exp(each[2]) <= 0.1 for each in most)
    short = any(exp(each[1]) > 0.1 for each in least)
    expected[6] = (
        (exp(worst[0]), exp(worst[1]), exp(worst[2]), worst[3]),
        "does not hold" if short else "holds" if enough else "undecided",
    )
    found = {each.number: each for each in judgements(study([STORED]))}
    for number, (numbers, said) in expected.items():
        first = found[number].effects[0].interval
        assert (first.value, first.low, first.high, first.n) == pytest.approx(numbers, rel=1e-6), number
        assert found[number].verdict == said, number
