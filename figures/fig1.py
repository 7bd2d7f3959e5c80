"""Figure after the paper's Fig. 1: two landscapes side by side, and what the two scenes look like from a view held out.

`python -m figures.fig1 RUN_3DGS RUN_STABLEGS --out fig1.png`.  A column a run: the loss around the checkpoint along the two
steepest eigenvectors, as a surface, as contours, and its sections through the centre (e_1; dashed: e_2); below, the first
view that both have rendered.  Both share their axes (`figures.manifold`).
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.lines import Line2D

from figures.fig7 import command_line, names_of, read_all
from figures.manifold import Scale, contours, landscape_of, require_same_function, section, surface
from figures.style import BLACK, RUNS, literal, new_figure, style
from landscape.errors import InputError

RENDERS = "test"
WIDTH = 4.8  # inches


def draw(runs: Sequence[Path]) -> Figure:
    """Fig. 1 of two runs.  ValueError names every record that is missing, each with the command that makes it."""
    names = names_of(runs)
    found = read_all(*(partial(landscape_of, run) for run in runs), *(partial(_views, run) for run in runs))
    landscapes = found[:2]
    require_same_function(runs)
    if not (common := found[2] & found[3]):
        raise InputError(
            f"expected a view that both {runs[0]} and {runs[1]} have rendered, found none; train on one scene"
        )
    view = min(common)
    scale = Scale.of(*landscapes)
    with style():
        figure = new_figure(7.4)
        figure.set_figwidth(WIDTH)
        maps = [figure.add_subplot(4, 2, 3 + i) for i in range(len(runs))]
        for i, (run, name, landscape) in enumerate(zip(runs, names, landscapes, strict=True)):
            surface(figure, (4, 2, 1 + i), landscape, scale, name)
            filled = contours(maps[i], landscape, scale)
            across = figure.add_subplot(4, 2, 5 + i)
            section(across, landscape, scale, 0, color=RUNS[i])
            section(across, landscape, scale, 1, color=RUNS[i], linestyle="--")
            across.set(
                xlabel=scale.flat_label("e₁, e₂"), ylim=[end / 10.0**scale.loss for end in (scale.low, scale.high)]
            )
            picture = figure.add_subplot(4, 2, 7 + i)
            picture.imshow(imread(run / RENDERS / view))
            picture.axis("off")
            picture.set_title(literal(view))
            if i == 0:
                across.set_ylabel(scale.loss_label)
            else:
                figure.colorbar(filled, ax=maps, label=scale.loss_label, shrink=0.9)
        handles = [Line2D([], [], color=BLACK, label="along e₁")]
        handles.append(Line2D([], [], color=BLACK, linestyle="--", label="along e₂"))
        figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def _views(run: Path) -> set[str]:
    """The file names of the held-out views that a run has rendered."""
    if not (views := {path.name for path in (run / RENDERS).glob("*.png")}):
        raise FileNotFoundError(
            f"expected renders of held-out views in {run / RENDERS}, found none; run landscape train to its end, with "
            "fewer --views than the scene has"
        )
    return views


def main() -> None:
    """`python -m figures.fig1 RUN_3DGS RUN_STABLEGS`"""
    command_line(draw, "fig1")


if __name__ == "__main__":
    main()
