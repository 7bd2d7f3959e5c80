"""The Gaussians that a training starts from."""

from dataclasses import replace
from math import cos, log, pi, sin, sqrt
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from torch import Tensor

from splat.model.camera import Camera
from splat.model.harmonics import Y00
from splat.render.render import render
from splat.scenes.scene import Scene, load_scene
from splat.scenes.splits import split_scene
from splat.scenes.view import Frame, Points, View, inside_image
from splat.training.start import (
    Source,
    depth_ranges,
    gaussians_from_points,
    initial_gaussians,
    points_in_box,
    points_in_common_volume,
)
from tests.refusals import refused

NAMES = ("a", "b", "c")


def camera(degrees: float = 0.0, distance: float = 4.0, parallel: bool = False) -> Camera:
    """On a circle round the origin, looking at it; or in a row, all looking along +z."""
    c, s = cos(degrees * pi / 180), sin(degrees * pi / 180)
    rotation = torch.eye(3) if parallel else torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    centre = torch.tensor([distance * s, 0, -distance * c], dtype=torch.float64)
    return Camera(rotation.double(), centre, 40.0, 40.0, 16.0, 12.0, 32, 24)


def views(angles: tuple[float, ...] = (-20, 0, 25), parallel: bool = False) -> list[View]:
    """The red channel counts columns, the green one rows, the blue one views."""
    result = []
    for i, angle in enumerate(angles):
        row, column = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing="ij")
        image = torch.stack([column / 32, row / 24, torch.full_like(row, i / 10)])
        result.append(View(NAMES[i], camera(angle, parallel=parallel), image))
    return result


def some_points(n: int = 60) -> Points:
    generator = torch.Generator().manual_seed(3)
    xyz = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    seen = torch.rand(n, 3, generator=generator) < 0.6
    return Points(xyz, torch.rand(n, 3, generator=generator), seen.nonzero(), NAMES)


def mean_neighbour_distance(xyz: Tensor) -> np.ndarray:
    """Brute force: root of the mean of the three smallest squared distances to others."""
    squared = ((xyz[:, None] - xyz[None]) ** 2).sum(-1).numpy()
    return np.sqrt(np.sort(squared, axis=1)[:, 1:4].mean(axis=1))


def in_order(xyz: torch.Tensor) -> torch.Tensor:
    """Indices that sort places by x, then y, then z, as they are in float32."""
    return torch.from_numpy(np.lexsort(xyz.float().numpy().T[::-1]).copy())


def test_the_order_of_points_in_a_file_changes_no_bit() -> None:
    points, shuffled = some_points(), torch.randperm(60, generator=torch.Generator().manual_seed(1))
    assert points.observations is not None
    xyz = points.xyz.clone()
    xyz[[5, 6, 7]] = xyz[4] + 1e-12  # four colours at a place, whose sum in another order may differ
    xyz[4] -= 1e-12
    places = torch.empty(60, dtype=torch.int64)
    places[shuffled] = torch.arange(60)
    seen = torch.stack([places[points.observations[:, 0]], points.observations[:, 1]], dim=1)
    first = gaussians_from_points(Points(xyz, points.rgb, points.observations, NAMES), views())
    other = gaussians_from_points(Points(xyz[shuffled], points.rgb[shuffled], seen, NAMES), views())
    assert torch.equal(first.flat, other.flat) and torch.equal(in_order(first.means), torch.arange(len(first)))


def test_only_points_that_two_of_the_training_views_see_become_gaussians() -> None:
    points = some_points()
    assert points.observations is not None
    seen = torch.zeros(60, 3, dtype=torch.bool)
    seen[points.observations[:, 0], points.observations[:, 1]] = True
    for chosen in ((0, 1, 2), (0, 2), (1,)):
        needed = min(2, len(chosen))
        kept = seen[:, list(chosen)].sum(dim=1) >= needed
        gaussians = gaussians_from_points(points, [views()[i] for i in chosen])
        places = points.xyz[kept].float()
        torch.testing.assert_close(gaussians.means, places[in_order(places)], atol=0, rtol=0)


def test_every_attribute_is_that_of_3dgs() -> None:
    points = some_points()
    order = in_order(points.xyz)
    xyz, rgb = points.xyz[order], points.rgb[order]
    everyone = Points(xyz, rgb, torch.cartesian_prod(torch.arange(60), torch.arange(3)), NAMES)
    gaussians = gaussians_from_points(everyone, views(), sh_degree=2)
    assert gaussians.sh_degree == 2 and gaussians.flat.dtype == torch.float32
    wanted = torch.from_numpy(np.log(mean_neighbour_distance(xyz))).float()
    torch.testing.assert_close(gaussians.log_scales, wanted[:, None].expand(60, 3))
    assert torch.equal(gaussians.quats, torch.tensor([1.0, 0, 0, 0]).expand(60, 4))
    torch.testing.assert_close(gaussians.opacity_logits.sigmoid(), torch.full((60,), 0.1))
    torch.testing.assert_close(0.5 + Y00 * gaussians.sh[:, 0], rgb)
    assert not gaussians.sh[:, 1:].any()


def test_scales_follow_the_units_of_the_world() -> None:
    points = some_points()
    for unit in (1e-6, 1e6):
        scaled = Points(points.xyz * unit, points.rgb, points.observations, NAMES)
        change = gaussians_from_points(scaled, views()).log_scales - gaussians_from_points(points, views()).log_scales
        torch.testing.assert_close(change, torch.full_like(change, log(unit)), atol=1e-5, rtol=0)


def test_points_at_one_place_become_one_gaussian_of_their_mean_colour() -> None:
    points = some_points()
    everyone = torch.cartesian_prod(torch.arange(60), torch.arange(3))
    xyz, rgb = points.xyz.clone(), points.rgb
    xyz[[2, 30]], xyz[3] = xyz[10].clone(), torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)
    xyz[40] = torch.tensor([-0.0, 1.0, 2.0 + 1e-12])  # the same number in float32
    gaussians = gaussians_from_points(Points(xyz, rgb, everyone, NAMES), views())
    kept = [i for i in range(60) if i not in (10, 30, 40)]
    order = in_order(xyz[kept])
    torch.testing.assert_close(gaussians.means, xyz[kept].float()[order], atol=0, rtol=0)
    wanted = rgb[kept].clone()
    wanted[2], wanted[3] = rgb[[2, 10, 30]].mean(dim=0), rgb[[3, 40]].mean(dim=0)
    torch.testing.assert_close(0.5 + Y00 * gaussians.sh[:, 0], wanted[order])
    with pytest.raises(ValueError, match=r"more than 3 points at different places .*, got 1 of 60"):
        gaussians_from_points(Points(torch.zeros_like(xyz), rgb, everyone, NAMES), views())


def test_points_that_all_but_coincide_get_a_small_scale() -> None:
    points = some_points()
    xyz = points.xyz.clone()
    xyz[:5] = xyz[0] + 1e-6 * torch.arange(5, dtype=torch.float64)[:, None]
    everyone = torch.cartesian_prod(torch.arange(60), torch.arange(3))
    gaussians = gaussians_from_points(Points(xyz, points.rgb, everyone, NAMES), views())
    scales = gaussians.log_scales[:, 0].exp()
    torch.testing.assert_close(scales.sort().values[:5], torch.full((5,), 10**-3.5) * scales.median())


def test_too_few_points_are_refused_with_their_number() -> None:
    few = replace(some_points(5), observations=torch.tensor([[0, 0], [0, 1], [1, 1]]))
    with pytest.raises(ValueError, match=r"more than 3 .* seen by at least 2 of the 3 training views, got 1 of 5"):
        gaussians_from_points(few, views())


def ranges_of(seen: list[View]) -> list[tuple[float, float]]:
    return depth_ranges(seen, [None] * len(seen), some_points)


def test_random_points_lie_where_two_views_see_them_in_a_pixels_colour() -> None:
    chosen = views()
    points = points_in_common_volume(chosen, 500, torch.Generator().manual_seed(0), ranges_of(chosen))
    assert len(points) == 500
    # half and one and a half times the distance to the origin, where all look
    inside = torch.stack([inside_image(view.camera, points.xyz, (2.0, 6.0)) for view in chosen], dim=1)
    assert int(inside.sum(dim=1).min()) >= 2
    for i, view in enumerate(chosen):
        mine = (points.rgb[:, 2] * 10).round() == i
        assert int(mine.sum()) > 50 and bool(inside[mine, i].all())
        x, y, z = ((points.xyz[mine] - view.camera.centre) @ view.camera.rotation.T).unbind(-1)
        column, row = 40 * x / z + 16, 40 * y / z + 12
        # the colour is the pixel's index; a point at a pixel's edge may round into the neighbour
        torch.testing.assert_close((points.rgb[mine, 0] * 32).double() + 0.5, column, atol=0.5 + 1e-5, rtol=0)
        torch.testing.assert_close((points.rgb[mine, 1] * 24).double() + 0.5, row, atol=0.5 + 1e-5, rtol=0)


def test_random_points_keep_out_of_what_a_view_shows_as_transparent() -> None:
    """A ball of radius 1/2 about the place where all look, in front of nothing: 2-D discs, whose cones meet around it."""
    seen = []
    for view in views():
        v, u = torch.meshgrid(torch.arange(24) + 0.5, torch.arange(32) + 0.5, indexing="ij")
        seen.append(replace(view, alpha=((u - 16).square() + (v - 12).square() < 6**2).float()))
    points = points_in_common_volume(seen, 300, torch.Generator().manual_seed(0), ranges_of(seen)).xyz
    for view in seen:
        x, y, z = ((points - view.camera.centre) @ view.camera.rotation.T).unbind(-1)
        at = torch.stack([40 * x / z + 16, 40 * y / z + 12], dim=1)
        # the farthest corner of a pixel whose centre is inside
        assert bool(((at - torch.tensor([16.0, 12.0])).norm(dim=1) < 6 + 0.5**0.5).all())


def test_random_depths_are_uniform_between_near_and_far() -> None:
    view = views((0,))
    depth = points_in_common_volume(view, 4000, torch.Generator().manual_seed(0), [(1.0, 3.0)]).xyz[:, 2] + 4
    assert float(depth.min()) >= 1 and float(depth.max()) <= 3
    # mean 2 and variance 1/3 of a uniform depth, at 4 standard errors
    assert abs(float(depth.mean()) - 2) < 4 * (1 / 3 / 4000) ** 0.5
    assert abs(float(depth.var()) - 1 / 3) < 4 * (4 / 45 / 4000) ** 0.5  # Var((z - 2)^2) = 1/5 - 1/9


def test_the_generator_decides_the_points() -> None:
    first, again, other = (
        points_in_common_volume(views(), 50, torch.Generator().manual_seed(seed), ranges_of(views())).xyz
        for seed in (1, 1, 2)
    )
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_a_box_of_random_points_begins_at_the_twentieth_coordinate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splat.training.start.BOX_DENSITY", 1000)
    frames = tuple(Frame(v.name, v.camera, lambda camera, v=v: v) for v in views())
    scene = Scene("s", Path("s"), "synthetic", frames, some_points(), torch.zeros(3))
    generator = torch.Generator().manual_seed(0)
    gaussians = initial_gaussians(scene, views(), 0, generator=generator, source="box")
    assert scene.points is not None
    xyz = scene.points.xyz
    sides = xyz.amax(dim=0) - xyz.amin(dim=0)
    corner = torch.from_numpy(np.sort(xyz.numpy(), axis=0)[19])
    assert len(gaussians) == int(1000 * sides.max())
    shares = (gaussians.means.double() - corner) / (1.3 * sides)
    assert 0 <= shares.min() < 0.01 and 0.99 < shares.max() <= 1 + 1e-6
    assert (shares.mean(dim=0) - 0.5).abs().max() < 4 / sqrt(12 * len(gaussians))
    assert not gaussians.sh.any()
    refused("expected at least 20 points for a box", points_in_box, some_points(19), generator)


def test_parallel_cameras_take_their_depth_from_points_that_two_of_them_see() -> None:
    given, points = [(3.0, 5.0), None, None], some_points(4000)
    first, *ranges = depth_ranges(views(parallel=True), given, lambda: points)
    assert first == (3.0, 5.0)
    common = points.xyz[points.sightings(views()) >= 2]
    for (near, far), view in zip(ranges, views(parallel=True)[1:], strict=True):
        z = (common - view.camera.centre)[:, 2]
        shown = z[inside_image(view.camera, common)].sort().values
        assert shown[0] < near < shown[2] and shown[-3] < far < shown[-1]
    assert len(points_in_common_volume(views(parallel=True), 10, torch.Generator(), [first, *ranges])) == 10
    far = replace(points, xyz=points.xyz - 90)
    refused(r"another training view sees too, .*, got 0;", depth_ranges, views(parallel=True), [None] * 3, lambda: far)


def test_one_view_alone_needs_a_depth_range_and_says_so() -> None:
    frame = Frame("a", camera(), lambda camera: views((0,))[0])
    scene = Scene("s", Path("s"), "synthetic", (frame,), None, torch.zeros(3))
    said = r"at least 2 training views, got 1: .*; take more views, or"
    refused(said, initial_gaussians, scene, views((0,)), generator=torch.Generator(), source="random")
    assert len(points_in_common_volume(views((0,)), 10, torch.Generator(), [(3.0, 5.0)])) == 10


def test_views_with_nothing_in_common_are_refused() -> None:
    apart = views((0, 90))
    refused("got 0 such places", points_in_common_volume, apart, 10, torch.Generator(), [(0.1, 0.5)] * 2)


def test_a_scene_starts_from_its_points_and_without_them_from_random_ones() -> None:
    frames = tuple(Frame(v.name, v.camera, lambda camera, v=v: v, depth_range=(3.0, 5.0)) for v in views())
    with_points = Scene("s", Path("s"), "synthetic", frames, some_points(), torch.zeros(3))
    without = Scene("s", Path("s"), "synthetic", frames, None, torch.zeros(3))
    generator = torch.Generator().manual_seed(0)
    start = initial_gaussians(with_points, views(), generator=generator)
    assert torch.equal(start.flat, gaussians_from_points(some_points(), views()).flat)
    start = initial_gaussians(without, views(), 1, generator=generator, random_points=40)
    assert len(start) == 40 and start.sh_degree == 1
    depths = torch.stack([((start.means.double() - v.camera.centre) @ v.camera.forward) for v in views()])
    assert int(((depths >= 3 - 1e-6) & (depths <= 5 + 1e-6)).sum(dim=0).min()) >= 2


def test_fern_starts_from_the_points_of_its_three_views(fern: Path) -> None:
    scene = load_scene(fern, downscale=4)
    chosen = scene.load(split_scene(scene, 3).train)
    gaussians = initial_gaussians(scene, chosen, 0, generator=torch.Generator())
    model = pycolmap.Reconstruction(fern / "sparse/0")
    three = {image.image_id for image in model.images.values() if image.name in [view.name for view in chosen]}
    tracks = {i: {element.image_id for element in point.track.elements} for i, point in model.points3D.items()}
    seen = [model.points3D[i].xyz for i, track in tracks.items() if len(track & three) >= 2]
    assert len(three) == 3 and len(gaussians) == len(torch.from_numpy(np.array(seen)).float().unique(dim=0)) < len(seen)
    with torch.no_grad():
        picture = render(gaussians, chosen[1].camera, scene.background)
    # the start is faint, but where it is, it has the photograph's colours: better than a grey of the same alpha
    grey = 0.5 * picture.alpha
    blended = chosen[1].image * picture.alpha
    assert (picture.image - blended).square().mean() < 0.7 * (grey - blended).square().mean()


def test_lego_starts_round_its_middle(lego: Path) -> None:
    scene = load_scene(lego, downscale=16)
    chosen = scene.load(split_scene(scene, 8).train)
    gaussians = initial_gaussians(scene, chosen, 0, generator=torch.Generator().manual_seed(0), random_points=2000)
    assert len(gaussians) == 2000
    assert gaussians.means.mean(dim=0).norm() < 0.3  # it is 2 long and half as wide, and so is what all views see
    assert 0.3 < float(gaussians.means.std(dim=0).mean()) < 0.7


def test_the_source_of_the_points_can_be_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = tuple(Frame(v.name, v.camera, lambda camera, v=v: v, depth_range=(3.0, 5.0)) for v in views())
    with_points = Scene("s", Path("s"), "synthetic", frames, some_points(), torch.zeros(3))
    without = Scene("s", Path("s"), "synthetic", frames, None, torch.zeros(3))
    elsewhere = Points(some_points().xyz + 5, some_points().rgb, some_points().observations, NAMES)
    monkeypatch.setattr("splat.training.start.triangulated_points", lambda seen: elsewhere if len(seen) == 3 else None)

    def start(scene: Scene, source: Source) -> Tensor:
        generator = torch.Generator().manual_seed(0)
        return initial_gaussians(scene, views(), generator=generator, random_points=40, source=source).flat

    points = gaussians_from_points(some_points(), views()).flat
    assert torch.equal(start(with_points, "points"), points) and torch.equal(start(with_points, "scene"), points)
    assert torch.equal(start(with_points, "random"), start(without, "scene"))
    triangulated = gaussians_from_points(elsewhere, views()).flat
    for scene in (with_points, without):
        assert torch.equal(start(scene, "triangulated"), triangulated)
    monkeypatch.setattr(
        "splat.scenes.sfm.plane_sweep.dense_points", lambda chosen, near: elsewhere if near == [3.0] * 3 else None
    )
    assert torch.equal(start(with_points, "dense"), triangulated)
    refused("with points, s has none; start from dense, triangulated or random ones", start, without, "points")
