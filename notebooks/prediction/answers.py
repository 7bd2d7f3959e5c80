"""Which measure goes with the views that were held out, beyond training PSNR and ln N: the answer of prediction.csv.

tau         Kendall's, of measure and PSNR of the held-out views given the controls, within each scene; the mean over the scenes
            with its interval of 95% by the jackknife over cells and scenes (`notebooks.statistics`)
holm        p after Holm's correction for the measures without the bars, at one time
alike       scenes, of scenes, whose own tau has the sign of the mean
agreement   share of the pairs of trainings that the measure orders as tau says, the least over PAIRS.  Of the fraction of
            notebooks/prediction.toml no two cells differ in one switch: the pairs differ in two, and in nothing else
gain        of R^2 in a scene left out, over that of the controls: least squares on ranks within the scenes
tau_SCENE   of a scene's trainings alone
answer      "predicts": the interval has no 0, p < 0.05 after Holm, |tau| >= LARGE, and one sign in five of six scenes; "does
            not": the interval lies inside +-SMALL; else "undecided", as with fewer than five scenes.  "not yet": fewer
            trainings than ENOUGH have ended

A scene counts from LEAST trainings with the measure on.  Left out, and counted in `left_out`, are trainings whose PSNR on the
training views ends below COLLAPSED; `missing` counts those that were never as good as the level.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import rankdata

from figures.style import BLUE, GREEN, MISSING, UNDETERMINED, VERMILION, new_figure, save, style
from landscape.errors import InputError
from notebooks.names import words_of
from notebooks.statistics import LEAST as FEWEST_SCENES
from notebooks.statistics import digits, holm, interval, interval_text, jackknife
from splat.model.untrusted import read_table, write_atomically

FILE = "prediction.csv"
KEYS, SCORE, CONTROLS = ["scene", "cell", "seed", "at"], "psnr_test", ("psnr_train", "gaussians")
INFINITESIMAL = ("trace", "trace_means", "lambda_max", "eigenvalue_ratio", "participation_ratio")
FINITE = ("order_fragility", "field_sharpness", "critical_sharpness")
UNSEEN = ("open_curvature", "order_fragility_new", "field_sharpness_new")
BARS = ("coadaptation", "ensemble")
MEASURES = INFINITESIMAL + FINITE + UNSEEN + BARS
COLOURS: dict[str, str] = {
    name: colour for names, colour in ((INFINITESIMAL, BLUE), (FINITE, VERMILION), (UNSEEN, GREEN)) for name in names
}
ANSWERS = ("predicts", "does not", "undecided")
TIMES = {"30": "at 30 dB", "end": "at the end"}  # the answers that were planned; few reach 33 and 36 dB in five scenes
PAIRS = ("ab", "ad", "bd", "cf", "eg")
LARGE, SMALL, COLLAPSED, ENOUGH, LEAST = 0.2, 0.25, 20.0, 400, 12
ROW = 0.19  # inches
COLUMNS = (
    "at", "measure", "tau", "low", "high", "p", "holm", "alike", "scenes", "agreement", "pair", "gain", "n", "missing",
    "left_out", "answer",
)  # fmt: skip


def read_prediction(path: Path) -> pd.DataFrame:
    """The rows of notebooks.prediction.  InputError for another table."""
    rows = read_table(path, dtype={"at": str})
    if lacking := {*KEYS, "reached", SCORE, *CONTROLS, *MEASURES} - {*rows}:
        raise InputError(f"expected the table of notebooks.prediction in {path}, got one without {sorted(lacking)[0]}")
    return rows.assign(eigenvalue_ratio=rows["eigenvalue_ratio"].abs())  # of the less isotropic the higher


def answers(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each time and measure with the columns COLUMNS, where there is something to say."""
    ends = rows[rows["at"] == "end"]
    collapsed = pd.MultiIndex.from_frame(pd.DataFrame(ends.loc[ends["psnr_train"] < COLLAPSED, KEYS[:3]]))
    kept = pd.DataFrame(rows[~pd.MultiIndex.from_frame(pd.DataFrame(rows[KEYS[:3]])).isin(collapsed)])
    lines = []
    for at in sorted({*kept["at"]}, key=lambda at: (at == "end", at)):
        some = pd.DataFrame(kept[kept["at"] == at])
        reached = pd.DataFrame(some[some["reached"].astype(bool)])
        table = pd.DataFrame(_lines(reached))
        if not len(table):
            continue
        judged = ~table["measure"].isin(BARS)
        table.loc[judged, "holm"] = holm(table.loc[judged, "p"])
        lines.append(table.assign(at=at, missing=len(some) - len(reached), left_out=len(collapsed)))
    found = pd.concat(lines) if lines else pd.DataFrame(columns=list(COLUMNS))
    found["answer"] = [answer(line, len(ends)) for line in found.to_dict("records")]
    of_scenes = [name for name in found if name not in COLUMNS]
    return found.reindex(columns=[*COLUMNS, *of_scenes]).reset_index(drop=True)


def answer(line: dict, trainings: int) -> str:
    """The criteria that were fixed beforehand, on one row of `answers`."""
    if trainings < ENOUGH:
        return "not yet"
    if line["scenes"] < FEWEST_SCENES:
        return "undecided"
    apart = (line["low"] > 0 or line["high"] < 0) and not line["holm"] >= 0.05  # bars have no p of Holm's
    if apart and abs(line["tau"]) >= LARGE and 6 * line["alike"] >= 5 * line["scenes"]:
        return "predicts"
    return "does not" if max(abs(line["low"]), abs(line["high"])) < SMALL else "undecided"


def write_answers(rows: pd.DataFrame, found: pd.DataFrame, out: Path) -> Iterator[Path]:
    """Write caption, and where something is found table and figure; gives each file when it is there."""
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / "caption.md", f"{caption(rows, found)}\n".encode())
    yield out / "caption.md"
    if len(found):
        write_atomically(out / "answers.csv", found.to_csv(index=False, float_format="%.4g").encode())
        yield out / "answers.csv"
        figure = draw_prediction(found)
        yield from (save(figure, out / f"prediction.{suffix}") for suffix in ("png", "pdf"))


def _lines(rows: pd.DataFrame) -> Iterator[dict]:
    """Of one time.  rows: of the trainings that got there."""
    for name in MEASURES:
        known = rows.dropna(subset=[name, SCORE, *CONTROLS])
        enough = {scene for scene in {*known["scene"]} if sum(known["scene"] == scene) >= LEAST}
        known = pd.DataFrame(known[known["scene"].isin([*enough])])
        values = known[[name, SCORE, *CONTROLS]].to_numpy(float)
        scenes, cells = (pd.factorize(known[key])[0] for key in ("scene", "cell"))
        tau, error, clusters = jackknife(values, scenes, cells)
        if clusters < 2 or not np.isfinite(tau + error):
            continue
        parts = {scene: known["scene"] == scene for scene in known["scene"].unique()}
        own = {scene: jackknife(values[part], scenes[part], cells[part])[0] for scene, part in parts.items()}
        agreement, pair = least_agreement(known, name, np.sign(tau))
        line = {"measure": name, "tau": tau, **interval(tau, error, clusters), "n": len(values), "scenes": len(own)}
        line |= {"alike": sum(tau * each > 0 for each in own.values()), "agreement": agreement, "pair": pair}
        yield line | {"gain": gain_of_r2(values, scenes)} | {f"tau_{scene}": each for scene, each in own.items()}


def least_agreement(rows: pd.DataFrame, name: str, sign: float) -> tuple[float, str]:
    """The least share of PAIRS that the measure orders as its sign says, and the two switches; nan without such pairs."""
    shares: dict[str, float] = {}
    for pair in PAIRS:  # of each cell there is one other that differs in these two
        other = ["".join(sorted({*cell} ^ {*pair})) for cell in rows["cell"]]
        both = rows.assign(cell=other).merge(rows, on=["scene", "seed", "cell"])
        signs = np.sign((both[f"{name}_x"] - both[f"{name}_y"]) * (both[f"{SCORE}_x"] - both[f"{SCORE}_y"]))
        if len(signs):
            shares[pair] = float((1 + sign * signs.mean()) / 2)
    least = min(shares, key=lambda pair: shares[pair], default="")
    return shares.get(least, np.nan), least


def gain_of_r2(values: np.ndarray, scenes: np.ndarray) -> float:
    """R^2 of the score in a scene left out with the measure, less that without; the mean over the scenes.

    values: (n, 4), measure, score, controls, of which the ranks within a scene, from -1 to 1, are fitted on the other scenes.
    """
    ranks = np.empty_like(values)
    for scene in np.unique(scenes):
        chosen = scenes == scene
        ranks[chosen] = (2 * rankdata(values[chosen], axis=0) - 1) / chosen.sum() - 1
    measure, score, controls = ranks[:, :1], ranks[:, 1], ranks[:, 2:]

    def r2(inputs: np.ndarray) -> float:
        of_scenes = []
        for scene in np.unique(scenes):
            out = scenes == scene
            fitted = np.linalg.lstsq(inputs[~out], score[~out], rcond=None)[0]
            of_scenes.append(1 - ((score[out] - inputs[out] @ fitted) ** 2).sum() / (score[out] ** 2).sum())
        return float(np.mean(of_scenes))

    if len(np.unique(scenes)) < 2:
        return np.nan
    return r2(np.hstack([measure, controls])) - r2(controls)


def draw_prediction(table: pd.DataFrame) -> Figure:
    """A panel for each time, a row for each measure, its colour the kind; small dots: the scenes; band: +-LARGE."""
    times, names = list(table["at"].unique()), [name for name in MEASURES if name in {*table["measure"]}][::-1]
    with style():
        figure = new_figure(1.0 + ROW * len(names), 6.8)
        for axes, at in zip(figure.subplots(1, len(times), sharey=True, squeeze=False)[0], times, strict=True):
            axes.axvspan(-LARGE, LARGE, color=MISSING, alpha=0.5, linewidth=0)
            axes.axvline(0, color="0.5", linewidth=0.6)
            for line in pd.DataFrame(table[table["at"] == at]).to_dict("records"):
                place, colour = names.index(line["measure"]), COLOURS.get(line["measure"], UNDETERMINED)
                axes.hlines(place, line["low"], line["high"], color=colour, linewidth=1.2)
                dots = [value for name, value in line.items() if name.startswith("tau_")]
                axes.plot(dots, [place] * len(dots), ".", color=colour, markersize=2.5, alpha=0.6)
                axes.plot(line["tau"], place, "o", color=colour, markersize=4)
                if np.isfinite(line["agreement"]):
                    axes.annotate(
                        f"{line['agreement']:.0%}", (1.01, place), xycoords=("axes fraction", "data"), va="center"
                    )
            axes.set_title(TIMES.get(at, f"at {at} dB"), loc="left")
            axes.set(xlim=(-1.05, 1.05))
            axes.grid(True, axis="x")
            axes.set_yticks(range(len(names)), [name_of(name) for name in names])
        figure.supxlabel(
            "Kendall's tau with PSNR held out, given training PSNR and ln N; dots: scenes; right: least agreement of pairs\n"
            "blue: infinitesimal; orange: finite steps; green: unseen poses; grey: without curvature", fontsize=6.5
        )  # fmt: skip
    return figure


def caption(rows: pd.DataFrame, table: pd.DataFrame) -> str:
    """What was measured and what it answers, from the numbers."""
    ended = sum(rows["at"] == "end")
    scenes = len({*rows["scene"]})
    words = f"{ended} trainings of {scenes} scene{'s' * (scenes != 1)}"
    return f"{words}: {summary(table)}" if ended >= ENOUGH else f"{words}; before {ENOUGH} nothing is answered."


def summary(table: pd.DataFrame) -> str:
    """The answers of TIMES in a sentence, and the smallest p."""
    judged = pd.DataFrame(table[table["at"].isin([*TIMES]) & ~table["measure"].isin(BARS)])
    said: dict[str, list[str]] = {}
    for at, words in TIMES.items():
        if part := [line for line in judged.to_dict("records") if line["at"] == at]:
            named = {
                answer: [name_of(line["measure"]) for line in part if line["answer"] == answer] for answer in ANSWERS
            }
            predicts, does_not = (", ".join(named[answer]) or "none" for answer in ANSWERS[:2])
            answered = f"{predicts} of {len(part)} predicts PSNR on held-out views, {does_not} is known not to"
            said.setdefault(f"{answered}, {len(named['undecided'])} are undecided", []).append(words)
    best = judged.sort_values("holm").iloc[0].to_dict()
    nearest = f"{name_of(best['measure'])}, {TIMES[best['at']]}: tau {interval_text(best, 'tau', '.2f')}"
    answered = "; ".join(f"{' and '.join(times)} {words}" for words, times in said.items())
    words = f"{answered}.  Nearest to it is {nearest}, p {digits(best['holm'])} after Holm's correction."
    bars = [
        f"{name_of(line['measure'])} {TIMES[line['at']]} (tau {interval_text(line, 'tau', '.2f')})"
        for line in table.to_dict("records")
        if line["measure"] in BARS and line["answer"] == "predicts" and line["at"] in TIMES
    ]
    return f"{words}  What has no curvature in it and predicts, uncorrected: {', '.join(bars) or 'nothing'}."


def name_of(measure: str) -> str:
    """What a measure is called in figure and caption.

    >>> name_of("trace_means"), name_of("order_fragility_new")
    ('trace of position', 'order fragility, new poses')
    """
    return words_of(measure.removesuffix("_new")) + ", new poses" * measure.endswith("_new")
