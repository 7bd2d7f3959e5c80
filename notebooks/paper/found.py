"""The page *What we found*, docs/what-we-found.md, and README's lines about it: every number of theirs is made here.

`python -m notebooks.paper` writes the page to OUT/prediction/what-we-found.md.
"""

import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from figures.style import save
from notebooks.paper.effects import Effect
from notebooks.paper.statements import Judgement
from notebooks.prediction.answers import (
    BARS,
    COLLAPSED,
    ENOUGH,
    LARGE,
    MEASURES,
    SCORE,
    SMALL,
    TIMES,
    answers,
    name_of,
    read_prediction,
    summary,
    write_answers,
)
from notebooks.prediction.shuffled import SHUFFLED, told
from notebooks.prediction.switches import SWITCHES, draw_switches, switch_effects
from notebooks.statistics import digits, interval_text
from splat.model.untrusted import read_table, write_atomically

PLANNED = 576  # trainings
SHOWN = {SCORE: "held out, dB", "psnr_train": "training, dB", "gaussians": "Gaussians", "trace": "trace", "lambda_max": "λ max",
         "eigenvalue_ratio": "λ max / λ min", "critical_sharpness": "critical sharpness"}  # fmt: skip
PAGE = "what-we-found.md"
PROBES, DROPPED, WIDTH = "d", "c", 130

HEAD = """# What we found

`python -m notebooks.paper` writes this page from the tables in `notebooks/results`, whose README says how each is
repeated.  In brackets: intervals of 95%."""

PREDICTS = """## Does the landscape predict the views that were held out?

Not methods are compared here but {ended} trainings of one, in {scenes} scenes with three or eight photographs: 3DGS with
seven switches, in 32 combinations and up to {seeds} seeds, at about 126 x 94 pixels and 2,000 steps.  Each was measured
when its training views first had 30 dB, and at the end; {missing} never had 30 dB.  Kendall's tau is that of a measure and
PSNR on the views held out, given PSNR on the training views and the number of Gaussians: what the measure says beyond these
two.  A measure *predicts* if the interval has no 0, p after Holm's correction is below 0.05, |tau| is {large} or more, and
one sign is found in five of six scenes; it *does not* if the interval lies within ±{small}.  These criteria were fixed
before the first training.  The last two rows have no curvature in them: co-adaptation, how much renders of random halves of
the Gaussians differ, and the difference of trainings that differ in their seed.  They are bars for the others, without a
correction.  *Least agreement*: of pairs of trainings that differ in two switches, the share that the measure orders as its
tau says, for the switches where it is least; 50% is chance.  *R² gained*: in predicting the ranks of a scene from those of
the others.  [The pictures](what_predicts.ipynb)."""

EFFECTS = """## What do the switches do?

Each switch changes one setting, and no switch is mixed up with another: this is what it causes at the end of a training,
the mean over the scenes.  × is the number with the switch on over that with it off."""

STATEMENTS = """## The paper's ten statements

On fern at 168 x 126 pixels, 3,000 steps, from `notebooks/results/study.csv`.  StableGS began its density control earlier
than 3DGS in these trainings, so that a part of each difference between the two may be that.  The measured number is that of
the first effect that decides; the sentence after it has the others.  Why one ratio of two eigenvalues says little:
[what the index measures](what_the_index_measures.ipynb)."""

LIMITS = """## Limits, and what differs from the plan

- {ended} of {planned} trainings; second and third seeds are missing.  The difference of seeds is known of {ensemble} of them.
- {left_out} trainings below {collapsed} dB on their training views are left out, all in {collapsed_scenes}.
- Intervals are the jackknife's over cells and scenes, with Student's t of one degree of freedom less than there are scenes,
  in place of a bootstrap; what they do on shuffled scores is said above.
- No two of the 32 cells differ in one switch alone: the agreement of pairs is that of pairs that differ in two.
- 30 dB is reached by some cells of a scene and not by others, so that fewer trainings answer there; 33 and 36 dB are
  reached in too few scenes.
- Pictures are small and trainings short.  The check at 252 x 189 and at full size has not been run, nor have the trainings
  with viewpoint probes, SAM and FASR on these scenes: of StableGS the attribute probes alone are a switch."""


def make(stored: Path, found: Sequence[Judgement], out: Path) -> Iterator[Path]:
    """Write what a prediction.csv answers, and from ENOUGH trainings on its page; gives each file when it is there."""
    rows = read_prediction(stored)
    enough = sum(rows["at"] == "end") >= ENOUGH
    answered = answers(rows) if enough else pd.DataFrame()
    yield from write_answers(rows, answered, out)
    if enough:
        switched, shuffled = switch_effects(rows), read_table(stored.with_name(SHUFFLED), dtype={"at": str})
        write_atomically(out / "switches.csv", switched.to_csv(index=False, float_format="%.4g").encode())
        yield out / "switches.csv"
        figure = draw_switches(switched)
        yield from (save(figure, out / f"switches.{suffix}") for suffix in ("png", "pdf"))
        write_atomically(out / PAGE, page(rows, answered, switched, shuffled, found).encode())
        yield out / PAGE


def page(
    rows: pd.DataFrame,
    answered: pd.DataFrame,
    switched: pd.DataFrame,
    shuffled: pd.DataFrame,
    found: Sequence[Judgement],
) -> str:
    """The page in Markdown.

    rows: of prediction.csv, with its `answers` and `switch_effects`; shuffled: the table of `notebooks.prediction.shuffled`;
    found: the paper's statements, judged on study.csv.
    """
    counts = _counts(rows)
    parts = [
        HEAD, lines(rows, answered, switched, found), PREDICTS.format(**counts),
        "\n".join(_answered(answered)).rstrip(), _filled(told(shuffled)), EFFECTS, "\n".join(_switched(switched)),
        STATEMENTS, "\n".join(_judged(found)), "\n".join(_filled(each.finding, f"{each.number}. ") for each in found),
        LIMITS.format(**counts),
    ]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def lines(rows: pd.DataFrame, answered: pd.DataFrame, switched: pd.DataFrame, found: Sequence[Judgement]) -> str:
    """What README says, a list in Markdown: the answer, two switches, and the paper's statements."""
    effects = {
        switch: {line["quantity"]: line for line in part.to_dict("records")}
        for switch, part in switched.groupby("switch")
    }
    counts, verdicts = _counts(rows), pd.Series([each.verdict for each in found]).value_counts()
    gain, time, over = (next(each.effects[0] for each in found if each.number == number) for number in (9, 8, 10))

    def changes(switch: str) -> str:
        ratios = {
            name: interval_text(effects[switch][name], "value") for name in ("trace", "lambda_max", "eigenvalue_ratio")
        }
        return (
            f"PSNR on held-out views by {interval_text(effects[switch][SCORE], 'value', '+.2f', ' dB')} there, the trace "
            f"{ratios['trace']} times, the largest eigenvalue {ratios['lambda_max']} times, and the paper's index "
            f"{ratios['eigenvalue_ratio']} times."
        )

    return "\n".join(_filled(line, "- ") for line in (
        f"{counts['ended']} trainings of 3DGS with seven switches in {counts['scenes']} scenes, measures "
        f"of the landscape beyond training PSNR and the number of Gaussians: {summary(answered)}",
        f"StableGS's attribute probes change {changes(PROBES)}",
        f"Dropping a fifth of the Gaussians in each step changes {changes(DROPPED)}",
        f"Whole StableGS gains {_interval(gain)} on fern, in the paper {gain.claimed}; probing a viewpoint for each view it "
        f"took {_interval(time)} the processor time, in the paper {time.claimed}; over DropGaussian it is {_interval(over)}, "
        f"in the paper {over.claimed}.",
        f"Of the paper's ten statements, on fern: {'; '.join(f'{verdict}: {count}' for verdict, count in verdicts.items())}.",
    ))  # fmt: skip


def _counts(rows: pd.DataFrame) -> dict[str, object]:
    ends = pd.DataFrame(rows[rows["at"] == "end"])
    collapsed = ends[ends["psnr_train"] < COLLAPSED]
    missed = (rows["at"] == "30").to_numpy() & ~rows["reached"].to_numpy(bool)
    return {
        "ended": len(ends), "planned": PLANNED, "scenes": len({*rows["scene"]}), "seeds": len({*ends["seed"]}),
        "missing": int(missed.sum()), "large": LARGE, "small": SMALL,
        "left_out": len(collapsed), "collapsed": f"{COLLAPSED:g}", "ensemble": len(ends.dropna(subset="ensemble")),
        "collapsed_scenes": " and ".join(sorted({*collapsed["scene"]})),
    }  # fmt: skip


def _answered(answered: pd.DataFrame) -> Iterator[str]:
    """A table for each of TIMES."""
    for at, when in TIMES.items():
        yield f"| {when} | tau | p, Holm | scenes alike | least agreement | R² gained | answer |"
        yield "| --- |" + " --- |" * 6
        lines = {line["measure"]: line for line in answered.to_dict("records") if line["at"] == at}
        for name in MEASURES:
            cells = ["too few"] + [""] * 5
            if line := lines.get(name):
                gain = "" if np.isnan(line["gain"]) else f"{line['gain']:+.2f}".replace("-", "−")
                cells = [
                    interval_text(line, "tau", ".2f"),
                    "" if name in BARS else digits(line["holm"]),
                    f"{line['alike']} of {line['scenes']}",
                    f"{line['agreement']:.0%}",
                    gain,
                    line["answer"],
                ]
            yield f"| {name_of(name)} | {' | '.join(cells)} |"
        yield ""


def _switched(switched: pd.DataFrame) -> Iterator[str]:
    yield f"| switch | {' | '.join(SHOWN.values())} |"
    yield "| --- |" + " --- |" * len(SHOWN)
    known = {(line["switch"], line["quantity"]): line for line in switched.to_dict("records")}
    for switch, words in SWITCHES.items():
        yield f"| {switch}: {words} | {' | '.join(_effect(known[switch, name], unit=False) for name in SHOWN)} |"


def _judged(found: Sequence[Judgement]) -> Iterator[str]:
    yield "| | the paper says | its number | measured | verdict |"
    yield "| --- | --- | --- | --- | --- |"
    for each in found:
        first = each.effects[0]
        claimed = f"{first.claimed:g} {first.unit}" if first.claimed and first.unit else ""
        yield f"| {each.number} | {each.statement} ({each.source}) | {claimed} | {_interval(first)} | {each.verdict} |"


def _interval(effect: Effect) -> str:
    found = effect.interval
    if found.n < 2:
        return "not measured"
    return _effect({**vars(found), "unit": effect.unit}, after=f"; n = {found.n}")


def _effect(line: dict, unit: bool = True, after: str = "") -> str:
    """An effect with its interval: dB with two places, others with two digits.  after: in the brackets, at their end."""
    words = {"dB": " dB", "×": " times"}.get(line["unit"], "") if unit else " ×" * (line["unit"] == "×")
    return interval_text(line, "value", "+.2f" if line["unit"] == "dB" else "", words, after)


def _filled(words: str, first: str = "") -> str:
    """Lines of at most WIDTH characters."""
    return textwrap.fill(words, WIDTH, initial_indent=first, subsequent_indent=" " * len(first), break_long_words=False)
