"""What each switch of notebooks/prediction.toml changes at the end of a training: prediction.csv as a designed experiment.

effect      of a switch s on a quantity in a scene: 2 b_s of the least squares y = a + sum_s b_s x_s over the scene's trainings,
            x_s = 1 where the switch is on, -1 where it is off.  In a whole fraction it is the mean with the switch on less that
            with it off, as no switch is mixed up with another.  y: dB, or the logarithm of a number: the effect is a ratio
value       the mean over the scenes, with Student's interval of 95% over them

Left out: trainings whose PSNR on the training views ends below COLLAPSED, and measures that fewer than LEAST trainings of a
scene have (`notebooks.prediction.answers`).
"""

import textwrap
from collections.abc import Iterator

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from figures.style import UNDETERMINED, few_decades, new_figure, style
from notebooks.prediction.answers import COLLAPSED, COLOURS, CONTROLS, FEWEST_SCENES, LEAST, MEASURES, SCORE, name_of
from notebooks.statistics import Interval

SWITCHES = {
    "a": "threshold of densification 4 times as high",
    "b": "colours of degree 3",
    "c": "a fifth of the Gaussians dropped",
    "d": "attribute probes of StableGS",
    "e": "opacity regulariser",
    "f": "densification from step 500, not 150",
    "g": "dense start",
}
QUANTITIES = (SCORE, *CONTROLS, *MEASURES)
COLUMNS = ("quantity", "switch", "unit", "value", "low", "high", "scenes", "trainings")
TALL, WIDE = 1.35, 4  # inches of a panel; panels in a row
WRAP = 125  # characters
MARGIN = 0.3  # dB beyond the means; longer intervals end at the edge


def switch_effects(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each quantity and switch with the columns COLUMNS; unit "dB" or "×".  rows: of prediction.csv."""
    ends = rows[(rows["at"] == "end") & (rows["psnr_train"] >= COLLAPSED)]
    return pd.DataFrame(_lines(pd.DataFrame(ends)), columns=list(COLUMNS))


def _lines(ends: pd.DataFrame) -> Iterator[dict]:
    for name in QUANTITIES:
        ratio = not name.startswith("psnr")
        known = ends.dropna(subset=[name])
        scenes = [pd.DataFrame(part) for _, part in known.groupby("scene") if len(part) >= LEAST]
        found = np.array([effects_in_scene(part, name, ratio) for part in scenes]).reshape(-1, len(SWITCHES))
        for switch, values in zip(SWITCHES, found.T, strict=True):
            mean = Interval.of(list(values))
            mean = mean.exp() if ratio else mean
            yield {"quantity": name, "switch": switch, "unit": "×" if ratio else "dB", "value": mean.value, "low": mean.low,
                   "high": mean.high, "scenes": mean.n, "trainings": sum(map(len, scenes))}  # fmt: skip


def effects_in_scene(part: pd.DataFrame, name: str, ratio: bool) -> np.ndarray:
    """The effect of each of SWITCHES in one scene; of a ratio its logarithm."""
    y = part[name].to_numpy(float)
    on = np.array([[switch in cell for switch in SWITCHES] for cell in part["cell"]])
    X = np.hstack([np.ones((len(part), 1)), np.where(on, 1, -1)])
    return 2 * np.linalg.lstsq(X, np.log(y) if ratio else y, rcond=None)[0][1:]


def draw_switches(table: pd.DataFrame) -> Figure:
    """A panel for each measure, a letter for each switch: what it does to the measure, and to PSNR on the views held out."""
    enough = {*table.loc[table["scenes"] >= FEWEST_SCENES, "quantity"]}
    names = [name for name in MEASURES if name in enough]
    gained = pd.DataFrame(table[table["quantity"] == SCORE]).set_index("switch")
    with style():
        rows = -(-len(names) // WIDE)
        figure = new_figure(0.5 + TALL * rows, 6.8)
        panels = figure.subplots(rows, WIDE, sharey=True, squeeze=False)
        for axes, name in zip(panels.flat, names):
            axes.set_xscale("log")
            axes.axhline(0, color="0.6", linewidth=0.6)
            axes.axvline(1, color="0.6", linewidth=0.6)
            colour = COLOURS.get(str(name), UNDETERMINED)
            for line in pd.DataFrame(table[table["quantity"] == name]).to_dict("records"):
                score = gained.loc[line["switch"]]
                axes.hlines(score["value"], line["low"], line["high"], color=colour, linewidth=0.8)
                axes.vlines(line["value"], score["low"], score["high"], color=colour, linewidth=0.8)
                axes.plot(line["value"], score["value"], "o", color=colour, markersize=2.5)
                axes.annotate(
                    line["switch"], (line["value"], score["value"]), xytext=(2, 2), textcoords="offset points"
                )
            axes.set_title(name_of(name), loc="left")
            axes.grid(True)
            few_decades(axes.xaxis)
        panels[0, 0].set_ylim(gained["value"].min() - MARGIN, gained["value"].max() + MARGIN)
        for axes in panels.flat[len(names) :]:
            axes.set_axis_off()
        figure.supylabel("PSNR on views held out, gained (dB)", fontsize=7)
        words = textwrap.fill("; ".join(f"{switch}: {what}" for switch, what in SWITCHES.items()), WRAP)
        figure.supxlabel(f"the measure with the switch on over that with it off (×)\n{words}", fontsize=6.5)
    return figure
