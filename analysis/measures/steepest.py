"""Carriers of an eigenvector at either end of the spectrum: the Gaussians in which it lies, and renders of steps along it.

mass       of Gaussian i in a unit vector v: the sum of v^2 over its parameters
carriers   the Gaussians with a share of LEAST of the mass or more, MOST at most; the heaviest in any case
view       the one in which the first carrier has most weight: the sum of alpha T over the pixels (`Sight.weight`, px)
kinks      sum_p w j^2 [|r| < NEAR] / NEAR over the numbers p of the images (w: weight in the loss, r: residual, j: its change
           along v): the mean of w (|r + s j| + |r - s j| - 2 |r|) / s^2 where residuals are spread evenly near 0.  A curvature
           that L1 has in every direction, never below 0, and that the Hessian, at signs held still, leaves out
renders    of the part of the view around the carriers, all Gaussians moved by -step, 0 and +step along v; of the steps that the
           probe rendered (`Renders`) the longest whose ratio is within AGREES of 1, else with one above 0, else of all

Why renders can refute a small negative end.  On fern (2,000 steps) lambda_min is -0.074, but second differences of rendered
losses over 1/4 to 4 steps of the optimiser are +0.20 to +0.22.  Kinks of L1 make 0.11 to 0.17 of the gap (0.15 by the formula),
reordered splats below 0.0002, and splats that cross alpha_min, with higher orders, the other 0.10 to 0.18.  Without alpha_min
and with signs held still these differences are -0.027 to -0.011.  A steep end gains by the same: on DTU's scan 24 (1,500
steps) 48 becomes 61 over the optimiser's step, where kinks make 13 by the formula.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import inf

import numpy as np
import scipy
import torch
from jaxtyping import Float, Float64, UInt8
from torch import Tensor

from analysis.measures.localization import mass_shares, masses, participation
from analysis.records.findings import attribute_name, optimiser_steps, what_renders_say
from analysis.records.quantities import AGREES, Shade, percent, ratio, rough
from analysis.records.run_files import Carrier, Steepest
from analysis.records.schema import Carries, Renders
from landscape.slices.grid_evaluations import Control
from splat.curvature.fields import Values
from splat.curvature.objective import SceneObjective
from splat.losses.reference import REACH
from splat.model.gaussians import Gaussians
from splat.projection.formulas import Lens, lens_of
from splat.projection.reference import NEEDLE
from splat.render.backend import CPU, Raster, backend_of
from splat.render.forward import rasterize_view, touches, weights
from splat.render.render import render
from splat.render.sight import Sight
from splat.scenes.view import View
from splat.scenes.write import bytes_of

NEAR = 0.01  # |residual|, of a range of 1, below which residuals are taken to be spread evenly
LEAST, MOST = 0.05, 5  # smallest share of the mass of a carrier; most carriers
SIGMAS = 2.0  # standard deviations at which an outline is drawn
TINY = torch.finfo(torch.float32).tiny
ROOM, SMALLEST = 1.3, 8  # size of a crop: times the outlines; at least 1 / SMALLEST of its view
PLACES = (
    ("in the upper left", "at the top", "in the upper right"),
    ("at the left", "in the middle", "at the right"),
    ("in the lower left", "at the bottom", "in the lower right"),
)
Pictures = dict[str, UInt8[np.ndarray, "..."]]
# of `loss_nearby`: mass on the Gaussians followed, standard deviations to their edges, largest part of the views
FOLLOWED, EDGE, PART = 0.99, 3.5, 0.25


@dataclass(frozen=True, eq=False)
class End:
    """An end of the spectrum: unit eigenvector, eigenvalue, renders along it.  title: e.g. "the steepest direction"."""

    name: str
    title: str
    vector: Float[Tensor, " p"]
    curvature: float
    renders: Renders


def steepest(
    objective: SceneObjective, end: End, values: Values, sights: Sequence[Sight], file: str
) -> tuple[Steepest, Pictures]:
    """Carriers, steps and pictures of an eigenvector.  Pictures in bytes: `view`, the whole photograph; and of the
    crop `photograph`, `minus`, `zero`, `plus`, `difference`.

    values, sights: from `splat.curvature.fields.scene_fields`.  file: name of the pictures' file, for the record.
    """
    mass = masses(end.vector, objective.active)
    mass, spread = mass / mass.sum(), participation(mass)
    order = mass.argsort(descending=True, stable=True)[:MOST].tolist()
    chosen = [i for i in order if mass[i] >= LEAST] or order[:1]
    view = objective.views[int(torch.stack([each.weight[chosen[0]] for each in sights]).argmax())]
    carriers = [_carrier(objective, view, end.vector, values, mass, i) for i in chosen]
    crop = crop_around([each.outline for each in carriers], view.camera.width, view.camera.height)
    step = shown_step(end.renders)
    places = {
        name: objective.active.flat + sign * step * end.vector
        for name, sign in (("minus", -1), ("zero", 0), ("plus", 1))
    }
    back, here, forth = map(objective.loss, places.values())
    pictures, difference = _pictures(objective, view, places, crop)
    found = Steepest(
        name=end.name, curvature=end.curvature, participation=spread, carriers=carriers, view=view.name,
        crop=crop, step=step, length=optimiser_steps(end.renders, step), losses=(back, here, forth), difference=difference,
        file=file, rendered=rendered_sentence(end, (back, here, forth), step),
        sentence=sentence(end, carriers, spread, view, len(objective.views)),
    )  # fmt: skip
    return found, pictures


def heaviest(
    objective: SceneObjective, vectors: Sequence[Float[Tensor, " p"]], generator: torch.Generator
) -> list[Carries]:
    """The Gaussian with most mass in each eigenvector, and its shape, in words."""
    random = masses(torch.empty_like(objective.active.flat).normal_(generator=generator), objective.active)
    found, weights = [], weights_of(objective)
    values = {"views": (weights > 0).sum(dim=0), "one_view": weights.amax(dim=0) / weights.sum(dim=0).clamp_min(TINY)}
    for vector in vectors:
        mass = masses(vector, objective.active)
        mass, i = mass / mass.sum(), int(mass.argmax())
        part = objective.active.with_flat(vector).select(torch.tensor([i], device=mass.device))
        shares = mass_shares(part.flat, part.blocks)
        # random_share: for comparison, the largest share of a Gaussian in a random vector
        one = Carries(
            gaussian=int(objective.mask.nonzero()[i, 0]),
            share=float(mass[i]),
            random_share=float(random.max() / random.sum()),
            attribute=max(shares, key=shares.__getitem__),
        )
        view = objective.views[int(weights[:, i].argmax())]
        carrier = _carrier(objective, view, vector, values, mass, i)
        one.shape, one.view, one.outline = shape(carrier, view), view.name, carrier.outline
        found.append(one)
    return found


def weights_of(objective: SceneObjective) -> Float[Tensor, "m n"]:
    """The sum of alpha T over the pixels of each view."""
    render = partial(rasterize_view, background=objective.background, settings=objective.settings)
    return torch.stack([weights(render(objective.active, view.camera)) for view in objective.views])


def kink_curvature(objective: SceneObjective, vector: Float[Tensor, " p"]) -> float:
    """The curvature along a unit vector by the kinks of L1, which the Hessian leaves out; 0 for a loss without L1."""
    loss, total = objective.loss_settings, 0.0
    if loss.pixel == "l1":
        for view, linearized in zip(objective.views, objective.linearized, strict=True):
            change = linearized.jvp(vector[:, None])[0, :3].double()
            residual = linearized.image - view.image.to(linearized.image)
            near = residual.abs() < NEAR
            total += loss.pixel_weight * float(change[near].square().sum()) / NEAR / residual.numel()
    return total / len(objective.views)


def heaviest_view(objective: SceneObjective, vector: Float[Tensor, " p"]) -> int:
    """Index of the training view in which the Gaussian with most mass in a vector has most weight."""
    return int(weights_of(objective)[:, masses(vector, objective.active).argmax()].argmax())


def loss_nearby(
    objective: SceneObjective, vectors: Float[Tensor, "p k"], ends: Sequence[Float[Tensor, " p"]]
) -> Control | None:
    """The loss in boxes of the views around the few Gaussians that carry some unit vectors, less constants.

    It differs from the loss by what the other Gaussians change outside of the boxes: little, and smoothly.  It takes a tenth of
    the time, and reads the parameters of the Gaussians in the boxes.  ends: the parameters that the Gaussians move between.
    None where their boxes are a large part of the views, or not on a CPU.
    """
    active, found, pixels = objective.active, [], 0
    mass = torch.stack([masses(vector, active) for vector in vectors.T])
    shares, order = (mass / mass.sum(dim=1, keepdim=True)).sort(dim=1, descending=True)
    followed = order[(shares.cumsum(dim=1) - shares) < FOLLOWED].unique()
    if backend_of(active.flat) is not CPU:
        return None
    # a box of any size has the windows of all of its pixels
    settings = replace(objective.loss_settings, border="padded")
    places = active.with_flat(torch.arange(active.flat.numel(), dtype=torch.float64))  # exact
    everywhere = [active, *map(active.with_flat, ends)]
    moved = [each.select(followed) for each in everywhere]

    def raster(gaussians: Gaussians, lens: Lens, corner: Tensor, height: int, width: int) -> Raster:
        splats, depths, drawn = CPU.project(gaussians, lens)
        splats[:, :2] -= corner
        return CPU.rasterize(splats, depths, drawn, objective.background, width, height, objective.settings)

    for view in objective.views:
        lens, size = lens_of(view.camera, objective.settings), view.camera.width * view.camera.height
        for rows, columns in boxes(moved, lens, view.camera.width, view.camera.height):
            part = view.image[:, rows, columns].contiguous()
            box = lens, torch.tensor([columns.start, rows.start]), *part.shape[1:]
            seen = torch.stack([touches(raster(each, *box)) for each in everywhere]).any(dim=0)
            if not seen[followed].any():
                continue
            seen[followed] = True
            loss = CPU.view_loss(part, settings, active.flat)
            share = part[0].numel() / size / len(objective.views)
            found.append((box, places.select(seen).flat.long(), active.select(seen), loss, share))
            pixels += share
    if pixels > PART or not found:
        return None
    rows = torch.cat([index for _, index, *_ in found]).unique()
    parts = [(box, torch.searchsorted(rows, index), *others) for box, index, *others in found]

    def nearby(flat: Tensor) -> float:
        return sum(
            share * loss.value(raster(some.with_flat(flat[at]), *box).planes) for box, at, some, loss, share in parts
        )

    return Control(nearby, rows)


def boxes(moved: Sequence[Gaussians], lens: Lens, width: int, height: int) -> list[tuple[slice, slice]]:
    """Rows and columns of boxes in a view that hold the splats of Gaussians wherever these move, and SSIM's windows around."""
    inside, low, high = np.zeros((height, width), bool), [], []
    for gaussians in moved:
        splats, _, drawn = CPU.project(gaussians, lens)
        a, b, c = splats[:, 2:5].T
        reach = REACH + EDGE * (torch.stack([c, a]) / (a * c - b * b)).sqrt().T
        low.append(torch.where(drawn[:, None], splats[:, :2] - reach, inf))
        high.append(torch.where(drawn[:, None], splats[:, :2] + reach + 1, -inf))
    corners = torch.cat([torch.stack(low).amin(dim=0), torch.stack(high).amax(dim=0)], dim=1)
    for left, top, right, bottom in corners.clamp(0, max(width, height)).int().tolist():  # of each Gaussian
        inside[top:bottom, left:right] = True
    return scipy.ndimage.find_objects(scipy.ndimage.label(inside)[0])


def shown_step(renders: Renders) -> float:
    """The longest step whose ratio is within AGREES of 1, else the longest with one above 0, else the longest; of those that
    round-off does not hide.

    >>> shown_step(Renders(confirmed=None, steps=[1.0, 2.0, 4.0], ratios=[0.9, 1.1, 0.5], errors=[0.1] * 3))
    2.0
    >>> shown_step(Renders(confirmed=None, steps=[1.0, 2.0, 4.0], ratios=[1.0, None, -2.0], errors=[9.0, None, 0.1]))
    4.0
    """
    found = zip(renders.steps, renders.ratios, renders.errors, strict=True)
    known = [(step, r) for step, r, error in found if r is not None and error is not None and abs(r) > error]
    tests = (lambda ratio: abs(ratio - 1) <= AGREES, lambda ratio: ratio > 0)
    chosen = [step for fits in tests for step, ratio in reversed(known) if fits(ratio)]
    return next(iter(chosen), renders.steps[-1])


def rendered_sentence(end: End, losses: tuple[float, float, float], step: float) -> str:
    """Sentence on renders along an end of the spectrum: what the step shown does, and how far they agree with the curvature.

    losses: at -step, 0 and +step.
    """
    back, loss, forth = losses
    found, alone = 50 * (back + forth - 2 * loss) / loss, 50 * end.curvature * step**2 / loss  # percent
    said = what_renders_say(end.curvature, end.renders)
    if not found * alone > 0:
        return f"The {'negative ' * (end.curvature < 0)}curvature along {end.name} is {said}."
    way = "raises" if alone > 0 else "lowers"
    return (
        f"A step of {optimiser_steps(end.renders, step)} along {end.name} {way} the loss by {rough(abs(found))}%, the mean of "
        f"back and forth (by its curvature alone: {rough(abs(alone))}%); {said}."
    )


def _carrier(
    objective: SceneObjective, view: View, vector: Tensor, values: Values, mass: Float64[Tensor, " n"], i: int
) -> Carrier:
    active, index = objective.active, torch.tensor([i], device=vector.device)
    part = active.with_flat(vector).select(index)
    shares = mass_shares(part.flat, part.blocks)
    splats, _, _ = backend_of(active.flat).project(active.select(index), lens_of(view.camera, objective.settings))
    outline = outline_of(splats[0].double().cpu())
    return Carrier(
        gaussian=int(objective.mask.nonzero()[i, 0]),
        share=float(mass[i]),
        attributes={name: float(mass[i]) * share for name, share in shares.items()},
        sigmas=active.log_scales[i].double().exp().sort(descending=True).values.tolist(),
        aspect=outline[2] / outline[3],
        opacity=float(active.opacity_logits[i].sigmoid()),
        views=int(values["views"][i]),
        one_view=float(values["one_view"][i]),
        outline=outline,
    )


def outline_of(splat: Float64[Tensor, "9"]) -> list[float]:
    """Ellipse of a splat (place x, y; inverse covariance a, b, c; ...) at SIGMAS standard deviations.

    Centre x, y and half axes in px; angle of the longer axis from x towards y, in radians.

    >>> outline_of(torch.tensor([5.0, 6.0, 0.25, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]))
    [5.0, 6.0, 4.0, 2.0, 0.0]
    """
    x, y, a, b, c = splat[:5].tolist()
    values, vectors = np.linalg.eigh(np.array([[a, b], [b, c]]))  # ascending, of the inverse: the longer axis first
    long, short = SIGMAS / np.sqrt(np.maximum(values, np.finfo(float).tiny))
    axis = vectors[:, 0] * (1 if vectors[0, 0] >= 0 else -1)
    return [x, y, float(long), float(short), float(np.arctan2(axis[1], axis[0]))]


def crop_around(outlines: Sequence[Sequence[float]], width: int, height: int) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of a crop, with the picture's aspect ratio, around the parts of outlines in the picture.

    >>> crop_around([[10.0, 90.0, 3.0, 1.0, 0.0]], 160, 120)
    (0, 82, 20, 97)
    """
    # points of a disc, of which those outside of the picture are left out
    turn, radius = np.meshgrid(np.linspace(0, 2 * np.pi, 181), np.linspace(0, 1, 51))
    x, y, long, short, angle = np.array(outlines).T[:, :, None, None]
    along, across = long * radius * np.cos(turn), short * radius * np.sin(turn)
    c, s = np.cos(angle), np.sin(angle)
    points = np.stack([x + along * c - across * s, y + along * s + across * c])
    size = np.array([width, height])[:, None, None, None]
    inside = points[:, ((points >= 0) & (points <= size)).all(axis=0)]
    ends = inside if inside.size else np.array(outlines)[:1, :2].T  # none inside: the first centre
    (left, top), (right, bottom) = ends.min(axis=1), ends.max(axis=1)
    share = min(max(ROOM * max((right - left) / width, (bottom - top) / height), 1 / SMALLEST), 1.0)
    x, y = (left + right) / 2, (top + bottom) / 2
    wide, tall = max(round(share * width), 1), max(round(share * height), 1)
    left = min(max(round(x - wide / 2), 0), width - wide)
    top = min(max(round(y - tall / 2), 0), height - tall)
    return left, top, left + wide, top + tall


def _pictures(
    objective: SceneObjective, view: View, places: dict[str, Tensor], crop: Sequence[int]
) -> tuple[Pictures, Shade]:
    left, top, right, bottom = crop
    images = {
        name: render(objective.active.with_flat(flat), view.camera, objective.background, objective.settings).image
        for name, flat in places.items()
    }
    parts = {name: image[:, top:bottom, left:right] for name, image in images.items()}
    change = (parts["plus"] - parts["minus"]).mean(dim=0).double().numpy()
    reach = float(np.abs(change).max()) or 1.0
    words = "render at +step less that at −step"
    shade = Shade(
        name="difference", words=words, unit="of the range of a colour", scale="linear", low=-reach, high=reach
    )
    parts |= {"view": view.image, "photograph": view.image[:, top:bottom, left:right]}
    pictures = {name: bytes_of(part) for name, part in parts.items()}
    return pictures | {"difference": shade.bytes(change)}, shade


def sentence(end: End, carriers: Sequence[Carrier], spread: float, view: View, count: int) -> str:
    """Sentence on the first carrier: its share of the vector, attribute of most mass, shape and place.

    spread: participation of the vector; count: number of views.
    """
    first = carriers[0]
    name = max(first.attributes, key=first.attributes.__getitem__)
    every = "both" if count == 2 else f"all {count}"
    some = every if first.views == count else f"{first.views} of {count}"
    seen = "one view" if first.views == 1 else f"{some} views"
    if first.views > 1 and first.one_view >= 0.9:
        seen += f", with {first.one_view:.0%} of its weight in one"
    alone = "" if first.share >= 0.5 else f"; it is spread over {spread:.0f} Gaussians"
    return (
        f"{percent(first.share)} of {end.name}, {end.title}, lies on Gaussian {first.gaussian:,}, most of it in "
        f"{attribute_name(name)}: {shape(first, view)}, seen by {seen}{alone}."
    )


def shape(first: Carrier, view: View) -> str:
    """Kind and place of a carrier's splat in a view, in words."""
    kind = f"a splat of {ratio(first.aspect)}"
    if first.aspect**2 > NEEDLE:  # the condition number of its covariance in the picture
        large, middle, small = first.sigmas
        flat = large * small < middle**2  # nearer to a disc than to a rod
        kind = f"{'a plate seen edge-on' if flat else 'a needle'}, {ratio(first.aspect)} in the picture,"
    x, y = first.outline[0] / view.camera.width, first.outline[1] / view.camera.height
    row, column = (min(max(int(3 * each), 0), 2) for each in (y, x))
    outside = "" if 0 <= x < 1 and 0 <= y < 1 else ", its centre outside of the picture"
    return f"{kind} {PLACES[row][column]} of {view.name.rpartition('/')[2]}{outside}"
