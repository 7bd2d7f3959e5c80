"""Figures of the study, and their captions.

OUT/claims, predictors      the effects behind the verdicts, and what goes with the score (`notebooks.paper.effect_figures`)
OUT/budget                  after Fig. 8: PSNR on held-out views and the time of a training
OUT/axes                    after Tables 2 and 4: what the axes of StableGS's probes gain, alone and together
OUT/index                   after Fig. 7: the anisotropy index over the steps, with the band of the seeds
OUT/captions.md             a caption for each, and the ten verdicts, written from the numbers

Each figure as PNG and PDF.  A cell of the study that was not run is named where its number would be.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from figures.style import BLUE, RUNS, UNDETERMINED, VERMILION, literal, new_figure, save, style
from notebooks.names import words_of
from notebooks.paper.effect_figures import GIVEN, SIGNIFICANT, draw_claims, draw_predictors
from notebooks.paper.effects import BASE, LEAST, SCORE, STABLE, Interval, gain, log_ratios, numbers
from notebooks.paper.statements import ATTRIBUTES_ALONE, AXIS, VIEWPOINTS_ALONE, Judgement, effect_table
from splat.model.untrusted import replacing

RESULTS = Path(__file__).parents[1] / "results"
BUDGET = 1.3  # the paper's time of StableGS over that of 3DGS, Sec. 4.3
VIEWPOINTS = {"occlusion": "edge_rotation", "interpolation": "interpolation", "parallax": "parallax"}
ONLY = {  # one way to move a viewpoint, beside the probes of attributes
    name: " ".join([STABLE, *(f"viewpoint.{other}=False" for other in VIEWPOINTS.values() if other != key)])
    for name, key in VIEWPOINTS.items()
}
# the paper's gains over 3DGS on LLFF with three views, dB: Tables 2, 4 and 6
AXES: tuple[tuple[str, str, float | None], ...] = (
    ("all probes", STABLE, 4.73),
    ("all probes, one viewpoint", f"{STABLE} viewpoints=one", None),
    ("attributes", ATTRIBUTES_ALONE, 2.92),
    ("  positions", AXIS.format("means"), 2.46),
    ("  opacities", AXIS.format("opacity_logits"), 1.39),
    ("  rotations", AXIS.format("quats"), None),
    ("  scales", AXIS.format("log_scales"), None),
    ("  colours", AXIS.format("sh"), None),
    ("viewpoints", VIEWPOINTS_ALONE, 2.29),
    ("attributes + occlusion", ONLY["occlusion"], 3.41),
    ("attributes + interpolation", ONLY["interpolation"], 3.16),
    ("attributes + parallax", ONLY["parallax"], 2.97),
)


def make(
    rows: pd.DataFrame, found: Sequence[Judgement], related: pd.DataFrame, out: Path, along: pd.DataFrame | None = None
) -> Iterator[Path]:
    """Draw everything; gives each file when it is there.

    found: the verdicts on the rows; related: what goes with the score; along: records along some of the trainings.
    """
    drawn = {
        "claims": draw_claims(effect_table(found)),
        "predictors": draw_predictors(related),
        "budget": draw_budget(rows),
        "axes": draw_axes(rows),
    }
    if along is not None:
        drawn["index"] = draw_index(along)
    for name, figure in drawn.items():
        for suffix in ("png", "pdf"):
            yield save(figure, out / f"{name}.{suffix}")
    with replacing(out / "captions.md") as partial:
        partial.write_text(captions(rows, found, related, list(drawn)), encoding="utf-8")
    yield out / "captions.md"


def captions(rows: pd.DataFrame, found: Sequence[Judgement], related: pd.DataFrame, drawn: Sequence[str]) -> str:
    """Captions of what was drawn, trainings and verdicts as Markdown, from the numbers."""
    words = {
        "claims": "The first effect of each statement over the paper's, with its 95% interval over seeds.",
        "predictors": _of_predictors(related),
        "budget": _of_budget(rows),
        "axes": _of_axes(rows),
        "index": "The eigenvalue ratio |λmax / λmin| over the steps; line: median, band: all seeds.",
    }
    lines = [f"**{name}.** {caption}" for name, caption in words.items() if name in drawn] + [_trainings(rows)]
    lines += [f"{each.number}. {each.statement} **{each.verdict}.** {each.finding}" for each in found]
    return "\n\n".join(lines) + "\n"


def method_words(method: str) -> str:
    """A method of the study in words; one that runs in its publication's own code is told by the protocol.

    >>> method_words("stablegs vsp_weight=0 probe.attributes=means"), method_words("sam protocol=llff")
    ('stablegs: positions', 'sam (own code)')
    """
    axis = next((name.strip() for name, axis, _ in AXES if axis == method != STABLE), None)
    return f"{STABLE}: {axis}" if axis else method.replace(" protocol=llff", " (own code)")


def draw_budget(rows: pd.DataFrame) -> Figure:
    """A row for each method, the best on top: score and time, a dot for each seed, mean and 95% interval."""
    methods = sorted(_methods(rows), key=lambda method: Interval.of(numbers(rows, SCORE, method)).value)
    with style():
        figure = new_figure(0.9 + 0.17 * len(methods), 6.8)
        left, right = figure.subplots(1, 2, sharey=True)
        right.set_xscale("log")
        right.axvline(BUDGET, color=UNDETERMINED, linewidth=0.8, linestyle="--")
        for place, method in enumerate(methods):
            time, score = _time(rows, method), numbers(rows, SCORE, method)
            colour = VERMILION if method.startswith(STABLE) else BLUE
            means = Interval.of(score), Interval.of(list(np.log(time))).exp()
            for axes, seeds, mean in zip((left, right), (score, time), means, strict=True):
                axes.plot(seeds, [place] * len(seeds), ".", color=colour, markersize=3, alpha=0.5)
                axes.plot(mean.value, place, "o", color=colour, markersize=3.5)
                if mean.n >= LEAST:  # two seeds bound next to nothing
                    axes.hlines(place, mean.low, mean.high, color=colour, linewidth=1)
        right.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        right.xaxis.set_major_formatter("{x:g}")
        right.xaxis.set_minor_formatter(NullFormatter())
        left.set_yticks(range(len(methods)), [literal(method_words(method)) for method in methods])
        left.set_xlabel("PSNR on held-out views (dB)\nsmall dots: seeds; lines: 95% intervals of the means")
        right.set_xlabel(f"processor time over that of 3DGS (×)\ndashed: {BUDGET}, the paper's StableGS")
        left.set_title(_of_budget(rows, short=True), loc="left")
        for axes in (left, right):
            axes.grid(True, axis="x")
    return figure


def draw_axes(rows: pd.DataFrame) -> Figure:
    """A row for each axis: the gain over 3DGS with its interval, and the paper's."""
    with style():
        figure = new_figure(0.6 + 0.17 * len(AXES), 4.6)
        axes = figure.add_subplot()
        for place, (_, method, claimed) in zip(range(len(AXES))[::-1], AXES):
            found = gain(rows, method)
            if found.n >= 2:
                axes.hlines(place, found.low, found.high, color=BLUE, linewidth=1.2)
            if found.n:
                axes.plot(found.value, place, "o", color=BLUE, markersize=3.5)
            if found.n < 2:
                axes.annotate(
                    "one seed" if found.n else "not run",
                    (found.value if found.n else 0, place),
                    xytext=(4, 0),
                    textcoords="offset points",
                    va="center",
                    color=UNDETERMINED,
                )
            if claimed is not None:
                axes.plot(claimed, place, "D", color=VERMILION, markersize=3.5, markerfacecolor="white")
        axes.axvline(0, color="0.5", linewidth=0.6)
        axes.set_yticks(range(len(AXES))[::-1], [name for name, *_ in AXES])
        axes.set_xlabel("PSNR over 3DGS (dB); diamond: the paper")
        axes.grid(True, axis="x")
    return figure


def draw_index(along: pd.DataFrame) -> Figure:
    """The median of each method's seeds, and the band from the least to the largest."""
    known = along.dropna(subset="eigenvalue_ratio").assign(eigenvalue_ratio=along["eigenvalue_ratio"].abs())
    methods = known["run"].astype(str).str.split("/").str[0]
    with style():
        figure = new_figure(2.6)
        axes = figure.add_subplot()
        axes.set_yscale("log")
        for method, colour in zip(dict.fromkeys(methods), RUNS):
            band = known[methods == method].groupby("step")["eigenvalue_ratio"].agg(["min", "median", "max"])
            axes.fill_between(band.index, band["min"], band["max"], color=colour, alpha=0.25, linewidth=0)
            axes.plot(band.index, band["median"], "-o", color=colour, markersize=2, label=literal(method))
        axes.set(xlabel="step", ylabel="|λmax / λmin|")
        axes.grid(True)
        axes.legend()
    return figure


def _methods(rows: pd.DataFrame) -> list[str]:
    return [method for method in dict.fromkeys(rows["method"]) if len(_time(rows, method))]


def _time(rows: pd.DataFrame, method: str) -> pd.Series:
    """Processor time over that of 3DGS with the same seed."""
    return pd.Series(np.exp(log_ratios(rows, "cpu_seconds", method)))


def _of_predictors(related: pd.DataFrame) -> str:
    found = []
    for kind, words in {"all": "over all runs", "given": GIVEN, "within": "among the seeds of a method"}.items():
        decided = pd.DataFrame(related[(related["kind"] == kind) & (related["holm"] < SIGNIFICANT)])
        best = sorted(decided.to_dict("records"), key=lambda row: -abs(row["tau"]))[:3]
        named = [
            f"{words_of(row['quantity'])} ({row['tau']:+.2f}, {row['low']:+.2f} to {row['high']:+.2f})" for row in best
        ]
        tried = list(related["kind"]).count(kind)
        found.append(f"{words}: {', '.join(named) or 'none'} of {tried}")
    return f"Goes with PSNR on held-out views after Holm's correction, {'; '.join(found)}. Correlation is not cause."


def _of_budget(rows: pd.DataFrame, short: bool = False) -> str:
    """Caption of the budget.  short: best method and StableGS alone, without intervals."""
    scores = {method: Interval.of(numbers(rows, SCORE, method)) for method in _methods(rows)}
    if BASE not in scores:
        return "3DGS was not run."
    best = max(scores, key=lambda method: (scores[method].n >= LEAST, scores[method].value))
    times = {name: Interval.of(list(np.log(_time(rows, name)))).exp() for name in (best, STABLE) if name in scores}
    if short:
        over = {name: gain(rows, name).value for name in times}
        return "; ".join(
            f"{method_words(name)} {over[name]:+.1f} dB in {time.value:.2g} × the time" for name, time in times.items()
        )
    words = [f"{name} {scores[name].text(' dB')} in {time.text(' times')} its time" for name, time in times.items()]
    return f"3DGS scores {scores[BASE].text(' dB')}; {'; '.join(words)}."


def _of_axes(rows: pd.DataFrame) -> str:
    known = {name.strip(): gain(rows, method) for name, method, _ in AXES}
    missing = [name for name, found in known.items() if not found.n]
    words = [f"{name} {found.text(' dB')}" for name, found in known.items() if found.n]
    return "; ".join(words or ["no axis was run"]) + (f". Not run: {', '.join(missing)}." if missing else ".")


def _trainings(rows: pd.DataFrame) -> str:
    """What was trained, where and when."""
    names = [name for name in ("scene", "views", "steps", "size", "machine", "commit", "date") if name in rows]
    values = {name: ", ".join(dict.fromkeys(rows[name].dropna().astype(str))) for name in names}
    return f"{len(rows)} trainings. " + " ".join(f"{name.capitalize()}: {value}." for name, value in values.items())
