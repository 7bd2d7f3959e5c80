"""Photographs: found, fitted to their cameras, undistorted, composited and reduced."""

import shutil
import struct
import tracemalloc
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splat.model.camera import Camera
from splat.scenes.images import image_pixels, resize_by_area
from splat.scenes.scene import load_scene
from tests.oracles import distorted_picture, opencv_distortion
from tests.refusals import refused
from tests.splat.scenes import folders
from tests.splat.scenes.folders import CENTRE, FOCAL, NAMES, SIZE, intrinsics

LENS = {"k1": -0.22, "k2": 0.07, "p1": 0.004, "p2": -0.003}
LENS_SIZE, LENS_INTRINSICS = (160, 120), (130.0, 128.0, 78.0, 61.5)


def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth coloured pattern on the plane z = 1, values in [0.1, 0.9]."""
    phases = np.stack([7 * x + 3 * y, 8 * y - 2 * x, 5 * x * x + 6 * y], axis=-1)
    return 0.5 + 0.4 * np.sin(phases)


def write_colmap_lens(root: Path, kind: str, terms: Iterable[float], scale: int = 1) -> None:
    model = folders.reconstruction(kind, (*(scale * value for value in LENS_INTRINSICS), *terms))
    model.cameras[1].width, model.cameras[1].height = (scale * side for side in LENS_SIZE)
    folders.write_colmap(root, model=model)


def undistorted(root: Path, exact: np.ndarray) -> tuple[Camera, list[np.ndarray], np.ndarray, float]:
    """The camera that a scene of this picture is loaded with, its pixels' centres, the waves there, and the picture's error.

    The error is held to its bound: rounding to 8 bits, and bilinear interpolation, an eighth of the second derivatives along
    both sides of a pixel.
    """
    for name in NAMES:
        Image.fromarray((exact * 255).round().astype(np.uint8)).save(root / "images" / name)
    view = load_scene(root).load()[0]
    camera = view.camera
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    wanted = waves((column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy)
    bent = sum(np.abs(np.diff(exact, n=2, axis=axis)).max() for axis in (0, 1))
    error = float(np.abs(view.image.permute(1, 2, 0).numpy() - wanted).max())
    assert error <= 0.5 / 255 + bent / 8
    return camera, [column, row], wanted, error


@pytest.mark.parametrize("kind", ["transforms", "colmap"])
def test_a_distorted_picture_becomes_that_of_the_pinhole_camera(tmp_path: Path, kind: str) -> None:
    lens = {**LENS, "k3": 0.02} if kind == "transforms" else LENS
    exact = distorted_picture(waves, LENS_INTRINSICS, LENS_SIZE, lens)
    if kind == "transforms":
        intrinsics_of_lens = dict(zip(("fl_x", "fl_y", "cx", "cy"), LENS_INTRINSICS))
        folders.write_transforms(tmp_path, **intrinsics_of_lens, w=LENS_SIZE[0], h=LENS_SIZE[1], **lens)
    else:
        write_colmap_lens(tmp_path, "OPENCV", lens.values())
    camera, (column, row), wanted, error = undistorted(tmp_path, exact)
    half_a_pixel = np.abs(waves((column + 0.5 - camera.cx) / camera.fx, (row - camera.cy) / camera.fy) - wanted)
    assert half_a_pixel.max() > 5 * error  # the pattern would show a shift

    edge = np.stack([column, row], -1)[[0, 0, -1, -1], [0, -1, 0, -1]]
    rays = (edge - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    x, y = opencv_distortion(rays[:, 0], rays[:, 1], lens)
    fx, fy, cx, cy = LENS_INTRINSICS
    for pixel, side in ((fx * x + cx, LENS_SIZE[0]), (fy * y + cy, LENS_SIZE[1])):
        assert pixel.min() > -0.5 and pixel.max() < side + 0.5  # the corners lie in the photograph, or on its edge


@pytest.mark.parametrize("kind", ["transforms", "colmap"])
def test_a_fisheye_picture_becomes_that_of_the_pinhole_camera(tmp_path: Path, kind: str) -> None:
    """theta_d = theta (1 + k1 theta^2 + ...), theta the angle to the axis, inverted by Newton's method."""
    (fx, fy, cx, cy), terms = LENS_INTRINSICS, (0.05, -0.02, 0.01, -0.004)
    column, row = np.meshgrid(np.arange(LENS_SIZE[0]) + 0.5, np.arange(LENS_SIZE[1]) + 0.5)
    x, y = (column - cx) / fx, (row - cy) / fy
    distance = np.hypot(x, y)
    theta = distance.copy()
    for _ in range(20):
        powers = [theta ** (2 * i + 2) for i in range(4)]
        value = theta * (1 + sum(k * p for k, p in zip(terms, powers))) - distance
        theta -= value / (1 + sum((2 * i + 3) * k * p for i, (k, p) in enumerate(zip(terms, powers))))
    stretch = np.tan(theta) / distance
    exact = waves(x * stretch, y * stretch)
    if kind == "transforms":
        named = dict(zip(("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"), (fx, fy, cx, cy, *terms)))
        folders.write_transforms(tmp_path, **named, w=LENS_SIZE[0], h=LENS_SIZE[1], camera_model="OPENCV_FISHEYE")
    else:
        write_colmap_lens(tmp_path, "OPENCV_FISHEYE", terms)
    undistorted(tmp_path, exact)


def test_a_photograph_is_turned_by_its_exif_where_only_that_fits_its_camera(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path)
    upright = Image.open(tmp_path / "images/a.png")
    wanted = load_scene(tmp_path).load()[0].image
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned by 90 degrees clockwise
    upright.transpose(Image.Transpose.ROTATE_90).save(tmp_path / "images/a.png", exif=exif)
    assert torch.equal(load_scene(tmp_path).load()[0].image, wanted)
    upright.save(tmp_path / "images/a.png", exif=exif)  # it fits as it is stored, as COLMAP reads it
    assert torch.equal(load_scene(tmp_path).load()[0].image, wanted)


def test_grey_pictures_of_16_bits_keep_all_of_them(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path)
    grey = np.arange(SIZE[0] * SIZE[1], dtype=np.uint16).reshape(SIZE[::-1]) * 150
    Image.fromarray(grey).save(tmp_path / "images/a.png")
    image = load_scene(tmp_path).load()[0].image
    np.testing.assert_allclose(image.numpy(), np.broadcast_to(grey / 65535, (3, *grey.shape)), atol=1e-7)


@pytest.mark.parametrize("channels", [3, 4])
def test_coloured_pictures_of_16_bits_keep_all_of_them(tmp_path: Path, channels: int) -> None:
    folders.write_transforms(tmp_path)
    pixels = np.random.default_rng(0).integers(0, 65536, (SIZE[1], SIZE[0], channels), dtype=np.uint16)
    exif = Image.Exif()

    def stored(pixels: np.ndarray, *more: bytes) -> None:
        rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
        height, width = pixels.shape[:2]
        content = (*more, b"IDAT" + zlib.compress(rows), b"IEND")
        (tmp_path / "images/a.png").write_bytes(png(width, height, *content, bits=16, kind={3: 2, 4: 6}[channels]))

    stored(pixels)
    view = load_scene(tmp_path).load()[0]
    values = pixels / 65535
    alpha = values[..., 3:] if channels == 4 else 1.0  # on white, as of any scene with an alpha channel
    wanted = values[..., :3] * alpha + (1 - alpha)
    np.testing.assert_allclose(view.image.permute(1, 2, 0).numpy(), wanted, atol=1e-6)
    for orientation, turn in {
        5: lambda a: a.swapaxes(0, 1),
        6: lambda a: np.rot90(a),
        7: lambda a: np.rot90(a, 2).swapaxes(0, 1),
        8: lambda a: np.rot90(a, -1),
    }.items():
        exif[0x0112] = orientation
        stored(turn(pixels), b"eXIf" + exif.tobytes().removeprefix(b"Exif\0\0"))
        assert torch.equal(load_scene(tmp_path).load()[0].image, view.image), orientation
    (tmp_path / "images/a.png").write_bytes((tmp_path / "images/a.png").read_bytes()[:-40])
    refused(r"cannot read .*a\.png", load_scene(tmp_path).load)


@pytest.mark.parametrize("absurd", [{"k1": 1e30}, {"k1": -1e30}, {"k1": -20.0}, {"p2": 1e6}, {"k3": 1e300}])
def test_distortion_that_is_no_lens_is_refused(tmp_path: Path, absurd: dict[str, float]) -> None:
    folders.write_transforms(tmp_path / "transforms", **absurd)
    if "k3" not in absurd:
        lens = {**dict.fromkeys(LENS, 0.0), **absurd}
        model = folders.reconstruction("OPENCV", (*FOCAL, *CENTRE, *lens.values()))
        folders.write_colmap(tmp_path / "colmap", model=model)
    for folder in tmp_path.iterdir():
        refused(r"'(images/)?a.png' cannot be: expected distortion .*OPENCV", load_scene, folder)


def test_lenses_as_strong_as_they_are_made_are_taken(tmp_path: Path) -> None:
    """An action camera's barrel distortion, and a pincushion; both with corners about a half off the axis."""
    for name, lens in (("barrel", {"k1": -0.45, "k2": 0.25, "k3": -0.08}), ("pincushion", {"k1": 0.8, "k2": 0.3})):
        folders.write_transforms(tmp_path / name, **lens)
        assert len(load_scene(tmp_path / name).frames) == 3


def test_a_distorted_picture_smaller_than_its_camera_is_scaled_first(tmp_path: Path) -> None:
    for folder, scale in (("small", 2), ("same", 1)):
        write_colmap_lens(tmp_path / folder, "OPENCV", LENS.values(), scale)
        folders.write_pictures(tmp_path / folder / "images", size=LENS_SIZE)
    small, same = (load_scene(tmp_path / folder).load()[0] for folder in ("small", "same"))
    assert small.camera.fx == pytest.approx(same.camera.fx, rel=folders.ROUND_OFF)
    torch.testing.assert_close(small.image, same.image, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("old", "new"), [((7, 5), (3, 2)), ((12, 8), (4, 4)), ((9, 9), (9, 2)), ((5, 4), (1, 1))])
def test_reducing_averages_over_each_pixels_footprint(old: tuple[int, int], new: tuple[int, int]) -> None:
    image = np.random.default_rng(0).random((2, old[1], old[0]))
    fine = image.repeat(new[1], axis=1).repeat(new[0], axis=2)  # every old pixel as new[0] x new[1] equal ones
    wanted = fine.reshape(2, new[1], old[1], new[0], old[0]).mean(axis=(2, 4))
    np.testing.assert_allclose(resize_by_area(torch.from_numpy(image), *new).numpy(), wanted, atol=1e-14)


def test_downscale_reduces_picture_and_camera_alike(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path)
    view = load_scene(tmp_path, downscale=2).load()[0]
    full = np.array(Image.open(tmp_path / "images/a.png")) / 255
    blocks = full.reshape(9, 2, 12, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(view.image.permute(1, 2, 0).numpy(), blocks, atol=1e-6)
    assert (view.camera.fx, view.camera.cy, view.camera.width) == (FOCAL[0] / 2, CENTRE[1] / 2, 12)


def test_downscale_rounds_the_size_and_keeps_the_field_of_view(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path)
    camera = load_scene(tmp_path, downscale=5).frames[0].camera
    assert (camera.width, camera.height) == (5, 4)
    assert camera.fx / camera.width == pytest.approx(FOCAL[0] / SIZE[0], rel=folders.ROUND_OFF)
    assert camera.fy / camera.height == pytest.approx(FOCAL[1] / SIZE[1], rel=folders.ROUND_OFF)


def test_a_downscale_that_leaves_no_picture_is_refused(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path)  # 24 x 18 px
    refused(r"at least 4 px a side, got 4 x 3 px for 'images/a.png' at downscale 6", load_scene, tmp_path, downscale=6)


def test_transparent_pixels_show_the_background_and_never_their_own_colour(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path)
    pixels = np.zeros((SIZE[1], SIZE[0], 4), dtype=np.uint8)
    pixels[..., 0] = 255
    pixels[:, 12:, 3] = 255
    pixels[:, 11, 3] = 51
    for name in NAMES:
        Image.fromarray(pixels).save(tmp_path / "images" / name)
    white = load_scene(tmp_path).load()[0]
    blue = load_scene(tmp_path, background=(0, 0, 1), downscale=2).load()[0]
    assert white.alpha is not None and blue.alpha is not None
    assert white.image[:, 0, 0].tolist() == [1, 1, 1] and white.image[:, 0, 12].tolist() == [1, 0, 0]
    torch.testing.assert_close(white.image[:, 0, 11], torch.tensor([1.0, 0.8, 0.8]))
    torch.testing.assert_close(blue.image[:, 0, 5], torch.tensor([0.1, 0.0, 0.9]))
    torch.testing.assert_close(blue.alpha[0], torch.tensor([0.0] * 5 + [0.1] + [1.0] * 6))


@pytest.mark.parametrize("size", [(SIZE[0], SIZE[1] - 2), (SIZE[1], SIZE[0]), (SIZE[0] // 2, SIZE[1])])
def test_a_picture_that_cannot_be_its_cameras_is_refused_with_both_sizes(tmp_path: Path, size: tuple[int, int]) -> None:
    folders.write_transforms(tmp_path)
    folders.write_pictures(tmp_path / "images", NAMES[1:2], size)
    message = rf"'images/b.png' at the {SIZE[0]} x {SIZE[1]} px .* got {size[0]} x {size[1]} px"
    refused(message, load_scene, tmp_path)


@pytest.mark.parametrize("size", [(7, 5), (8, 6), (72, 54), (15, 11)])
def test_a_picture_of_the_same_shape_scales_its_camera(tmp_path: Path, size: tuple[int, int]) -> None:
    folders.write_transforms(tmp_path)
    folders.write_pictures(tmp_path / "images", size=size)
    x, y = size[0] / SIZE[0], size[1] / SIZE[1]
    wanted = (FOCAL[0] * x, FOCAL[1] * y, CENTRE[0] * x, CENTRE[1] * y, *size)
    np.testing.assert_allclose(intrinsics(load_scene(tmp_path)), [wanted] * 3, rtol=folders.ROUND_OFF)


def test_the_largest_image_folder_is_taken_and_images_overrides(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path)
    shutil.rmtree(tmp_path / "images")
    for k, size in ((8, (3, 2)), (2, (12, 9)), (16, (2, 1))):
        folders.write_pictures(tmp_path / f"images_{k}", size=size)
    assert load_scene(tmp_path).frames[0].camera.width == 12
    assert load_scene(tmp_path, images="images_8").frames[0].camera.width == 3
    with pytest.raises(FileNotFoundError, match="images_4, which does not exist; choose from images_2, "):
        load_scene(tmp_path, images="images_4")


def test_files_that_are_no_pictures_or_have_real_numbers_are_refused(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path)
    path = tmp_path / "images/c.png"
    whole = path.read_bytes()
    path.write_bytes(whole[:-300])
    refused(r"cannot read .*c\.png", load_scene(tmp_path).load)  # when it is read
    path.write_bytes(b"no picture")
    refused(r"cannot read .*c\.png", load_scene, tmp_path)
    Image.new("RGB", SIZE).save(path, format="EPS")  # which another program would read
    refused(r"cannot read .*c\.png: cannot identify", load_scene, tmp_path)
    Image.fromarray(np.zeros((SIZE[1], SIZE[0]), dtype=np.float32)).save(path.with_suffix(".tiff"))
    path.with_suffix(".tiff").rename(path)
    refused(r"16 bits a channel, got mode F in .*c\.png", load_scene, tmp_path)


def png(width: int, height: int, *chunks: bytes, bits: int = 8, kind: int = 2) -> bytes:
    """The bytes of a PNG file of colours with these chunks after its header.  kind: 2 of RGB, 6 with alpha."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) for chunk in (header, *chunks)
    )


def test_pictures_that_promise_too_much_or_are_damaged_inside_are_refused(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path)
    path = tmp_path / "images/c.png"
    path.write_bytes(png(160_000, 120_000, b"IDAT"))
    refused(r"cannot read .*c\.png.*exceeds limit", load_scene, tmp_path)
    path.write_bytes(png(*SIZE, b"IDAT" + zlib.compress(b"x"), b"\x91\x02\xe3|", b"IEND"))
    refused(r"cannot read .*c\.png.*broken PNG", load_scene(tmp_path).load)


@pytest.mark.parametrize("mode", ["L", "P", "LA", "1"])
def test_grey_and_palette_pictures_become_colour(tmp_path: Path, mode: str) -> None:
    folders.write_transforms(tmp_path)
    image = Image.open(tmp_path / "images/a.png").convert(mode)
    image.save(tmp_path / "images/a.png")
    wanted = np.array(image.convert("RGB")) / 255
    np.testing.assert_allclose(load_scene(tmp_path).load()[0].image.permute(1, 2, 0).numpy(), wanted, atol=1e-7)


def test_a_chunk_takes_no_more_memory_than_the_file_has_bytes(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path)
    path = tmp_path / "images/a.png"
    content = bytearray(path.read_bytes())
    content[content.index(b"IDAT") - 4] = 0x40  # a length of 1 GiB
    path.write_bytes(content)
    tracemalloc.start()
    try:
        image_pixels(path)
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()
