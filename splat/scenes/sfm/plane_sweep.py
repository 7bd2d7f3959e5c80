"""Dense points from some views with known poses, by a plane sweep: a point for most surfaces that two of them show.

    planes      parallel to the image of a reference view, evenly spaced in 1 / z from near to BEYOND near, so closely that
                in any other view a pixel moves by at most one between neighbours
    warp        x_s ~ K_s (R + b e_z^T / z) K_r^-1 x_r, with X_s = R X_r + b from reference to source camera
    score       normalised cross-correlation of grey windows, the mean of the better half of the sources: the worse half may
                not see the place
    depth       the best plane, between planes by the parabola through it and its neighbours
    points      pixels whose depth another view's map confirms, within COLMAP's thresholds for fusing depth maps; of a
                pixel that an earlier view's point covers there is no second point

The sparse-view literature starts from COLMAP's dense stereo of the training views (`fused.ply`), which needs a GPU.
Pictures are reduced to at most LARGEST pixels, and of every STRIDE x STRIDE pixels one gives a point.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil

import torch
from jaxtyping import Bool, Float
from kornia.color import rgb_to_grayscale
from kornia.filters import box_blur
from kornia.geometry.transform import rescale, warp_perspective
from torch import Tensor

from landscape.errors import InputError
from splat.model.camera import Camera
from splat.scenes.view import Points, View, lifted, pixel_coordinates, transparent_at

LARGEST = 400  # px, of the longer side
STRIDE = 2
SOURCES = 4  # the views nearest to a reference view; more cost time, and see less of the same
WINDOW = 7  # px
PLANES = (16, 256)
BEYOND = 100.0  # of near: farther away nothing has a parallax
SCORE = 0.5  # least correlation; windows that show the same place have 0.8 and more, unlike ones 0 +- 1 / WINDOW
CONTRAST = 1 / 255  # least standard deviation of a window: less is quantisation
MAX_REPROJECTION, MAX_DEPTH = 2.0, 0.01  # px and relative, COLMAP's StereoFusionOptions
AT_ONCE = 8  # planes


@dataclass(frozen=True, eq=False)
class DepthMap:
    """z (h, w) of a camera's pixels, world units; 0 where it is not known."""

    camera: Camera
    z: Float[Tensor, "h w"]


def dense_points(views: Sequence[View], near: Sequence[float]) -> Points:
    """The points that at least two of these views agree on.  near: the least z in each view.

    InputError where there are fewer than two views, or nothing that they agree on.
    """
    if len(views) < 2:
        raise InputError(f"expected at least 2 views for dense points, got {len(views)}; start from random points")
    pictures = [_reduced(view) for view in views]
    maps = []
    for i, (grey, camera) in enumerate(pictures):
        nearest = sorted((float((c.centre - camera.centre).norm()), j) for j, (_, c) in enumerate(pictures) if j != i)
        sources = [pictures[j] for _, j in nearest[:SOURCES]]
        maps.append(DepthMap(camera, depth_map(grey, camera, sources, near[i])))
    points = _fused(views, maps)
    if not len(points):
        raise InputError(
            f"expected places that two of the {len(views)} training views show, found none that match; "
            "choose views that overlap more, or start from random points"
        )
    return points


def _reduced(view: View) -> tuple[Float[Tensor, "h w"], Camera]:
    factor = min(LARGEST / max(view.camera.width, view.camera.height), 1.0)
    grey = rgb_to_grayscale(view.image[None].float())
    grey = (rescale(grey, factor, antialias=True) if factor < 1 else grey)[0, 0]
    return grey, view.camera.resized(grey.shape[1], grey.shape[0])


def depth_map(
    grey: Float[Tensor, "h w"], camera: Camera, sources: Sequence[tuple[Float[Tensor, "h w"], Camera]], near: float
) -> Float[Tensor, "h w"]:
    """z of every pixel of a view, from other views; 0 where no plane fits."""
    inverse = _planes(camera, [other for _, other in sources], near)
    scores = torch.cat(list(_scores(grey, camera, sources, inverse)))
    best, plane = scores.max(dim=0)
    inner = plane.clamp(1, len(inverse) - 2)
    before, at, after = (scores.gather(0, inner[None] + step)[0] for step in (-1, 0, 1))
    bend = before - 2 * at + after
    shift = torch.where((bend < 0) & (plane == inner), (before - after) / (2 * bend), 0.0).clamp(-0.5, 0.5)
    z = 1 / (inverse[plane] + shift * (inverse[1] - inverse[0]))
    return torch.where((best > SCORE) & (plane == inner), z, 0.0)  # the ends of the range bound nothing


def _planes(camera: Camera, others: Sequence[Camera], near: float) -> Float[Tensor, " planes"]:
    """1 / z of the planes."""
    corners = torch.tensor([[x, y] for x in (0, camera.width) for y in (0, camera.height)], dtype=torch.float64)
    ends = [lifted(camera, corners, torch.full((4,), z, dtype=torch.float64)) for z in (near, BEYOND * near)]
    moves = [
        torch.stack([pixel_coordinates(other, end)[0] for end in ends]).diff(dim=0).norm(dim=2) for other in others
    ]
    count = min(max(ceil(max(float(move.max()) for move in moves)) + 1, PLANES[0]), PLANES[1])
    return torch.linspace(1 / (BEYOND * near), 1 / near, count)


def _scores(
    grey: Float[Tensor, "h w"],
    camera: Camera,
    sources: Sequence[tuple[Float[Tensor, "h w"], Camera]],
    inverse: Float[Tensor, " planes"],
) -> Iterator[Float[Tensor, "some h w"]]:
    """The correlation at every pixel for some planes after the others; -1 where a source does not show it."""
    mean, deviation, _ = _moments(grey[None, None], grey)
    better = ceil(len(sources) / 2)
    for some in inverse.split(AT_ONCE):
        of_sources = []
        for picture, other in sources:
            warped, inside = _warped(picture, camera, other, some)
            other_mean, other_deviation, together = _moments(warped, grey)
            clear = inside & (deviation > CONTRAST) & (other_deviation > CONTRAST)
            score = (together - mean * other_mean) / (deviation * other_deviation).clamp_min(CONTRAST**2)
            of_sources.append(torch.where(clear, score, -1.0)[:, 0])
        yield torch.stack(of_sources).topk(better, dim=0).values.mean(dim=0)


def _moments(picture: Float[Tensor, "b 1 h w"], grey: Float[Tensor, "h w"]) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, standard deviation and mean product with grey of the window round every pixel, (b, 1, h, w) each."""
    means = box_blur(torch.cat([picture, picture.square(), picture * grey], dim=1), WINDOW)
    mean, square, together = means.split(1, dim=1)
    return mean, (square - mean.square()).clamp_min(0).sqrt(), together


def _warped(
    picture: Float[Tensor, "h w"], camera: Camera, other: Camera, inverse: Float[Tensor, " planes"]
) -> tuple[Float[Tensor, "planes 1 h w"], Bool[Tensor, "planes 1 h w"]]:
    """Another view's picture as the camera would see it on each plane, and where that is inside of it."""
    R = other.rotation @ camera.rotation.T
    b = other.rotation @ (camera.centre - other.centre)
    on_planes = R + torch.einsum("p,i,j->pij", inverse.double(), b, torch.eye(3, dtype=torch.float64)[2])
    to_other = _intrinsics(other) @ on_planes @ torch.linalg.inv(_intrinsics(camera))
    size, count = (camera.height, camera.width), len(inverse)
    pictures = torch.stack([picture, torch.ones_like(picture)])[None].expand(count, -1, -1, -1)
    warped = warp_perspective(pictures, torch.linalg.inv(to_other).float(), size)
    column, row = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in size[::-1]), indexing="xy")
    in_front = torch.einsum("pj,jhw->phw", to_other[:, 2], torch.stack([column, row, torch.ones_like(row)])) > 0
    return warped[:, :1], (warped[:, 1:] > 0.999) & in_front[:, None]


def _intrinsics(camera: Camera) -> Float[Tensor, "3 3"]:
    """Intrinsics for pixels whose centres are at whole numbers, as in kornia."""
    rows = [[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]]
    return torch.tensor(rows, dtype=torch.float64)


def _fused(views: Sequence[View], maps: Sequence[DepthMap]) -> Points:
    """A point for each pixel that another map confirms and no earlier point covers."""
    covered = [torch.zeros_like(each.z, dtype=torch.bool) for each in maps]
    places, colours, seen = [], [], []
    for i, (view, own) in enumerate(zip(views, maps, strict=True)):
        row, column = ((own.z > 0) & ~covered[i])[::STRIDE, ::STRIDE].nonzero().unbind(1)
        row, column = STRIDE * row, STRIDE * column
        pixel = torch.stack([column, row], dim=1).double() + 0.5
        xyz = lifted(own.camera, pixel, own.z[row, column].double())
        agree = torch.stack([_confirmed(own.camera, pixel, xyz, other) for other in maps])
        agree[i] = True
        found = (agree.sum(dim=0) >= 2) & ~transparent_at(view, xyz)
        for other, covers, confirmed in zip(maps, covered, agree):
            _cover(covers, other.camera, xyz[found & confirmed])
        fx, fy = view.camera.width / own.camera.width, view.camera.height / own.camera.height
        u, v = (pixel[found] * torch.tensor([fx, fy])).long().unbind(1)
        places.append(xyz[found])
        colours.append(view.image[:, v, u].T)
        seen.append(agree[:, found].T)
    observations = torch.cat(seen).nonzero()
    return Points(torch.cat(places), torch.cat(colours).float(), observations, tuple(view.name for view in views))


def _confirmed(
    camera: Camera, pixel: Float[Tensor, "n 2"], xyz: Float[Tensor, "n 3"], other: DepthMap
) -> Bool[Tensor, " n"]:
    """Whether another map has the same depth where it sees the point, and its own point there is seen at the same pixel."""
    there, z = pixel_coordinates(other.camera, xyz)
    size = torch.tensor([other.camera.width, other.camera.height])
    inside = (z > 0) & ((there >= 0) & (there < size)).all(dim=1)
    column, row = there.nan_to_num(-1, -1, -1).long().unbind(1)
    measured = torch.zeros_like(z)
    measured[inside] = other.z[row[inside], column[inside]].double()
    back, _ = pixel_coordinates(camera, lifted(other.camera, there, measured))
    same = ((measured - z).abs() < MAX_DEPTH * z) & ((back - pixel).norm(dim=1) < MAX_REPROJECTION)
    return inside & (measured > 0) & same


def _cover(covered: Bool[Tensor, "h w"], camera: Camera, xyz: Float[Tensor, "n 3"]) -> None:
    """Mark the STRIDE x STRIDE pixels round each point."""
    column, row = pixel_coordinates(camera, xyz)[0].long().unbind(1)
    height, width = covered.shape
    covered[row.div(STRIDE, rounding_mode="floor") * STRIDE % height, column // STRIDE * STRIDE % width] = True
