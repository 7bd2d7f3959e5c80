"""Figures of the study, and their captions.

OUT/claims, predictors      the effects behind the verdicts, and what goes with the score (`notebooks.paper.effect_figures`)
OUT/budget                  after Fig. 8: PSNR on held-out views against the time of a training
OUT/axes                    after Tables 2 and 4: what the axes of StableGS's probes gain, alone and together
OUT/index                   after Fig. 7: the anisotropy index over the steps, with the band of the seeds
OUT/captions.md             a caption for each, and the ten verdicts, written from the numbers

Each figure as PNG and PDF.  A cell of the study that was not run is named where its number would be.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from figures.style import BLUE, RUNS, UNDETERMINED, VERMILION, literal, new_figure, save, style
from notebooks.paper.effect_figures import GIVEN, SIGNIFICANT, draw_claims, draw_predictors, words_of
from notebooks.paper.effects import BASE, LEAST, SCORE, STABLE, Interval, gain, log_ratios, numbers
from notebooks.paper.statements import ATTRIBUTES_ALONE, AXIS, VIEWPOINTS_ALONE, Judgement, effect_table
from splat.model.untrusted import replacing

RESULTS = Path(__file__).parents[1] / "results"
LETTER, ROW = 4.4, 8.5  # points: as wide as a letter of a name on the average, and as high
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
        "claims": "Effects with their 95% intervals over seeds; diamond: the paper's size.",
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
    """A dot for each seed, a cross of 95% intervals for each method."""
    with style():
        figure = new_figure(3.6, 6.8)
        axes = figure.add_subplot()
        axes.set_xscale("log")
        axes.axvline(BUDGET, color=UNDETERMINED, linewidth=0.8, linestyle="--")
        places, lines = [], []
        for method in _methods(rows):
            time, score = _time(rows, method), numbers(rows, SCORE, method)
            colour = VERMILION if method.startswith(STABLE) else BLUE
            axes.plot(time.reindex(score.index), score, ".", color=colour, markersize=3, alpha=0.5)
            x, y = Interval.of(list(np.log(time))).exp(), Interval.of(score)
            if y.n >= LEAST:  # two seeds bound next to nothing
                low, high = max(x.low, x.value / 10), min(x.high, 10 * x.value)
                axes.hlines(y.value, low, high, color=colour, linewidth=1)
                axes.vlines(x.value, y.low, y.high, color=colour, linewidth=1)
                lines += [(low, y.value, high, y.value), (x.value, y.low, x.value, y.high)]
            places.append((x.value, y.value, method, colour))
        axes.margins(x=0.12)
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set(ylabel="PSNR on held-out views (dB)")
        axes.set_xlabel(
            f"processor time over that of 3DGS (×); dashed: {BUDGET}, the paper's StableGS\n"
            "dots: seeds; crosses: 95% intervals of both means"
        )
        axes.set_title(_of_budget(rows, short=True), loc="left")
        axes.grid(True)
        _label(axes, places, lines)
    return figure


def _label(
    axes: Axes, places: list[tuple[float, float, str, str]], lines: list[tuple[float, float, float, float]]
) -> None:
    """Write each name at its point or as near as others leave room, with a line to the point where it is not beside it.

    places: x, y, name, colour; lines: ends x, y, x, y of what they keep clear of.  A letter is half as wide as high.
    """
    width, height = (72 * size for size in (6.8 * 0.88, 3.6 * 0.8))  # of the axes, points
    (left, right), (low, high) = np.log(axes.get_xlim()), axes.get_ylim()

    def place(x: float, y: float) -> tuple[float, float]:
        return float(width * (np.log(x) - left) / (right - left)), height * (y - low) / (high - low)

    points = [place(x, y) for x, y, *_ in places]
    taken: list[tuple[float, ...]] = [(x - 3, y - 3, x + 3, y + 3) for x, y in points]
    taken += [(*place(x0, y0), *(end + 1 for end in place(x1, y1))) for x0, y0, x1, y1 in lines]
    for (px, py), (x, y, name, colour) in zip(points, places, strict=True):
        words = method_words(name)
        size = len(words) * LETTER
        options = [
            (dx if side > 0 else -dx - size, dy)
            for away in range(12)
            for dy in (away * ROW, -away * ROW)
            for dx in (5 + 4 * away,)
            for side in (1, -1)
        ]

        def box(at: tuple[float, float], px=px, py=py, size=size) -> tuple[float, float, float, float]:
            return px + at[0], py + at[1] - ROW / 2, px + at[0] + size, py + at[1] + ROW / 2

        free = [at for at in options if _is_free(box(at), taken, width, height)]
        dx, dy = free[0] if free else options[0]
        taken.append(box((dx, dy)))
        line = {"arrowstyle": "-", "color": "0.75", "linewidth": 0.4, "shrinkA": 1, "shrinkB": 2}
        axes.annotate(
            literal(words), (x, y), xytext=(dx if dx > 0 else dx + size, dy), textcoords="offset points", va="center",
            ha="left" if dx > 0 else "right", color=colour, arrowprops=line if dy else None,
        )  # fmt: skip


def _is_free(box: Sequence[float], taken: Sequence[Sequence[float]], width: float, height: float) -> bool:
    x0, y0, x1, y1 = box
    inside = x0 >= 0 and x1 <= width and y0 >= 0 and y1 <= height
    return inside and not any(x0 < b[2] and b[0] < x1 and y0 < b[3] and b[1] < y1 for b in taken)


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
    known = pd.DataFrame(along[along["eigenvalue_ratio"].notna()])
    methods = known["run"].astype(str).str.split("/").str[0]
    with style():
        figure = new_figure(2.6)
        axes = figure.add_subplot()
        axes.set_yscale("log")
        for method, colour in zip(dict.fromkeys(methods), RUNS):
            part = pd.DataFrame(known[methods == method])
            steps = sorted(set(part["step"]))
            values = [np.abs(part.loc[part["step"] == step, "eigenvalue_ratio"].to_numpy(float)) for step in steps]
            low, middle, high = ([float(of(each)) for each in values] for of in (np.min, np.median, np.max))
            axes.fill_between(steps, low, high, color=colour, alpha=0.25, linewidth=0)
            axes.plot(steps, middle, "-o", color=colour, markersize=2, label=literal(method))
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
