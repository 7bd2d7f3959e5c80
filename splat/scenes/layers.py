"""Image files, and the files beside a photograph that give a number for each of its pixels: object mask, depth map.

mask    an image file, black outside and white inside: a pixel is inside if every colour has at least half of the file's largest
        value (255, or 1 in a mask of 0 and 1).  Where the file has an alpha channel that varies, that is the mask, not the
        colours.  Labels, colours and soft edges over large parts are refused
depth   NAME.npy, or NAME.png of 16 bits: relative monocular depth, in any unit.  The numbers are kept as they are; whether
        larger means farther (depth) or nearer (disparity, as MiDaS and DPT give it) is for the method that uses them

A file is found by the photograph's name, with its suffix replaced or followed by another, in the folder or below it as in the
scene (`train/r_3` in `train/r_3.npy` or `r_3.npy`); the masks of DTU by the number of the view.
"""

import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from landscape.errors import InputError
from splat.model.untrusted import ImageFile, open_image, read_array, require_content

MASK_SUFFIXES = (".png", ".jpg", ".jpeg")
DEPTH_SUFFIXES = (".npy", ".png")
MASK_FOLDERS = ("mask", "masks")
SIXTEEN_BITS = ("I;16", "I;16B", "I")
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")
UNCLEAR = (0.25, 0.75)  # of the largest value: what has a colour above the one and another below the other is neither
MOST_UNCLEAR = 0.1  # of the pixels that are not black; edges of a mask, and JPEG's noise round them, are less
MOST_LABELS = 64  # a larger number than 1 up to here counts objects
STRIP = 256  # rows of a mask at a time: a large one would take a GB in all its copies
# raised by Pillow for damaged files
UNREADABLE = (OSError, SyntaxError, ValueError, EOFError, struct.error, Image.DecompressionBombError)


@contextmanager
def opened_image(path: Path, kind: str = "an image") -> Iterator[Image.Image]:
    """An image file, open.  InputError that says which kind was expected, where it cannot be read or is too large."""
    require_content(path)
    try:
        with ImageFile(path) as content:
            try:
                file = open_image(content, FORMATS)
            except InputError as error:
                raise InputError(f"expected {kind}, got one of {error} in {path}; reduce it") from None
            with file:
                yield file
    except InputError:
        raise
    except UNREADABLE as error:
        raise InputError(f"expected {kind}, cannot read {path}: {error}; replace the file") from error


def dtu_number(name: str) -> int | None:
    """The number of a DTU view, from 0, in the protocol and the masks; None for any other name.

    >>> dtu_number("images/rect_026_3_r5000.png"), dtu_number("IMG_026.png")
    (25, None)
    """
    match = re.fullmatch(r"(?:.*/)?rect_(\d{3})_(?:[0-6]_r\d+|max)\.\w+", name)
    return int(match[1]) - 1 if match else None


def find_layer(folder: Path, names: Sequence[str], suffixes: Sequence[str]) -> Path | None:
    """The file in the folder that belongs to a photograph of one of these names."""
    stems = []
    for name in names:
        path = PurePosixPath(name)
        stems += [str(path), str(path.with_suffix("")), path.name, path.stem]
        number = dtu_number(name)
        if number is not None:
            stems.append(f"{number:03d}")
    candidates = (folder / f"{stem}{suffix}" for stem in stems for suffix in suffixes)
    return next((path for path in candidates if path.is_file()), None)


def read_mask(path: Path) -> Float[Tensor, "1 h w"]:
    """1 inside, 0 outside."""
    with opened_image(path, "a mask") as file:
        file.load()
        low, high = _range_of_colours(file, alpha=file.has_transparency_data)
        if file.has_transparency_data and low.min() == low.max():
            low, high = _range_of_colours(file, alpha=False)
    white = int(high.max())
    if white <= 0:
        raise InputError(f"expected a mask with something inside, got one that is black all over in {path}; remove it")
    between = float((low < UNCLEAR[1] * white)[(high > UNCLEAR[0] * white)].mean())
    if between > MOST_UNCLEAR or 1 < white <= MOST_LABELS:
        raise InputError(
            f"expected a mask of black outside and white inside, got numbers up to {white} and {between:.0%} of the pixels "
            f"that are not black in colours or half dark in {path}: labels, or a soft mask; write 255 for what counts, else 0"
        )
    return torch.from_numpy(low >= white / 2).to(torch.float32)[None]


def _range_of_colours(file: Image.Image, *, alpha: bool) -> tuple[np.ndarray, np.ndarray]:
    """The smallest and the largest of each pixel's colours, or its alpha twice, (h, w) each."""
    tops = range(0, file.height, STRIP)
    strips = [_channels(file.crop((0, y, file.width, min(y + STRIP, file.height))), alpha) for y in tops]
    ends = zip(*((strip.min(axis=2), strip.max(axis=2)) for strip in strips))
    low, high = (np.concatenate(parts) for parts in ends)
    return low, high


def _channels(image: Image.Image, alpha: bool) -> np.ndarray:
    """The colours, or the alpha alone, (h, w, c)."""
    if alpha:
        return np.array(image.convert("RGBA"))[..., 3:]
    pixels = np.array(image if image.mode in ("L", "RGB", *SIXTEEN_BITS) else image.convert("RGB"))
    return np.atleast_3d(pixels)


def read_depth(path: Path) -> Float[Tensor, "1 h w"]:
    """The numbers of the file, checked."""
    if path.suffix == ".npy":
        require_content(path)
        try:
            with path.open("rb") as stream:
                values = read_array(stream)
        except (OSError, ValueError) as error:
            raise InputError(f"expected a depth map, cannot read {path}: {error}; write it again") from error
    else:
        with opened_image(path, "a depth map") as file:
            if file.mode not in SIXTEEN_BITS:
                raise InputError(
                    f"expected depth of 16 bits, got mode {file.mode}, too few levels, in {path}; write it again"
                )
            values = np.array(file)
    shape, values = values.shape, values.squeeze()
    if values.ndim != 2 or not values.size:
        raise InputError(f"expected a depth map of shape (h, w), got {values.dtype} of shape {shape} in {path}")
    with np.errstate(over="ignore"):  # what becomes infinite is refused
        values = values.astype(np.float32)
    if not np.isfinite(values).all():
        raise InputError(
            f"expected finite depths, got {(~np.isfinite(values)).sum()} that are not in {path}; fill them"
        )
    if values.min() == values.max():
        raise InputError(f"expected depths that vary, got {values.min()} everywhere in {path}; write it again")
    return torch.from_numpy(values)[None]
