"""The paper's ten statements, each judged by the effects that decide it (`notebooks.paper.effects`).

Claimed sizes are the paper's, at 10,000 steps.  Of several effects the first decides, unless a docstring says otherwise.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from analysis.records.findings import ATTRIBUTES, attribute_name
from analysis.records.schema import INDICES
from notebooks.paper.effects import (
    BASE,
    LEAST,
    SCORE,
    STABLE,
    STRETCHED,
    UNTESTED,
    Effect,
    Interval,
    Verdict,
    decide,
    gain,
    gains,
    log_ratios,
    numbers,
    ratio_effect,
)  # fmt: skip

RIVAL = "dropgaussian"
ATTRIBUTES_ALONE, VIEWPOINTS_ALONE = "stablegs vsp_weight=0", "stablegs asp_weight=0"
AXIS = ATTRIBUTES_ALONE + " probe.attributes={}"
CLAIMED_TIME, TIME = 1.3, 1.45  # the paper's, and the largest ratio of times that agrees with it
CLAIMED_VIEWS = 3  # training views of the claimed gains in dB
SUFFICIENT = 0.1  # relative standard error of a trace, and so 5% of its square root rho


@dataclass(frozen=True)
class Judgement:
    """The verdict on a statement.  source: its place in the paper.  finding: the measured effects in a sentence."""

    number: int
    statement: str
    source: str
    verdict: Verdict
    finding: str
    effects: tuple[Effect, ...] = ()


def anisotropy(rows: pd.DataFrame) -> Judgement:
    effects = []
    for name in INDICES:
        sign = -1 if name in ("negative_ratio", "participation_ratio") else 1  # the larger, the less anisotropic
        effects.append(ratio_effect(name.replace("_", " "), sign * log_ratios(rows, name), 0.26))
    against = [each.name for each in effects if decide(each) == "does not hold" or each.interval.low > 1]
    verdict = decide(effects[0])
    if verdict == "holds" and against:
        verdict = "holds in part"
    finding = f"StableGS multiplies the eigenvalue ratio by {effects[0].interval.text()}; 74% less would be 0.26."
    if against:
        finding += f" Not lowered, or by far less: {', '.join(against)}."
    return Judgement(
        1, "Geometric probes cut the anisotropy index by 74%.", "Fig. 7, Sec. 4.2", verdict, finding, tuple(effects)
    )


def depth(rows: pd.DataFrame) -> Judgement:
    ratios = pd.Series(np.log(numbers(rows, "depth_gradient")))
    effect = ratio_effect("depth / lateral gradient", ratios, 100.0)
    finding = f"Along the rays the positions' gradient is {effect.interval.text()} times that across them, over all trainings."
    statement = "The gradient along the depth is typically 100 times the lateral one."
    return Judgement(2, statement, "Sec. 3.2", decide(effect), finding, (effect,))


def needles(rows: pd.DataFrame) -> Judgement:
    """Decided by the curvature of both attributes; without a map, by the steepest eigenvector of the whole Hessian."""
    number = Interval.of(numbers(rows, "needle_count", BASE))
    null = number.value if number.n else 0.0
    blocks = {f"share of the curvature of {attribute_name(name)} on needles": f"needles_{name}" for name in STRETCHED}
    columns = {words: name for words, name in blocks.items() if len(numbers(rows, name, BASE))}
    columns["share of the steepest eigenvector on needles"] = "needles"
    effects = tuple(Effect(words, Interval.of(numbers(rows, name, BASE)), null, 0.5) for words, name in columns.items())
    verdicts: list[Verdict] = [decide(effect) for effect in effects]
    verdicts = verdicts[: len(STRETCHED) if len(effects) > len(STRETCHED) else 1]
    verdict: Verdict = verdicts[0] if len(set(verdicts)) == 1 else "holds in part"
    if UNTESTED in verdicts:
        verdict = UNTESTED
    words = "; ".join(f"{effect.name}: {effect.interval.text()}" for effect in effects)
    finding = f"Needles, Gaussians with a condition number above 100, are {number.text()} of those in sight; {words}. "
    finding += "More than half counts as dominant."
    return Judgement(
        3, "Gaussians with a condition number above 100 dominate the high curvature of rotation and scale.", "Sec. 3.2",
        verdict, finding, effects,
    )  # fmt: skip


def position(rows: pd.DataFrame) -> Judgement:
    axes = {name: gains(rows, AXIS.format(name)) for name in ATTRIBUTES}
    whole = gains(rows, ATTRIBUTES_ALONE)
    surplus = Interval.of((axes["means"] - whole / 2).dropna())
    share = Effect("gain of positions alone - half of all attributes'", surplus, 0.0, None, "dB")
    alone = Effect("gain of positions alone", gain(rows, AXIS.format("means")), 0.0, 2.46, "dB")
    verdict = decide(alone) if alone.interval.n < LEAST or decide(alone) == "does not hold" else decide(share)
    known = {name: gain(rows, AXIS.format(name)) for name, found in axes.items() if len(found)}
    finding = f"Probing positions alone gains {alone.interval.text(' dB')}, "
    finding += f"all attributes {gain(rows, ATTRIBUTES_ALONE).text(' dB')}."
    if len(known) > 1:
        best = max(known, key=lambda name: known[name].value)
        finding += f" The largest gain of one attribute is that of {attribute_name(best)}."
    return Judgement(
        4, "Position is the dominant axis: probing it alone recovers 84% of the gain of all attributes.", "Table 2", verdict,
        finding, (alone, share),
    )  # fmt: skip


def opacity(rows: pd.DataFrame) -> Judgement:
    effect = Effect("rank correlation", Interval.of(numbers(rows, "opacity_one_view")), 0.0, None)
    finding = (
        f"Rank correlation of a Gaussian's curvature in opacity with the share of its weight that one view alone sees: "
        f"{effect.interval.text()}."
    )
    statement = "High curvature in opacity goes with view-specific opacities."
    return Judgement(5, statement, "Sec. 3.2", decide(effect), finding, (effect,))


def samples(rows: pd.DataFrame) -> Judgement:
    """Holds where the upper bound of every trace's error is at most SUFFICIENT, not where a lower bound exceeds it."""

    def errors(word: str, column: str) -> list[Effect]:
        found = {each: column.format(each) for each in ATTRIBUTES if column.format(each) in rows}
        means = {each: Interval.of(pd.Series(np.log(numbers(rows, name)))).exp() for each, name in found.items()}
        words = "{}, {} relative error of the trace"
        return [Effect(words.format(attribute_name(each), word), mean, SUFFICIENT, 0.0) for each, mean in means.items()]

    least, most = errors("least", "hutchinson_{}"), errors("largest", "hutchinson_{}_most")
    enough = len(most) == len(ATTRIBUTES) and all(effect.interval.n >= LEAST for effect in least + most)
    verdict: Verdict = "undecided" if enough else UNTESTED
    if enough and all(effect.interval.high <= SUFFICIENT for effect in most):
        verdict = "holds"
    if any(effect.interval.n >= LEAST and effect.interval.low > SUFFICIENT for effect in least):
        verdict = "does not hold"
    finding = "No run has the anisotropy of its attributes; probe with --per-attribute."
    if least:
        bounds = [max(part, key=lambda effect: effect.interval.value) for part in (least, most) if part]
        finding = "With ten Gaussian samples the relative standard error of the trace is at least " + ", at most ".join(
            f"{bound.interval.text()} ({bound.name.split(',')[0]})" for bound in bounds
        )
        finding += f"; {SUFFICIENT:.0%} counts as sufficient."
    effects = sorted(most, key=lambda effect: -effect.interval.value) + least  # the largest bound first
    effects = effects or [Effect("largest relative error of a trace", Interval.of([]), SUFFICIENT, 0.0)]
    return Judgement(6, "Ten random probes suffice for the traces.", "Eq. (6)", verdict, finding, tuple(effects))


def basin(rows: pd.DataFrame) -> Judgement:
    steep, second = (-log_ratios(rows, name) for name in ("lambda_max", "lambda_second"))
    flat = ratio_effect("largest eigenvalue, 3DGS / StableGS", steep, None)
    round_ = ratio_effect("λ1 / λ2, 3DGS / StableGS", (steep - second).dropna(), None)
    verdict, other = decide(flat), decide(round_)
    if verdict != other:
        verdict = "holds in part" if "holds" in (verdict, other) else "does not hold"
    finding = (
        f"The largest eigenvalue of 3DGS is {flat.interval.text()} times that of StableGS, its ratio to the second one "
    )
    finding += f"{round_.interval.text()} times; a flat basin against an elongated valley makes both larger than 1."
    return Judgement(
        7, "The final surface of StableGS is a flat basin, that of 3DGS an elongated valley.", "Fig. 7", verdict, finding,
        (flat, round_),
    )  # fmt: skip


def cost(rows: pd.DataFrame) -> Judgement:
    names = {STABLE: "a viewpoint for each view", f"{STABLE} viewpoints=one": "one viewpoint"}
    effects = [
        ratio_effect(f"time, {words}", log_ratios(rows, "cpu_seconds", name), CLAIMED_TIME)
        for name, words in names.items()
    ]
    every, one = (_within(effect.interval) for effect in effects)
    tested = min(effect.interval.n for effect in effects) >= LEAST
    verdict: Verdict = "holds" if every else "holds in part" if one else "undecided" if tested else UNTESTED
    if every is False and not one:
        verdict = "does not hold"
    size, memory = (
        ratio_effect(f"{what}, StableGS / 3DGS", log_ratios(rows, name), None)
        for what, name in (("Gaussians", "gaussians"), ("peak memory", "peak_memory"))
    )
    finding = (
        f"Processor time over that of 3DGS: {effects[0].interval.text()} with a probed viewpoint for each view, the paper's "
        f"way, {effects[1].interval.text()} with one. Rendering costs by the number of Gaussians: {size.interval.text()}. "
        f"Peak memory: {memory.interval.text()}."
    )
    return Judgement(
        8, "Training takes 1.3 times as long as 3DGS; rendering costs nothing more.", "Sec. 4.3", verdict, finding,
        (*effects, size, memory),
    )  # fmt: skip


def _within(time: Interval) -> bool | None:
    """Whether a ratio of times is at most TIME; None: not decided."""
    return None if time.n < LEAST or time.low <= TIME < time.high else time.high <= TIME


def scores(rows: pd.DataFrame) -> Judgement:
    rows = pd.DataFrame(rows[rows["views"] == CLAIMED_VIEWS])
    claims = (
        (STABLE, "StableGS", 4.73),
        (ATTRIBUTES_ALONE, "probed attributes alone", 2.92),
        (VIEWPOINTS_ALONE, "probed viewpoints alone", 2.29),
    )
    effects = [Effect(f"{words} over 3DGS", gain(rows, name), 0.0, claim, "dB") for name, words, claim in claims]
    base = Interval.of(numbers(rows, SCORE, BASE)).text(" dB")
    finding = f"3DGS scores {base} on held-out views. Gains: " + "; ".join(
        f"{effect.name.removesuffix(' over 3DGS')} {effect.interval.text(' dB')}" for effect in effects
    )
    return Judgement(
        9, "StableGS gains 4.73 dB over 3DGS on LLFF with 3 views; its parts alone 2.92 and 2.29 dB.", "Table 6",
        decide(effects[0]), finding + ".", tuple(effects),
    )  # fmt: skip


def rival(rows: pd.DataFrame) -> Judgement:
    rows = pd.DataFrame(rows[rows["views"] == CLAIMED_VIEWS])
    effect = Effect("StableGS over DropGaussian", gain(rows, STABLE, RIVAL), 0.0, 0.43, "dB")
    return Judgement(
        10, "StableGS is better than DropGaussian by 0.43 dB on LLFF with 3 views.", "Table 1", decide(effect),
        f"StableGS scores {effect.interval.text(' dB')} more than DropGaussian.", (effect,),
    )  # fmt: skip


STATEMENTS: tuple[Callable[[pd.DataFrame], Judgement], ...] = (
    anisotropy, depth, needles, position, opacity, samples, basin, cost, scores, rival,
)  # fmt: skip


def judgements(rows: pd.DataFrame) -> list[Judgement]:
    """All ten, over the rows of a study (`notebooks.paper.study`)."""
    return [statement(rows) for statement in STATEMENTS]


def effect_table(found: Sequence[Judgement]) -> pd.DataFrame:
    """A row for each effect: statement, text, verdict, effect, unit, value, low, high, n, null, claimed."""

    def lines() -> Iterator[dict]:
        for judgement in found:
            for effect in judgement.effects:
                interval = effect.interval
                yield {
                    "statement": judgement.number, "text": judgement.statement,
                    "verdict": judgement.verdict, "effect": effect.name, "unit": effect.unit,
                    "value": interval.value, "low": interval.low, "high": interval.high, "n": interval.n,
                    "null": effect.null, "claimed": effect.claimed,
                }  # fmt: skip

    return pd.DataFrame(lines())
