"""The Gaussians that a training starts from.

points      points: the scene's, from structure from motion, those seen by at least two of the training views.  All of
                the scene's photographs helped to place them, the test views too
            triangulated: from the training views alone, their poses given (`splat/scenes/sfm/triangulation.py`)
            dense: from the training views alone, by a plane sweep (`splat/scenes/sfm/plane_sweep.py`)
            random: a random pixel of a random training view at a depth uniform between near and far, kept where at
                least two views see it and no view is transparent there (alpha 0), in that pixel's colour.  near, far:
                the scene files' depth range, else half and one and a half times the camera's distance to the place that
                all cameras look at, else (parallel cameras) all but a thousandth of the points that two views see on either
                side.  Gaussians of the background's colour in front of it would have no gradient: they stay, and hide the
                object from other viewpoints
            box: DNGaussian's start (its scene/dataset_readers.py): random places in the box of the scene's points, of the sides
                1.3 (max - min), BOX_DENSITY of them per world unit of the longest side, grey.  The box begins at the
                BOX_RANK-th smallest coordinate, so that it is not centred on the points
            scene: points where the scene has any, else random
means       the points, sorted, so that their order in a file is no second seed; those at one place (exactly, as triangulation
                leaves them) are one, of their mean colour
quats       the identity
log_scales  isotropic: log of the root mean square distance to the three nearest neighbours (3DGS)
opacity     0.1                                 sh      band 0 gives the point's colour, the others 0
"""

from collections.abc import Callable, Sequence
from math import log, sqrt
from typing import Literal

import numpy as np
import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import group_sums
from splat.model.camera import common_target
from splat.model.gaussians import Gaussians
from splat.model.harmonics import Y00
from splat.scenes.scene import Scene
from splat.scenes.sfm.triangulation import triangulated_points
from splat.scenes.view import Frame, Points, View, inside_image, lifted, pixel_coordinates, transparent_at

Source = Literal["scene", "points", "triangulated", "dense", "random", "box"]
OPACITY = 0.1
NEIGHBOURS = 3
SMALLEST_SCALE = sqrt(1e-7)  # of the median scale: for points that all but coincide with three others
NEAR, FAR = 0.5, 1.5  # of the distance to the cameras' common target; Blender's 4 gives its usual 2 and 6
OUTLIERS = 0.001  # of the points that a view shows, on either side
MAX_DRAWS = 200  # per random point wanted
SEEN_BY = 2  # views at least, or all if they are fewer
BOX_RANK, BOX_SHARE, BOX_DENSITY = 20, 1.3, 50


def initial_gaussians(
    scene: Scene,
    views: Sequence[View],
    sh_degree: int = 3,
    *,
    generator: torch.Generator,
    random_points: int = 10_000,
    source: Source = "scene",
) -> Gaussians:
    """Gaussians from the points of the source.  The same state of the generator gives the same Gaussians.

    >>> from splat import SyntheticSettings, synthetic_scene
    >>> scene = synthetic_scene(SyntheticSettings(gaussians=50, views=3, width=16, height=12)).scene
    >>> initial_gaussians(scene, scene.load(), sh_degree=1, generator=torch.Generator().manual_seed(0)).sh_degree
    1
    """
    frames = scene.select([view.name for view in views])
    if source in ("points", "box") and scene.points is None:
        raise InputError(
            f"expected a scene with points, {scene.root} has none; start from dense, triangulated or random ones"
        )
    if source == "box":
        assert scene.points is not None
        return gaussians_from_points(points_in_box(scene.points, generator), views, sh_degree, seen_by=0)
    if source == "triangulated":
        return gaussians_from_points(triangulated_points(frames), views, sh_degree)
    if source in ("scene", "points") and scene.points is not None:
        return gaussians_from_points(scene.points, views, sh_degree)
    ranges = depth_ranges(views, [frame.depth_range for frame in frames], lambda: _known_points(scene, frames))
    if source == "dense":
        from splat.scenes.sfm.plane_sweep import dense_points  # a fifth of a second of imports

        return gaussians_from_points(dense_points(views, [near for near, _ in ranges]), views, sh_degree)
    points = points_in_common_volume(views, random_points, generator, ranges)
    return gaussians_from_points(points, views, sh_degree)


def gaussians_from_points(
    points: Points, views: Sequence[View | Frame], sh_degree: int = 3, seen_by: int = SEEN_BY
) -> Gaussians:
    """float32 Gaussians at the points that so many of the views see."""
    needed = min(seen_by, len(views))
    seen = points.sightings(views) >= needed
    kept, colours = _merged(points.xyz[seen], points.rgb[seen])
    n = len(kept)
    if n <= NEIGHBOURS:
        raise InputError(
            f"expected more than {NEIGHBOURS} points at different places seen by at least {needed} of the {len(views)} "
            f"training views, got {n} of {len(points)}; start from dense points, or choose views that overlap more"
        )
    scales = _neighbour_distances(kept)
    sh = torch.zeros(n, (sh_degree + 1) ** 2, 3, dtype=torch.float64)
    sh[:, 0] = (colours - 0.5) / Y00
    attributes = {
        "means": kept,
        "log_scales": scales.log()[:, None].expand(n, 3),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64).expand(n, 4),
        "opacity_logits": torch.full((n,), log(OPACITY / (1 - OPACITY)), dtype=torch.float64),
        "sh": sh,
    }
    return Gaussians.pack(attributes).to(torch.float32)


def _merged(xyz: Float[Tensor, "n 3"], rgb: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """The points that differ in float32, sorted, and the mean colours there."""
    # in which colours are summed, and one of them stands for a place
    order = np.lexsort([*rgb.T.numpy(), *xyz.T.numpy()])
    rounded = xyz[order].float().numpy() + 0.0  # no -0
    _, first, place = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    index = torch.from_numpy(place.ravel())
    sums = group_sums(rgb[order].double(), index, len(first))
    return xyz[order][first], sums / torch.bincount(index, minlength=len(first))[:, None]


def _neighbour_distances(xyz: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Root mean square distance to the three nearest other points."""
    distances, _ = scipy.spatial.KDTree(xyz.numpy()).query(xyz.numpy(), k=NEIGHBOURS + 1)
    scales = torch.from_numpy(np.sqrt(np.square(distances[:, 1:]).mean(axis=1)))
    return scales.clamp_min(SMALLEST_SCALE * float(scales.median()))


def points_in_box(points: Points, generator: torch.Generator) -> Points:
    """Random grey points in a box round others."""
    if len(points) < BOX_RANK:
        raise InputError(
            f"expected at least {BOX_RANK} points for a box round them, got {len(points)}; start from random"
        )
    sides = points.xyz.amax(dim=0) - points.xyz.amin(dim=0)
    n = int(BOX_DENSITY * sides.max())
    corner = points.xyz.sort(dim=0).values[BOX_RANK - 1]
    places = torch.rand(n, 3, generator=generator, dtype=torch.float64)
    return Points(corner + BOX_SHARE * sides * places, torch.full((n, 3), 0.5))


def depth_ranges(
    views: Sequence[View], given: Sequence[tuple[float, float] | None], known: Callable[[], Points]
) -> list[tuple[float, float]]:
    """The least and greatest z in each view, world units: as given, else by where the cameras look.

    known: points of the scene, for cameras that look at no common place; their z as LLFF takes the bounds of a view.
    """
    if all(given):
        return [own for own in given if own]
    target = common_target([view.camera for view in views])
    if target is not None:
        depths = [float((target - view.camera.centre) @ view.camera.forward) for view in views]
        return [own or (NEAR * depth, FAR * depth) for own, depth in zip(given, depths, strict=True)]
    points = known()
    xyz = points.xyz[points.sightings(views) >= min(SEEN_BY, len(views))]
    return [own or _range_of_points(view, xyz) for own, view in zip(given, views, strict=True)]


def _range_of_points(view: View, xyz: Float[Tensor, "n 3"]) -> tuple[float, float]:
    z = pixel_coordinates(view.camera, xyz[inside_image(view.camera, xyz)])[1]
    if len(z) <= NEIGHBOURS:
        raise InputError(
            f"expected points in {view.name} that another training view sees too, which say how far away the scene is where "
            f"cameras look at no common place, got {len(z)}; choose views that overlap more, or --start points"
        )
    near, far = np.quantile(z.numpy(), [OUTLIERS, 1 - OUTLIERS]).tolist()
    return near, far


def _known_points(scene: Scene, frames: Sequence[Frame]) -> Points:
    """The scene's points, else those of the training views alone."""
    if scene.points is None and len(frames) == 1:
        raise InputError(
            "expected at least 2 training views, got 1: one alone does not say how far away the scene is; "
            "take more views, or start from points (COLMAP), or give depth ranges (poses_bounds.npy)"
        )
    return triangulated_points(frames) if scene.points is None else scene.points


def points_in_common_volume(
    views: Sequence[View], n: int, generator: torch.Generator, ranges: Sequence[tuple[float, float]]
) -> Points:
    """n random points that SEEN_BY of the views see, and none as transparent.  ranges: see `depth_ranges`."""
    if n < 1:
        raise InputError(f"expected at least 1 random point, got {n}")
    needed, kept, draws = min(SEEN_BY, len(views)), [], 0
    while (found := sum(len(xyz) for xyz, _ in kept)) < n:
        if draws >= MAX_DRAWS * n:
            raise InputError(
                f"expected {needed} of {len(views)} views to see the same places, got {found} such places in {draws} "
                "random draws; choose views that overlap more"
            )
        xyz, rgb = _random_batch(views, ranges, n, generator)
        sightings = torch.stack([inside_image(v.camera, xyz, r) for v, r in zip(views, ranges)]).sum(dim=0)
        fit = sightings >= needed
        for view in views:
            fit &= ~transparent_at(view, xyz)
        kept.append((xyz[fit], rgb[fit]))
        draws += n
    return Points(torch.cat([xyz for xyz, _ in kept])[:n], torch.cat([rgb for _, rgb in kept])[:n])


def _random_batch(
    views: Sequence[View], ranges: Sequence[tuple[float, float]], n: int, generator: torch.Generator
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Random pixels of random views, lifted to random depths, with the pixels' colours."""
    which = torch.randint(len(views), (n,), generator=generator)
    uniform = torch.rand(n, 3, generator=generator, dtype=torch.float64)
    xyz, rgb = torch.empty(n, 3, dtype=torch.float64), torch.empty(n, 3)
    for i, (view, (near, far)) in enumerate(zip(views, ranges)):
        camera, mine = view.camera, which == i
        pixel = uniform[mine, :2] * torch.tensor([camera.width, camera.height])
        xyz[mine] = lifted(camera, pixel, near + (far - near) * uniform[mine, 2])
        u, v = pixel.long().unbind(-1)
        rgb[mine] = view.image[:, v, u].T
    return xyz, rgb
