"""The answer of the study of prediction: on made-up studies whose answer is known, and by code written apart."""

from itertools import combinations, product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import kendalltau, t

from landscape.errors import InputError
from notebooks.paper.prediction import ENOUGH, MEASURES, PAIRS, SCORE, answer, answers, make, read_prediction

SIGNS = [dict(zip("abcde", signs)) for signs in product((-1, 1), repeat=5)]
CELLS = [
    "".join(letter for letter, sign in (each | {"f": f, "g": g}).items() if sign > 0)
    for each in SIGNS
    for f, g in [(each["a"] * each["b"] * each["c"] * each["d"], each["a"] * each["b"] * each["d"] * each["e"])]
]


def made_up(strength: float, seed: int, cells: int = 32, seeds: int = 3) -> pd.DataFrame:
    """A study of six scenes in which the trace is the score's own part by that strength; both go with the controls too."""
    rng, rows = np.random.default_rng(seed), []
    for scene, cell in product("uvwxyz", CELLS[:cells]):
        controls, own, other = rng.normal(size=2), *rng.normal(size=2)
        for run in range(seeds):
            train, count = controls + 0.3 * rng.normal(size=2)
            both = train - count + 0.3 * rng.normal(size=2)
            trace = both[0] + own
            score = both[1] + strength * own + (1 - strength**2) ** 0.5 * other
            rows.append((scene, cell, run, "end", True, 30 + train, 20 + score, 1e4 * np.exp(count), trace))
    names = ["scene", "cell", "seed", "at", "reached", "psnr_train", SCORE, "gaussians", "trace"]
    return pd.DataFrame(rows, columns=names).assign(**{name: np.nan for name in MEASURES if name != "trace"})


def test_nothing_predicts_in_studies_whose_scores_are_independent_of_the_measure():
    found = [answers(made_up(0.0, seed, cells=8, seeds=2)).iloc[0] for seed in range(40)]
    assert sum(answer(line.to_dict(), ENOUGH) == "predicts" for line in found) <= 2


def test_a_measure_that_is_half_of_the_score_predicts():
    line = answers(made_up(0.7, 0)).iloc[0]
    assert line["answer"] == "predicts" and line["alike"] == 6 and line["gain"] > 0.1 and line["agreement"] > 0.5


def test_a_large_study_says_that_a_measure_does_not_predict():
    assert sum(answers(made_up(0.0, seed)).iloc[0]["answer"] == "does not" for seed in range(4)) >= 2


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, "predicts"),
        ({"low": -0.01}, "undecided"),
        ({"tau": 0.19}, "undecided"),
        ({"alike": 4}, "undecided"),
        ({"holm": 0.06}, "undecided"),
        ({"holm": np.nan}, "predicts"),
        ({"tau": 0.1, "low": -0.04, "high": 0.24}, "does not"),
    ],
)
def test_each_criterion_counts(changed, expected):
    line = {"tau": 0.4, "low": 0.2, "high": 0.6, "holm": 0.01, "alike": 5, "scenes": 6} | changed
    assert answer(line, ENOUGH) == expected
    assert answer(line, ENOUGH - 1) == "not yet"


def test_code_written_apart_finds_the_same_numbers():
    rng, rows = np.random.default_rng(0), made_up(0.4, 1, cells=10, seeds=2).assign(at="30")
    rows[["psnr_train", SCORE, "trace"]] += 1.5 * rng.normal(size=(len(rows), 3))  # so that no correlation is near 1
    line = answers(pd.concat([rows, rows.assign(at="end")])).iloc[0]
    columns = ["trace", SCORE, "psnr_train", "gaussians"]

    def tau(part: pd.DataFrame) -> float:
        r = np.eye(4)
        for i, j in combinations(range(4), 2):
            found: float = kendalltau(part[columns[i]], part[columns[j]])[0]  # pyright: ignore[reportAssignmentType]
            r[i, j] = r[j, i] = np.sin(np.pi / 2 * found)
        left = np.linalg.solve(r[2:, 2:], r[2:, :2]).T
        over = lambda i, j: r[i, j] - left[i] @ r[2:, j]  # noqa: E731
        return float(2 / np.pi * np.arcsin(over(0, 1) / np.sqrt(over(0, 0) * over(1, 1))))

    def mean(part: pd.DataFrame) -> float:
        return float(np.mean([tau(runs) for _, runs in part.groupby("scene")]))

    scenes, cells = rows["scene"].unique(), rows["cell"].unique()
    variance = lambda left_out: (len(left_out) - 1) / len(left_out) * ((left_out - np.mean(left_out)) ** 2).sum()  # noqa: E731
    of_cells = variance(np.array([mean(pd.DataFrame(rows[rows["cell"] != cell])) for cell in cells]))
    of_scenes = variance(np.array([mean(pd.DataFrame(rows[rows["scene"] != scene])) for scene in scenes]))
    both = [rows[(rows["scene"] != scene) | (rows["cell"] != cell)] for scene, cell in product(scenes, cells)]
    of_both = variance(np.array([mean(pd.DataFrame(part)) for part in both]))
    error = max(of_cells, of_scenes, of_cells + of_scenes - of_both) ** 0.5
    half = t.ppf(0.975, 5) * error
    assert line[["tau", "low", "high"]].astype(float).tolist() == pytest.approx(
        [mean(rows), mean(rows) - half, mean(rows) + half], rel=1e-9
    )
    assert line["p"] == line["holm"] == pytest.approx(2 * t.sf(abs(mean(rows)) / error, 5), rel=1e-9)
    shares = {pair: [] for pair in PAIRS}
    for i, j in combinations(range(len(rows)), 2):
        one, two = rows.iloc[i], rows.iloc[j]
        pair = "".join(sorted({*one["cell"]} ^ {*two["cell"]}))
        if one["scene"] == two["scene"] and one["seed"] == two["seed"] and pair in shares:
            shares[pair].append((one["trace"] > two["trace"]) == (one[SCORE] > two[SCORE]))
    least = min(np.mean(same) if mean(rows) > 0 else 1 - np.mean(same) for same in shares.values() if same)
    assert line["agreement"] == pytest.approx(least)


def test_collapsed_trainings_and_missed_levels_are_counted_and_left_out():
    rows = made_up(0.7, 0, cells=16)
    there = pd.concat([rows, rows.assign(at="33")], ignore_index=True)
    there.loc[(there["cell"] == CELLS[0]) & (there["at"] == "end"), "psnr_train"] = 19.0
    there.loc[(there["cell"] == CELLS[1]) & (there["at"] == "33"), ["reached", "trace"]] = [False, np.nan]
    found = answers(there).set_index("at")
    assert found["left_out"].tolist() == [18, 18] and found["missing"].to_dict() == {"33": 18, "end": 0}
    assert found["n"].to_dict() == {"33": 18 * 14, "end": 18 * 15}


def test_a_table_a_figure_and_a_caption_are_written(tmp_path):
    rows = made_up(0.7, 0)
    assert {path.name for path in make(rows, tmp_path)} == {
        "answers.csv", "caption.md", "prediction.png", "prediction.pdf",
    }  # fmt: skip
    said = (tmp_path / "caption.md").read_text()
    assert "576 trainings of 6 scenes" in said and "predicts: end: trace" in said
    few = pd.DataFrame(rows[rows["cell"].isin(CELLS[:3])])
    [caption] = make(few, tmp_path / "few")
    assert "nothing is answered" in caption.read_text()


def test_another_table_is_refused(tmp_path):
    (tmp_path / "prediction.csv").write_text("scene,cell\nfern,a\n")
    with pytest.raises(InputError, match="expected the table of notebooks"):
        read_prediction(Path(tmp_path / "prediction.csv"))
