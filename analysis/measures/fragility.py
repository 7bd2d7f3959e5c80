"""Fragility of a scene on the three axes of the paper (Sec. 3.2): position, conditioning, opacity.

position      of every Gaussian with another one next in front of it (`Sight.front`): whether a way of a given length along
              its ray, towards the camera, changes their places.  A pixel of way is the length |mean - centre| / f.  The loss
              jumps there: of pairs drawn at random, renders just before and just behind the place
conditioning  condition number of the splats' covariances; needles (above 100) among the steepest in rotation and scale
opacity       Gaussians that essentially one view alone sees (ALONE of their weight), and how much of opacity's curvature,
              the diagonal entry of the Hessian, lies on them
"""

from collections.abc import Sequence
from math import sqrt

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from analysis.measures.depth import gradient_ratio
from analysis.records.quantities import extent, measured, percent, quantity
from analysis.records.run_files import Fragility, Swaps
from landscape.results import Progress, finite_or_none
from splat.curvature.fields import Values
from splat.curvature.objective import SceneObjective
from splat.projection.reference import NEEDLE
from splat.render.sight import Sight

LENGTHS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)  # px
PAIRS = 24  # whose jump is measured
MARGIN = 1e-3  # of the way, before and behind the place of a swap; at least so many units of round-off of the depth:
ROUND_OFFS = 8
ALONE = 0.9
STEEPEST = 0.01  # of the Gaussians in sight
ATTRIBUTES = ("quats", "log_scales")


def fragility(
    objective: SceneObjective, values: Values, sights: Sequence[Sight], generator: torch.Generator, progress: Progress
) -> Fragility:
    """All three.  values, sights: of the objective's fields."""
    condition = values["condition"]
    needles = condition > NEEDLE
    count = max(round(STEEPEST * len(condition)), 1)
    curvatures = {name: values[f"trace_{name}"] for name in ATTRIBUTES}
    alone = values["one_view"] >= ALONE
    return Fragility(
        swaps=swaps(objective, sights, generator, progress),
        needles=share_of(torch.ones_like(condition), needles),
        needles_steepest={
            name: share_of(torch.ones(count), needles[found.topk(count).indices]) for name, found in curvatures.items()
        },
        needles_trace={name: share_of(found.abs(), needles) for name, found in curvatures.items()},
        one_view=share_of(torch.ones_like(condition), alone),
        one_view_trace=finite_or_none(share_of(values["trace_opacity_logits"].abs(), alone)),
        opacity_one_view=finite_or_none(opacity_one_view(values)),
        depth_gradient=finite_or_none(gradient_ratio(objective)),
    )


def share_of(amounts: Tensor, chosen: Tensor) -> float:
    """Share of the chosen in the sum of amounts; nan where that is 0."""
    return float(amounts[chosen].sum() / amounts.sum())


def opacity_one_view(values: Values) -> float:
    """Rank correlation of the Gaussians' curvature in opacity with the share of their weight that one view alone sees.

    nan where either is the same for all.
    """
    columns = [pd.Series(values[name].numpy()) for name in ("trace_opacity_logits", "one_view")]
    if any(column.nunique() == 1 for column in columns):
        return float("nan")
    return float(columns[0].corr(columns[1], method="spearman"))


def swaps(objective: SceneObjective, sights: Sequence[Sight], generator: torch.Generator, progress: Progress) -> Swaps:
    """Shares of the pairs that ways of LENGTHS swap, by view; and the jump of the loss where PAIRS of them swap."""
    gaps = [sight.gap[sight.gap.isfinite()] for sight in sights]
    within = [(m, int(i)) for m, sight in enumerate(sights) for i in (sight.gap <= LENGTHS[-1]).nonzero()[:, 0]]
    order = torch.randperm(len(within), generator=generator)[:PAIRS].tolist()
    jumps = []
    for done, place in enumerate(sorted(order)):
        view, gaussian = within[place]
        jumps.append(abs(swap_jump(objective, view, gaussian, float(sights[view].gap[gaussian]))))
        progress(done + 1, len(order), "swaps")
    n = len(jumps)
    return Swaps(
        lengths=[*LENGTHS],
        share=[[float((gap <= length).double().mean()) if len(gap) else 0.0 for length in LENGTHS] for gap in gaps],
        pairs=[len(gap) for gap in gaps],
        jump=float(np.mean(jumps)) if n else None,
        jump_error=float(np.std(jumps, ddof=1) / sqrt(n)) if n > 1 else None,
        sampled=n,
    )


def swap_jump(objective: SceneObjective, view: int, gaussian: int, gap: float) -> float:
    """The change of the mean loss where a Gaussian, on its way to the camera of a view, passes the next in front of it."""
    camera, active = objective.views[view].camera, objective.active
    ray = camera.centre.double() - active.means[gaussian].double()
    pixel = ray / camera.fx  # of way
    margin = max(MARGIN * gap, ROUND_OFFS * torch.finfo(active.flat.dtype).eps * camera.fx)
    losses = []
    for way in (gap - margin, gap + margin):
        moved = active.with_flat(active.flat.clone())
        moved.means[gaussian] += (way * pixel).to(moved.means)
        losses.append(objective.evaluate_view(view, moved)[0])
    return (losses[1] - losses[0]) / len(objective.views)


def fragility_sentences(found: Fragility) -> list[str]:
    """One for each axis."""
    moved, at = found.swaps, LENGTHS.index(1.0)
    shares = [row[at] for row, pairs in zip(moved.share, moved.pairs, strict=True) if pairs]
    position = "Position: no two Gaussians share a pixel."
    if shares:
        changed = extent(shares, percent)
        position = f"Position: 1 px along the ray changes the order of {changed} of the neighbouring pairs of a view"
        jump, clear = measured(moved.jump, moved.jump_error), (moved.jump or 0.0) >= 2 * (moved.jump_error or 0.0)
        words = f"; at a swap the loss {'jumps by' if clear else 'has no clear jump:'} {jump}."
        position += words if moved.sampled else "."
    if found.depth_gradient is not None:
        position += f" The gradient along the rays is {quantity(found.depth_gradient)} times that across them."
    rotation, scale = (percent(found.needles_steepest[name]) for name in ATTRIBUTES)
    conditioning = (
        f"Conditioning: {percent(found.needles)} of the Gaussians are needles, longer than {sqrt(NEEDLE):.0f} : 1 in a "
        f"picture; so are {rotation} of the {STEEPEST:.0%} that are steepest in rotation, and {scale} in scale."
    )
    opacity = f"Opacity: {percent(found.one_view)} of the Gaussians have over {ALONE:.0%} of their weight in one view"
    if found.one_view_trace is not None:
        opacity += f" and hold {percent(found.one_view_trace)} of opacity's curvature"
    if found.opacity_one_view is not None:
        opacity += "; rank correlation between this share and the curvature in opacity: "
        opacity += quantity(found.opacity_one_view)
    return [position, conditioning, f"{opacity}."]
