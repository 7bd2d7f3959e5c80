"""The parts of a scene: views, frames whose pictures are not read yet, and points.

    View    a camera with its picture, as training and evaluation use it
    Frame   a camera whose picture is read from disk by `view()`, and larger by `whole_view()`; the camera is already final
    Photograph  a view of a frame, whose picture is read when it is used
    Points  coloured points of the scene, from structure from motion or a scanner, and the images that see each of them

Pictures are (3, h, w) float32 in [0, 1], in the encoding of the file (no linearisation), composited over the scene's
background where the file has an alpha channel.  World units and axes are those of the scene's files.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from landscape.errors import InputError
from landscape.results import ShortRepr
from splat.model.camera import Camera

Subset = Literal["train", "test"]


@dataclass(frozen=True, eq=False, repr=False)
class View(ShortRepr):
    """A camera and its picture.  InputError where their sizes differ.

    alpha: coverage in [0, 1] where the file has an alpha channel.  mask: the pixels that metrics count, where the scene
    has masks.  depth: relative depth or disparity, in any unit, where a folder of depth maps was given.

    >>> level = Camera(torch.eye(3), torch.zeros(3), fx=20.0, fy=20.0, cx=4.0, cy=3.0, width=8, height=6)
    >>> View("grey", level, torch.full((3, 6, 8), 0.5)).image.shape
    torch.Size([3, 6, 8])
    """

    name: str
    camera: Camera
    image: Float[Tensor, "3 h w"]
    alpha: Float[Tensor, "h w"] | None = None
    mask: Bool[Tensor, "h w"] | None = None
    depth: Float[Tensor, "h w"] | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        layers = [layer for layer in (self.alpha, self.mask, self.depth) if layer is not None]
        if self.image.shape != (3, *size) or any(layer.shape != size for layer in layers):
            raise InputError(
                f"expected the picture of {self.name!r} to be (3, {size[0]}, {size[1]}) as its camera, got "
                f"{tuple(self.image.shape)}; resize the picture, or the camera with Camera.resized"
            )

    def with_image(self, image: Float[Tensor, "3 h w"]) -> "View":
        """The same view of another picture."""
        return View(self.name, self.camera, image, self.alpha, self.mask, self.depth)


@dataclass(frozen=True, eq=False)
class Frame:
    """A posed picture that `view()` reads.

    picture: reads it for a camera, at that camera's size.  subset: the part that the scene's own files assign it to.
    depth_range: nearest and farthest depth of the scene content, world units.  None where the files do not say.  path: of the
    picture, None where it is not on disk.  layers: which of alpha, mask and depth its view has; mask, depth: the files.
    distortion: model and parameters of its lens, where that was no pinhole.  whole: (width, height) of the photograph, px,
    before it is reduced; None: that of the camera.
    """

    name: str
    camera: Camera
    picture: Callable[[Camera], View]
    subset: Subset | None = None
    depth_range: tuple[float, float] | None = None
    path: Path | None = None
    layers: frozenset[str] = frozenset()
    distortion: str = ""
    mask: Path | None = None
    depth: Path | None = None
    whole: tuple[int, int] | None = None

    def view(self) -> View:
        return self.picture(self.camera)

    def whole_view(self) -> View:
        """The view at the size of its photograph."""
        return self.picture(self.camera.resized(*self.whole) if self.whole else self.camera)

    @property
    def bytes(self) -> int:
        """Estimated memory of the view."""
        return (3 + len(self.layers)) * self.camera.width * self.camera.height * torch.float32.itemsize


class Photograph(View):
    """A view whose picture and what belongs to it are read when they are used, and may be read again.  read: keeps the last."""

    def __init__(self, frame: Frame, read: Callable[[Frame], View]):
        for name, value in {"name": frame.name, "camera": frame.camera, "_frame": frame, "_read": read}.items():
            object.__setattr__(self, name, value)

    def __getattribute__(self, name: str) -> Any:
        if name not in ("image", "alpha", "mask", "depth"):
            return object.__getattribute__(self, name)
        frame: Frame = self._frame  # pyright: ignore[reportAttributeAccessIssue]
        return getattr(self._read(frame), name) if name == "image" or name in frame.layers else None  # pyright: ignore[reportAttributeAccessIssue]


@dataclass(frozen=True, eq=False)
class Points:
    """n coloured points.

    xyz: float64, world units; rgb: float32 in [0, 1].  observations: rows (point, image), each once, where image counts
    `names`; None where the file does not say which images see a point.
    """

    xyz: Float[Tensor, "n 3"]
    rgb: Float[Tensor, "n 3"]
    observations: Int[Tensor, "m 2"] | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.xyz.ndim != 2 or self.xyz.shape[1] != 3 or self.rgb.shape != self.xyz.shape:
            raise InputError(
                f"expected xyz and rgb of shape (n, 3), got {tuple(self.xyz.shape)} and {tuple(self.rgb.shape)}"
            )
        if not bool(torch.isfinite(self.xyz).all()):
            raise InputError("expected finite points, got some that are not; remove them from the scene's point file")
        if self.observations is not None and self.observations.numel():
            point, image = self.observations.amax(dim=0).tolist()
            if point >= len(self.xyz) or image >= len(self.names) or int(self.observations.min()) < 0:
                raise InputError(
                    f"expected observations of {len(self.xyz)} points in {len(self.names)} images, "
                    f"got point {point} in image {image}"
                )

    def __len__(self) -> int:
        return len(self.xyz)

    def sightings(self, views: Sequence[View | Frame]) -> Int[Tensor, " n"]:
        """The number of these views that see each point: by its track or, without tracks, because it lies in the image."""
        if self.observations is None:
            inside = [inside_image(view.camera, self.xyz) for view in views]
            return torch.stack(inside).sum(dim=0) if inside else torch.zeros(len(self), dtype=torch.int64)
        wanted = {view.name for view in views}
        counts = torch.tensor([name in wanted for name in self.names], dtype=torch.bool)[self.observations[:, 1]]
        return torch.bincount(self.observations[counts, 0], minlength=len(self))


def pixel_coordinates(camera: Camera, xyz: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 2"], Float[Tensor, " n"]]:
    """Positions of points in the image (px) and depths z (world units); meaningless where z <= 0."""
    x, y, z = ((xyz - camera.centre.to(xyz)) @ camera.rotation.to(xyz).T).unbind(-1)
    return torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=-1), z


def lifted(camera: Camera, pixel: Float[Tensor, "n 2"], z: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """The points at these pixels and depths, world frame."""
    x, y = (pixel[:, 0] - camera.cx) / camera.fx * z, (pixel[:, 1] - camera.cy) / camera.fy * z
    return camera.centre + torch.stack([x, y, z], dim=1) @ camera.rotation


def inside_image(
    camera: Camera, xyz: Float[Tensor, "n 3"], depth_range: tuple[float, float] | None = None
) -> Bool[Tensor, " n"]:
    """Mask of the points in front of the camera, within the depth range (z), and inside its image."""
    pixel, z = pixel_coordinates(camera, xyz)
    near, far = depth_range or (0.0, float("inf"))
    u, v = pixel.unbind(-1)
    return (z > near) & (z < far) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)


def transparent_at(view: View, xyz: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Mask of the points on a pixel of the view whose alpha is 0."""
    found = torch.zeros(len(xyz), dtype=torch.bool)
    if view.alpha is not None:
        inside = inside_image(view.camera, xyz)
        u, v = pixel_coordinates(view.camera, xyz[inside])[0].long().unbind(-1)
        found[inside] = view.alpha[v, u] == 0
    return found
