"""The answer of the study of prediction: on made-up studies whose answer is known, and by code written apart."""

from functools import cache
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import t

from notebooks.paper.figures import RESULTS
from notebooks.paper.found import PAGE, lines, make, page
from notebooks.paper.statements import judgements
from notebooks.paper.study import study
from notebooks.prediction.answers import ENOUGH, FILE, MEASURES, PAIRS, SCORE, answer, answers, read_prediction
from notebooks.prediction.shuffled import SHUFFLED, main, shuffled
from notebooks.prediction.switches import switch_effects
from splat.model.untrusted import read_table
from tests.notebooks.test_claims import PAPER
from tests.notebooks.test_claims import made_up as paper
from tests.refusals import refused

ROOT = Path(__file__).parents[2]
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
            rows.append((scene, cell, run, "end", True, 30 + train, 20 + score, 1e4 * np.exp(count), np.exp(trace)))
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


def apart(rows: pd.DataFrame, name: str) -> dict[str, float]:
    """What `answers` finds of a measure at one time, by code that shares nothing with it."""
    columns = [name, SCORE, "psnr_train", "gaussians"]
    known = rows.dropna(subset=columns).groupby("scene").filter(lambda part: len(part) >= 12)
    scenes, cells = sorted({*known["scene"]}), sorted({*known["cell"]})

    @cache
    def tau(scene: str, left_out: str) -> float:
        part = known.loc[(known["scene"] == scene) & (known["cell"] != left_out), columns].to_numpy().T
        signs = np.sign(part[:, :, None] - part[:, None]).reshape(4, -1)  # of the differences of all pairs of runs
        r = signs @ signs.T  # Kendall's tau-b, which leaves out ties of either, is the cosine of these signs
        r = np.sin(np.pi / 2 * r / np.sqrt(np.outer(r.diagonal(), r.diagonal())))
        least, vector = (found[..., :1] for found in np.linalg.eigh(r))  # of few runs it may be negative
        r += max(0.001 - least[0], 0.0) * vector @ vector.T
        left = np.linalg.solve(r[2:, 2:], r[2:, :2]).T
        over = lambda i, j: r[i, j] - left[i] @ r[2:, j]  # noqa: E731
        return float(2 / np.pi * np.arcsin(over(0, 1) / np.sqrt(over(0, 0) * over(1, 1))))

    def variance(left_out: list[float]) -> float:
        return (len(left_out) - 1) / len(left_out) * float(((np.array(left_out) - np.mean(left_out)) ** 2).sum())

    own = [tau(scene, "") for scene in scenes]
    mean, freedom = float(np.mean(own)), len(cells) - 1
    of_cells = total = variance([float(np.mean([tau(scene, cell) for scene in scenes])) for cell in cells])
    if len(scenes) >= 5:
        of_scenes = variance([float(np.mean(np.delete(own, place))) for place in range(len(scenes))])
        of_both = variance([
            float(np.mean([tau(other, cell if other == scene else "") for other in scenes]))
            for scene, cell in product(scenes, cells)
        ])  # fmt: skip
        total, freedom = max(of_cells, of_scenes, of_cells + of_scenes - of_both), min(freedom, len(scenes) - 1)
    half = float(t.ppf(0.975, freedom)) * total**0.5
    shares = {pair: [] for pair in PAIRS}
    for _, part in known.groupby(["scene", "seed"]):
        for one, two in combinations(part.to_dict("records"), 2):
            pair = "".join(sorted({*one["cell"]} ^ {*two["cell"]}))
            if pair in shares:
                sign = np.sign((one[name] - two[name]) * (one[SCORE] - two[SCORE]) * mean)
                shares[pair].append((1 + sign) / 2)
    return {
        "tau": mean, "low": max(mean - half, -1.0), "high": min(mean + half, 1.0),
        "p": 2 * float(t.sf(abs(mean) / total**0.5, freedom)), "scenes": len(scenes), "n": len(known),
        "alike": sum(each * mean > 0 for each in own),
        "agreement": min(float(np.mean(same)) for same in shares.values() if same),
    }  # fmt: skip


def test_code_written_apart_finds_the_same_numbers():
    rng, rows = np.random.default_rng(0), made_up(0.4, 1, cells=10, seeds=2).assign(at="30")
    rows[["psnr_train", SCORE, "trace"]] += 1.5 * rng.normal(size=(len(rows), 3))  # so that no correlation is near 1
    line, again = answers(pd.concat([rows, rows.assign(at="end")])).iloc[0], apart(rows, "trace")
    assert {name: line[name] for name in again} == pytest.approx(again, rel=1e-9)
    assert line["p"] == line["holm"]


@pytest.mark.parametrize("at", ["30", "end"])
def test_every_stored_answer_is_found_a_second_time(at):
    rows = read_prediction(RESULTS / FILE)
    lines = {line["measure"]: line for line in answers(rows).to_dict("records") if line["at"] == at}
    low = {
        (x["scene"], x["cell"], x["seed"]) for x in rows.to_dict("records") if x["at"] == "end" and x["psnr_train"] < 20
    }
    kept = [
        x
        for x in rows.to_dict("records")
        if x["at"] == at and x["reached"] and (x["scene"], x["cell"], x["seed"]) not in low
    ]
    again = {name: apart(pd.DataFrame(kept), name) for name in lines}
    judged, raised = sorted(again.keys() - {"ensemble", "coadaptation"}, key=lambda name: again[name]["p"]), 0.0
    for tried, name in zip(range(len(judged), 0, -1), judged):
        raised = max(raised, min(tried * again[name]["p"], 1.0))
        again[name]["holm"] = raised
    for name, each in again.items():
        assert {key: lines[name][key] for key in each} == pytest.approx(each, rel=1e-6), name
        sure, large = each["low"] * each["high"] > 0 and each.get("holm", 0.0) < 0.05, abs(each["tau"]) >= 0.2
        inside = each["low"] > -0.25 and each["high"] < 0.25
        said = "predicts" if sure and large and each["alike"] >= 5 else "does not" if inside else "undecided"
        assert lines[name]["answer"] == (said if each["scenes"] >= 5 else "undecided"), name


def test_collapsed_trainings_and_missed_levels_are_counted_and_left_out():
    rows = made_up(0.7, 0, cells=16)
    there = pd.concat([rows, rows.assign(at="33")], ignore_index=True)
    there.loc[(there["cell"] == CELLS[0]) & (there["at"] == "end"), "psnr_train"] = 19.0
    there.loc[(there["cell"] == CELLS[1]) & (there["at"] == "33"), ["reached", "trace"]] = [False, np.nan]
    found = answers(there).set_index("at")
    assert found["left_out"].tolist() == [18, 18] and found["missing"].to_dict() == {"33": 18, "end": 0}
    assert found["n"].to_dict() == {"33": 18 * 14, "end": 18 * 15}


def written(rows: pd.DataFrame, folder: Path) -> Path:
    """The table of a study with that of its shuffled scores, in a folder."""
    rows.to_csv(folder / FILE, index=False)
    assert main([str(folder / FILE), "--draws", "2", "--out", str(folder / SHUFFLED)]) == 0
    return folder / FILE


def test_tables_figures_and_a_page_are_written(tmp_path):
    stored, found = written(made_up(0.7, 0), tmp_path), judgements(paper(PAPER))
    made = {path.name: path for path in make(stored, found, tmp_path / "out")}
    assert {*made} == {
        "answers.csv", "caption.md", "prediction.png", "prediction.pdf", "switches.csv", "switches.png", "switches.pdf", PAGE,
    }  # fmt: skip
    assert "576 trainings of 6 scenes" in made["caption.md"].read_text()
    said = made[PAGE].read_text()
    assert "at the end trace of 1 predicts PSNR on held-out views" in " ".join(said.split())
    assert "Of 2 studies with shuffled scores 0 said" in said and "9. 3DGS scores" in said
    made_up(0.7, 0, cells=3).to_csv(stored, index=False)
    [caption] = make(stored, found, tmp_path / "few")
    assert "nothing is answered" in caption.read_text()


def test_a_switch_has_the_effect_that_was_made():
    rows = made_up(0.0, 0).assign(trace=1.0, psnr_train=30.0, gaussians=1e4)
    on = {switch: np.array([switch in cell for cell in rows["cell"]]) for switch in "abcdefg"}
    rows[SCORE] = 20 + 0.5 * on["a"] - 0.25 * on["f"] + 0.1 * (rows["scene"] == "u") * on["a"]
    rows["trace"] = 2.0 ** on["c"]
    found = switch_effects(rows).set_index(["quantity", "switch"])
    scores = found.loc[SCORE]
    assert scores["value"].to_dict() == pytest.approx(
        dict.fromkeys("abcdefg", 0.0) | {"a": 0.5 + 0.1 / 6, "f": -0.25}, abs=1e-9
    )
    half = t.ppf(0.975, 5) * np.std([0.6, 0.5, 0.5, 0.5, 0.5, 0.5], ddof=1) / 6**0.5
    assert scores.loc["a", "high"] - scores.loc["a", "value"] == pytest.approx(half)
    assert found.loc[[("trace", "c"), ("trace", "a")], "value"].tolist() == pytest.approx([2.0, 1.0])


def test_shuffled_scores_are_those_of_other_cells_of_the_scene_and_time():
    rows = made_up(0.5, 0, cells=6)
    rows = pd.concat([rows, rows.assign(at="30", **{SCORE: rows[SCORE] + 50})], ignore_index=True)
    found = shuffled(rows, 1)
    for key, part in found.groupby(["scene", "at"]):
        before = rows.groupby(["scene", "at"]).get_group(key).groupby("cell")[SCORE].apply(tuple)
        after = part.groupby("cell")[SCORE].apply(tuple)
        assert sorted(before) == sorted(after) and list(before) != list(after)  # the seeds of a cell stay together


def test_the_page_and_readme_say_what_the_stored_tables_give():
    rows, found = read_prediction(RESULTS / FILE), judgements(study([RESULTS / "study.csv"]))
    answered, switched = answers(rows), switch_effects(rows)
    scores = read_table(RESULTS / SHUFFLED, dtype={"at": str})
    assert page(rows, answered, switched, scores, found) == (ROOT / "docs" / PAGE).read_text()
    assert lines(rows, answered, switched, found) in (ROOT / "README.md").read_text()


def test_another_table_is_refused(tmp_path):
    (tmp_path / "prediction.csv").write_text("scene,cell\nfern,a\n")
    refused("expected the table of notebooks", read_prediction, Path(tmp_path / "prediction.csv"))
