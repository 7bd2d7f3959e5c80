"""Figure after the paper's Fig. 1: two landscapes side by side, and what the two scenes look like from a view held out.

`python -m figures.fig1 RUN_3DGS RUN_STABLEGS --out fig1.png`.  A column a run: the loss around the checkpoint
along the two steepest eigenvectors, as a surface, as contours, and its sections through the centre (e_1, e_2), under its step,
the largest eigenvalue, how many times that of the first run it is, and whether renders confirm it (by the probe, if there is
one); below, of the first view that both have rendered, the third of each side in which the renders differ most: the photograph,
and both renders, with the view's PSNR and the error in this part.  Both share their axes (`manifold`).
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.lines import Line2D
from scipy.ndimage import uniform_filter

from analysis.console.failures import program
from analysis.records.quantities import rough
from analysis.records.run_files import METRICS, read_scores
from figures import manifold
from figures.fig7 import names_of, read_all
from figures.plane import Plane
from figures.style import BLUE, VERMILION, literal, new_figure, style
from landscape.errors import InputError

RENDERS, PANELS = "test", "panels"
WIDTH = 4.8  # inches
ALONG = {"e₁": VERMILION, "e₂": BLUE}


def draw(runs: Sequence[Path]) -> Figure:
    """Fig. 1 of two runs.  ValueError names every record that is missing, each with the command that makes it."""
    names = names_of(runs)
    found = read_all(*(partial(manifold.landscape_of, run) for run in runs), *(partial(_views, run) for run in runs))
    landscapes = found[:2]
    manifold.require_same_function(runs)
    if not (common := found[2] & found[3]):
        raise InputError(
            f"expected a view that both {runs[0]} and {runs[1]} have rendered, found none; train on one scene"
        )
    view = min(common)
    scale = manifold.Scale.of(*landscapes)
    sections = scale.of_sections(*landscapes)
    with style():
        figure = new_figure(7.4, WIDTH)
        above, below = figure.subfigures(2, 1, height_ratios=[3.6, 1], squeeze=False)[:, 0]
        maps = [above.add_subplot(3, 2, 3 + i) for i in range(len(runs))]
        path, renders = runs[0] / RENDERS / PANELS / view, [imread(run / RENDERS / view) for run in runs]
        # the left of the panel that a training wrote beside the render, where it is there
        photograph = imread(path)[:, : renders[0].shape[1]] if path.is_file() else None
        part = most_different(*renders)
        pictures = below.subplots(1, len(runs) + (photograph is not None), squeeze=False)[0]
        for axes in pictures:
            axes.axis("off")
        if photograph is not None:
            pictures[0].imshow(photograph[part])
            pictures[0].set_title(f"part of {literal(view)}\n(held out)")
        for i, (run, name, landscape) in enumerate(zip(runs, names, landscapes, strict=True)):
            manifold.surface(above, (3, 2, 1 + i), landscape, scale, _heading(i, runs, names, landscapes))
            filled = manifold.contours(maps[i], landscape, scale)
            across = above.add_subplot(3, 2, 5 + i)
            for axis, colour in enumerate(ALONG.values()):
                manifold.section(across, landscape, sections, axis, color=colour)
            across.set_xlabel(scale.flat_label("e₁, e₂"))
            picture = pictures[i - len(runs)]
            picture.imshow(renders[i][part])
            error = ""
            if photograph is not None:
                error = f"; here ±{rough(float(np.abs((renders[i] - photograph)[part]).mean()))}"
            picture.set_title(f"{literal(name)}\n{_score(run, view)}{error}")
            if i == 0:
                across.set_ylabel(sections.loss_label)
            else:
                ticks = list(np.asarray(filled.levels)[1::2])
                above.colorbar(filled, ax=maps, label=scale.loss_label, shrink=0.9, ticks=ticks)
        handles = [Line2D([], [], color=colour, label=f"along {name}") for name, colour in ALONG.items()]
        handles.append(Line2D([], [], linestyle="none", label="one training each"))
        figure.set_label(_caption(names, landscapes))
        above.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def most_different(first: np.ndarray, second: np.ndarray) -> tuple[slice, slice]:
    """The part of two renders (h, w, 3), a third of each side, in which they differ most.

    >>> change = np.zeros((9, 9, 3))
    >>> change[8, 4] = 1
    >>> most_different(change, np.zeros((9, 9, 3)))
    (slice(6, 9, None), slice(2, 5, None))
    """
    change = np.abs(first - second).sum(axis=2)
    size = [max(side // 3, 1) for side in change.shape]
    inner = tuple(slice(part // 2, part // 2 + side - part + 1) for side, part in zip(change.shape, size, strict=True))
    means = uniform_filter(change, size)[inner]  # pyright: ignore[reportArgumentType]
    top, left = map(int, np.unravel_index(int(means.argmax()), means.shape))
    return slice(top, top + size[0]), slice(left, left + size[1])


def _heading(i: int, runs: Sequence[Path], names: Sequence[str], landscapes: Sequence[Plane]) -> str:
    """The run's step and largest eigenvalue, how many times that of the first run it is, and whether renders doubt it."""
    value, reference = landscapes[i].x.curvature, landscapes[0].x.curvature
    step, doubt = manifold.record_of(runs[i]).data.provenance.iteration, manifold.doubt_of(runs[i])
    words = names[i] + (f", step {step:,}" if step else "") + f": λ max {rough(value)}"
    if i and value and reference and np.isfinite([value, reference]).all():
        words += f"\n{rough(value / reference)} times that of {names[0]}"
    return words + f"\n{doubt}" * bool(doubt)


def _caption(names: Sequence[str], landscapes: Sequence[Plane]) -> str:
    """What the figure shows, also where it is the opposite of the paper's."""
    first, second = (each.x.curvature for each in landscapes)
    way = "flatter" if second < first else "steeper"
    return (
        f"The loss around the last checkpoints of {names[0]} and {names[1]} along their two steepest directions, in the window "
        f"that both slices reach: {names[1]} is the {way} one (largest eigenvalue {rough(second)}, {names[0]} {rough(first)}), "
        "where the paper has StableGS flatter. One training each, which decides no difference."
    )


def _score(run: Path, view: str) -> str:
    """PSNR of the render of a held-out view, or of all, as far as the run's scores have it."""
    scores = read_scores(run) if (run / METRICS).is_file() else None
    if scores is None or scores.test is None:
        return "not scored"
    if (own := scores.test.views.get(view)) is not None and own.psnr is not None:
        return f"{own.psnr:.2f} dB"
    return "not scored" if scores.test.psnr is None else f"{scores.test.psnr:.2f} dB, mean of all views"


def _views(run: Path) -> set[str]:
    """The file names of the held-out views that a run has rendered."""
    if not (views := {path.name for path in (run / RENDERS).glob("*.png")}):
        raise FileNotFoundError(
            f"expected renders of held-out views in {run / RENDERS}, found none; run landscape train to its end, with "
            "fewer --views than the scene has"
        )
    return views


if __name__ == "__main__":
    program(partial(manifold.runs_script, draw, "fig1"))
