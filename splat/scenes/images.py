"""Photographs on disk: where they are, whether they fit their cameras, and how they are read.

A `Photo` holds what a reader of a scene format knows of an image: its file, its lens (a pycolmap camera, pixel centres at
+ 0.5 as everywhere here) and its pose.  `frame` checks the file's header against the lens and fixes the final camera:

    stored size    the lens is scaled to the file's size where the aspect ratio is the same within rounding (`images_8`)
    EXIF           a file that a quarter turn of its EXIF orientation brings to its camera's shape is turned; all others are
                   taken as they are stored, as COLMAP does
    undistortion   images of lenses that are no pinholes, fisheyes too, are resampled bilinearly into the largest pinhole image
                   without blank pixels, with the pinhole camera that pycolmap (as `colmap image_undistorter`) chooses
    downscale      a pixel becomes the mean over its footprint, fractions of pixels included: values stay in [0, 1], and
                   edges stay in place at any ratio (a box filter of whole pixels moves them by up to a quarter pixel)
    layers         masks and depth maps (`splat/scenes/layers.py`) are brought to the size of the file, then treated
                   alike; a pixel is inside its mask where all of its footprint is
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import isfinite
from pathlib import Path

import numpy as np
import pycolmap
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32
from PIL import Image, ImageOps
from torch import Tensor

from landscape.errors import InputError
from splat.model.camera import Camera
from splat.scenes.layers import opened_image, read_depth, read_mask
from splat.scenes.view import Frame, Subset, View

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")
RADIAL_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
UNDISTORTED_HERE = (
    *RADIAL_MODELS, "OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "FOV", "THIN_PRISM_FISHEYE"
)  # fmt: skip
SIXTEEN_BITS = ("I;16", "I;16B", "I;16L")  # modes of a grey picture; Pillow reads coloured ones with 8 bits
STORED = {"RGB;16B": "rgb", "RGBA;16B": "rgba"}  # of a PNG's colours of 16 bits, in Pillow's words and kornia_rs's
TURNS: dict[int, Callable[[np.ndarray], np.ndarray]] = {  # by EXIF orientation
    5: lambda pixels: pixels.swapaxes(0, 1),
    6: lambda pixels: np.rot90(pixels, 3),
    7: lambda pixels: np.rot90(pixels.swapaxes(0, 1), 2),
    8: np.rot90,
}
EXIF_ORIENTATION = 0x0112
LARGEST_SIDE = 2**31 - 1  # px; COLMAP counts them in 32 bits
SMALLEST = 4  # px a side of a reduced picture; a smaller one comes from a mistyped factor
LARGEST_DISPLACEMENT = 2  # of a corner, in half diagonals; the strongest lenses stay below 1
INSIDE = 1 - 1e-4  # share of a pixel's footprint inside the mask; below 1 by more than float32 sums can lose
Warp = Callable[[tuple[int, int], Float[Tensor, "c h w"]], Float[Tensor, "c height width"]]


@dataclass(frozen=True, eq=False)
class Photo:
    """An image file with its lens and pose (rotation: world to camera; centre: world units), both float64.

    mask, depth: the files beside it.
    """

    name: str
    path: Path
    lens: pycolmap.Camera
    rotation: Float[Tensor, "3 3"]
    centre: Float[Tensor, "3"]
    subset: Subset | None = None
    depth_range: tuple[float, float] | None = None
    mask: Path | None = None
    depth: Path | None = None


def image_folder(root: Path, images: str | None = None) -> Path:
    """The folder of a scene's photographs: the named one, by default `images`, else `images_K` with the smallest K."""
    reduced = sorted((int(m[1]), path) for path in root.iterdir() if (m := re.fullmatch(r"images_(\d+)", path.name)))
    found = [path for path in (root / "images", *(path for _, path in reduced)) if path.is_dir()]
    if images is not None and not (root / images).is_dir():
        names = ", ".join(path.name for path in found)
        offers = f"choose from {names}" if found else "the scene has no folder images or images_K either"
        raise FileNotFoundError(f"expected the image folder {root / images}, which does not exist; {offers}")
    if images is None and not found:
        raise FileNotFoundError(
            f"expected a folder images or images_K (K = 2, 4, 8 ...) in {root}, found neither; "
            "name the folder of the photographs with --images"
        )
    return found[0] if images is None else root / images


def image_files(folder: Path) -> list[Path]:
    """The image files of a folder, sorted by name; not those that macOS hides beside them (._NAME)."""
    files = (path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    return sorted(path for path in files if not path.name.startswith("."))


def image_named(path: Path) -> Path:
    """The file, or the one that has another suffix of images, or any where the name has none; the path where there is none."""
    bare = path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path
    others = (bare.with_name(bare.name + case(suffix)) for suffix in IMAGE_SUFFIXES for case in (str, str.upper))
    return next((each for each in (path, *others) if each.is_file()), path)


def require_files(paths: Sequence[Path], advice: str = "or name another folder of images with --images") -> None:
    """Raise FileNotFoundError that counts the missing image files, names the first, and says what to do."""
    missing = [path for path in paths if not path.is_file()]
    if missing:
        raise FileNotFoundError(
            f"expected {len(paths)} image files, {len(missing)} are missing, the first is {missing[0]}; "
            f"restore them, {advice}"
        )


def image_header(path: Path) -> tuple[tuple[int, int], bool]:
    """((width, height), whether it has an alpha channel), without reading the pixels."""
    with opened_image(path) as file:
        if file.mode.startswith(("I", "F")) and file.mode not in SIXTEEN_BITS:
            raise InputError(f"expected an image of 8 or 16 bits a channel, got mode {file.mode} in {path}; convert it")
        return file.size, file.has_transparency_data


def image_pixels(path: Path, turned: bool = False) -> Float32[np.ndarray, "h w c"]:
    """Red, green, blue, and alpha where the image has it, from 0 to 1.  turned: as its EXIF orientation says."""
    with opened_image(path) as file:
        if channels := _colours_of_sixteen_bits(file):
            pixels = _sixteen_bits(path, channels)
            return np.ascontiguousarray(TURNS[file.getexif()[EXIF_ORIENTATION]](pixels)) if turned else pixels
        image = ImageOps.exif_transpose(file) if turned else file
        if image.mode in SIXTEEN_BITS:
            grey = np.array(image).astype(np.float32) / np.float32(2**16 - 1)
            return np.repeat(grey[:, :, None], 3, axis=2)
        return np.array(image.convert("RGBA" if image.has_transparency_data else "RGB")).astype(np.float32) / 255


def _colours_of_sixteen_bits(file: Image.Image) -> str | None:
    """rgb or rgba of a PNG with 16 bits a colour; Pillow would keep 8."""
    stored = [STORED.get(str(tile.args)) for tile in getattr(file, "tile", ())] if file.format == "PNG" else []
    return stored[0] if stored and "transparency" not in file.info else None


def _sixteen_bits(path: Path, channels: str) -> Float32[np.ndarray, "h w c"]:
    from kornia_rs.io import read_image_png_u16  # its own, of few pictures

    try:
        pixels = np.asarray(read_image_png_u16(str(path), channels))
    except Exception as error:  # of no other type
        raise InputError(f"expected an image, cannot read {path}: {error}; replace the file") from error
    return pixels.astype(np.float32) / np.float32(2**16 - 1)


def _quarter_turned(path: Path) -> bool:
    """Whether the EXIF orientation of an image file turns it by a right angle."""
    with opened_image(path) as file:
        return file.getexif().get(EXIF_ORIENTATION) in TURNS


def checked_lens(model: str, size: tuple[float, float], params: Sequence[float], name: str) -> pycolmap.Camera:
    """The lens of a photograph of this (width, height).  ValueError where it cannot be one."""
    if not (all(map(isfinite, params)) and all(1 <= side <= LARGEST_SIDE for side in size)):
        raise InputError(
            f"the camera of image {name!r} cannot be: expected at least 1 px a side and finite numbers, got "
            f"{size[0]:g} x {size[1]:g} px and {[float(value) for value in params]}"
        )
    return pycolmap.Camera(model=model, width=round(size[0]), height=round(size[1]), params=list(params))


def frame(photo: Photo, downscale: float, background: Float[Tensor, "3"]) -> Frame:
    """The final camera of a photograph, and how to read it.  ValueError where file and lens cannot belong together."""
    size, transparent = image_header(photo.path)
    stored, across = (photo.lens.width, photo.lens.height), (size[1], size[0])
    turned = not _same_shape(stored, size) and _same_shape(stored, across) and _quarter_turned(photo.path)
    size = across if turned else size
    lens = _scaled_to(photo.lens, size, photo)
    pinhole = _pinhole(lens, photo)
    width, height = (max(1, round(side / downscale)) for side in (pinhole.width, pinhole.height))
    if downscale > 1 and min(width, height) < SMALLEST:
        raise InputError(
            f"expected pictures of at least {SMALLEST} px a side, got {width} x {height} px for {photo.name!r} at downscale "
            f"{downscale:g}; reduce less"
        )
    fx, fy, cx, cy = pinhole.calibration_matrix()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    try:
        full = Camera(photo.rotation, photo.centre, fx, fy, cx, cy, pinhole.width, pinhole.height)
    except InputError as error:
        raise InputError(f"the camera of image {photo.name!r} cannot be: {error}") from error
    picture = partial(_view, photo, turned, partial(_warp, lens, pinhole), background)
    layers = {"alpha": transparent, "mask": photo.mask, "depth": photo.depth}
    named = frozenset(name for name, there in layers.items() if there)
    distortion = "" if pinhole is lens else f"{lens.model_name} {', '.join(f'{value:.12g}' for value in lens.params)}"
    files = photo.path, named, distortion, photo.mask, photo.depth
    camera, whole = full.resized(width, height), (pinhole.width, pinhole.height)
    return Frame(photo.name, camera, picture, photo.subset, photo.depth_range, *files, whole)


def _scaled_to(lens: pycolmap.Camera, size: tuple[int, int], photo: Photo) -> pycolmap.Camera:
    """The lens at the file's size, which must be its own, scaled."""
    width, height = size
    if (lens.width, lens.height) == size:
        return lens
    if not _same_shape((lens.width, lens.height), size):
        raise InputError(
            f"expected image {photo.name!r} at the {lens.width} x {lens.height} px of its camera or scaled from it, "
            f"got {width} x {height} px in {photo.path}; it was cropped, rotated or stretched: use the images that the "
            "cameras were computed from, or compute the cameras anew"
        )
    scaled = pycolmap.Camera(lens.todict())
    scaled.rescale(width, height)
    return scaled


def _same_shape(old: tuple[int, int], new: tuple[int, int]) -> bool:
    """Whether some scale s, rounded either way, brings (w, h) to the new size."""
    if min(old) < 1:
        return False
    low = max((side - 1) / before for side, before in zip(new, old))
    high = min((side + 1) / before for side, before in zip(new, old))
    return low < high


def _pinhole(lens: pycolmap.Camera, photo: Photo) -> pycolmap.Camera:
    """The lens of the undistorted image: the lens itself where it is a pinhole."""
    model = lens.model_name
    if model in PINHOLE_MODELS:
        return lens
    if model not in UNDISTORTED_HERE:
        raise InputError(
            f"expected a pinhole lens or one that can be undistorted ({', '.join(UNDISTORTED_HERE)}), got "
            f"{model} for image {photo.name!r}; make pinhole images first: colmap image_undistorter --image_path "
            f"{photo.path.parent} --input_path MODEL --output_path NEW_SCENE, where MODEL is the folder of cameras.bin"
        )
    if lens.is_undistorted():
        return lens
    if not _displacement(lens) <= LARGEST_DISPLACEMENT:
        raise InputError(
            f"the camera of image {photo.name!r} cannot be: expected distortion that moves no corner by more than "
            f"{LARGEST_DISPLACEMENT} half diagonals of the picture, got {model} with {lens.params_to_string()}"
        )
    return pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens)


def _displacement(lens: pycolmap.Camera) -> float:
    """The largest distance that the distortion moves a corner of the picture, in units of its half diagonal."""
    size = np.array([lens.width, lens.height])
    corners = size * [[0, 0], [1, 0], [0, 1], [1, 1]]
    (fx, _, cx), (_, fy, cy), _ = lens.calibration_matrix()
    rays = np.column_stack([(corners - (cx, cy)) / (fx, fy), np.ones(4)])
    return float(np.hypot(*(np.asarray(lens.img_from_cam(rays)) - corners).T).max() / np.hypot(*size / 2))


def _view(photo: Photo, turned: bool, warp_to: Warp, background: Float[Tensor, "3"], camera: Camera) -> View:
    """Composite over the background, undistort, downscale: in this order, no transparent colour bleeds in."""
    warp = partial(warp_to, (camera.width, camera.height))
    layers = torch.from_numpy(image_pixels(photo.path, turned)).permute(2, 0, 1)
    size = (layers.shape[2], layers.shape[1])
    if has_alpha := len(layers) == 4:
        rgb, alpha = layers[:3], layers[3:]
        layers = torch.cat([rgb * alpha + background[:, None, None] * (1 - alpha), alpha])
    layers = warp(layers).clamp(0, 1)
    mask = depth = None
    if photo.mask:
        mask = warp(_at_size(read_mask(photo.mask), size, photo.mask))[0] >= INSIDE
        if not mask.any():
            raise InputError(
                f"expected a mask with whole pixels inside, got none in {photo.mask} at this size; reduce less"
            )
    if photo.depth:
        depth = warp(_at_size(read_depth(photo.depth), size, photo.depth))[0]
    return View(photo.name, camera, layers[:3], layers[3] if has_alpha else None, mask, depth)


def _at_size(layers: Float[Tensor, "c h w"], size: tuple[int, int], path: Path) -> Tensor:
    """A mask or depth map at the size of its photograph, whose shape it must have."""
    height, width = layers.shape[1:]
    made = (width, height)
    # the rounding is of the one that was made of the other
    if not (_same_shape(made, size) or _same_shape(size, made)):
        raise InputError(
            f"expected {path} to have the shape of its photograph, {size[0]} x {size[1]} px at any scale, got "
            f"{width} x {height}; make it from that photograph"
        )
    return resize_by_area(layers, *size)


def _warp(
    lens: pycolmap.Camera, pinhole: pycolmap.Camera, size: tuple[int, int], layers: Float[Tensor, "c h w"]
) -> Tensor:
    """Undistort and downscale: from the pixels of the file to those of the final camera."""
    if pinhole is not lens:
        layers = _undistort(layers, lens, pinhole)
    return resize_by_area(layers, *size)


def _undistort(layers: Float[Tensor, "c h w"], lens: pycolmap.Camera, pinhole: pycolmap.Camera) -> Tensor:
    """The picture that the pinhole camera would have taken: look up where each of its rays meets the stored image."""
    column, row = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    rays = np.asarray(pinhole.cam_from_img(np.stack([column, row], axis=-1).reshape(-1, 2)))
    source = np.asarray(lens.img_from_cam(np.concatenate([rays, np.ones((len(rays), 1))], axis=1)))
    # grid_sample's coordinates with align_corners=False: -1 and 1 are the outer edges of the image
    grid = torch.from_numpy(source / [lens.width, lens.height] * 2 - 1).to(layers)
    grid = grid.view(1, pinhole.height, pinhole.width, 2)
    return F.grid_sample(layers[None], grid, mode="bilinear", padding_mode="border", align_corners=False)[0]


def resize_by_area(layers: Float[Tensor, "c h w"], width: int, height: int) -> Float[Tensor, "c height width"]:
    """Every new pixel is the mean over its footprint, fractions of old pixels included."""
    if layers.shape[1:] == (height, width):
        return layers
    rows, columns = (_footprints(old, new).to(layers) for old, new in zip(layers.shape[1:], (height, width)))
    return rows @ layers @ columns.T


def _footprints(old: int, new: int) -> Float[Tensor, "new old"]:
    """The share of each old pixel [j, j + 1] in each new pixel [i, i + 1] old / new; rows sum to 1."""
    edges = torch.arange(new + 1, dtype=torch.float64) * (old / new)
    start = torch.arange(old, dtype=torch.float64)
    overlap = torch.minimum(edges[1:, None], start + 1) - torch.maximum(edges[:-1, None], start)
    return overlap.clamp_min(0) * (new / old)
