"""Masks and depth maps beside the photographs."""

from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
import torch
from PIL import Image

from landscape.errors import InputError
from splat.model.untrusted import MOST_ROWS
from splat.scenes.layers import STRIP, dtu_number, find_layer, read_depth, read_mask
from splat.scenes.scene import load_scene
from splat.scenes.view import View
from tests.refusals import refused
from tests.splat.scenes import folders
from tests.splat.scenes.folders import NAMES, SIZE

WIDTH, HEIGHT = SIZE


def write_mask(path: Path, inside: np.ndarray, white: int = 255) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(inside.astype(np.uint8) * white).save(path)


def blob(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """An ellipse, off the middle."""
    row, column = np.mgrid[:height, :width]
    return ((column / width - 0.4) / 0.3) ** 2 + ((row / height - 0.6) / 0.35) ** 2 < 1


@pytest.mark.parametrize("file", ["masks/a.png", "masks/a.png.png", "mask/a.jpg", "masks/images/a.png"])
def test_the_masks_of_a_scene_are_found_by_the_names_of_its_images(tmp_path: Path, file: str) -> None:
    folders.write_transforms(tmp_path)
    write_mask(tmp_path / file, np.ones((HEIGHT, WIDTH)))
    views = load_scene(tmp_path).load()
    assert views[0].mask is not None and bool(views[0].mask.all())
    assert views[1].mask is None and views[2].mask is None


def test_nerfstudios_mask_path_is_read_unless_a_folder_is_given(tmp_path: Path) -> None:
    folders.rewrite(tmp_path, lambda content: content["frames"][0].update(mask_path="elsewhere/first.png"))
    refused(r"1 are missing, the first is .*first\.png", load_scene, tmp_path, error=FileNotFoundError)
    write_mask(tmp_path / "elsewhere/first.png", blob(), white=1)  # nerfstudio counts what is not 0
    write_mask(tmp_path / "masks/a.png", ~blob())
    mask = load_scene(tmp_path).load()[0].mask
    assert mask is not None and np.array_equal(mask.numpy(), blob())
    write_mask(tmp_path / "given/a.png", ~blob())
    mask = load_scene(tmp_path, masks=tmp_path / "given").load()[0].mask
    assert mask is not None and np.array_equal(mask.numpy(), ~blob())


def test_the_masks_of_renamed_images_are_found_by_either_name(tmp_path: Path) -> None:
    folders.write_colmap(tmp_path)
    for name in NAMES:
        (tmp_path / "images" / name).unlink()
    folders.write_pictures(tmp_path / "images_2", ("image000.png", "image001.png", "image002.png"))
    (tmp_path / "images").rmdir()
    write_mask(tmp_path / "masks/image001.png", blob())
    write_mask(tmp_path / "masks/c.png", blob())
    assert [view.mask is not None for view in load_scene(tmp_path).load()] == [False, True, True]


def test_a_pixel_is_inside_where_all_of_its_footprint_is(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path)
    fine = blob(3 * WIDTH, 3 * HEIGHT)
    write_mask(tmp_path / "masks/a.png", fine)
    for downscale in (1, 2):
        mask = load_scene(tmp_path, downscale=downscale).load()[0].mask
        k = 3 * downscale
        whole = fine.reshape(HEIGHT // downscale, k, WIDTH // downscale, k).all(axis=(1, 3))
        assert mask is not None and np.array_equal(mask.numpy(), whole) and 0 < whole.sum() < whole.size


def test_a_mask_is_undistorted_as_its_picture_is(tmp_path: Path) -> None:
    size = (96, 72)
    model = folders.reconstruction("OPENCV", (80.0, 79.0, 47.0, 37.0, -0.2, 0.05, 0.003, -0.002))
    model.cameras[1].width, model.cameras[1].height = size
    folders.write_colmap(tmp_path, model=model)
    inside = blob(*size)
    Image.fromarray(np.repeat(inside[..., None], 3, axis=2).astype(np.uint8) * 255).save(tmp_path / "images/a.png")
    folders.write_pictures(tmp_path / "images", NAMES[1:], size)
    write_mask(tmp_path / "masks/a.png", inside)
    view = load_scene(tmp_path, downscale=2).load()[0]
    assert view.mask is not None and torch.equal(view.mask, view.image[0] > 1 - 1e-4)
    assert view.mask.float().mean() > 0.1


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (np.zeros((HEIGHT, WIDTH)), "black all over"),
        (np.ones((HEIGHT, WIDTH // 2)), "to have the shape of its photograph, 24 x 18 px at any scale, got 12 x 18"),
        (np.indices((HEIGHT, WIDTH)).sum(axis=0) % 2, "with whole pixels inside"),
    ],
)
def test_masks_that_cannot_be_are_refused(tmp_path: Path, pixels: np.ndarray, message: str) -> None:
    folders.write_transforms(tmp_path)
    write_mask(tmp_path / "masks/a.png", pixels)
    refused(message, load_scene(tmp_path, downscale=2).load)


def inside(path: Path, image: Image.Image, quality: int = 75) -> np.ndarray:
    image.save(path, quality=quality)
    return read_mask(path)[0].numpy() == 1


def test_a_mask_is_inside_where_it_is_nearer_to_white_in_any_kind_of_file(tmp_path: Path) -> None:
    drawn = blob(8 * WIDTH, 8 * HEIGHT)
    grey = (drawn * 250).astype(np.uint8)
    grey[tuple(np.argwhere(drawn)[0])] = 255  # one brighter pixel is no other mask
    assert np.array_equal(inside(tmp_path / "m.png", Image.fromarray(grey)), drawn)
    for quality in (50, 90):  # JPEG's noise reaches far into the white
        off = inside(tmp_path / "m.jpg", Image.fromarray(drawn.astype(np.uint8) * 255), quality=quality) != drawn
        assert off.mean() < 0.002 and not off[drawn ^ ~drawn & off].all()
    assert np.array_equal(inside(tmp_path / "m.png", Image.fromarray(drawn.astype(np.uint16) * 65535)), drawn)
    assert np.array_equal(inside(tmp_path / "m.png", Image.fromarray(drawn)), drawn)  # of one bit
    palette = Image.fromarray(1 - drawn.astype(np.uint8)).convert("P")
    palette.putpalette([255, 255, 255, 0, 0, 0])
    assert np.array_equal(inside(tmp_path / "m.png", palette), drawn)
    for colour in (255, 90):  # a cut-out picture: its alpha is the mask
        layers = [np.full_like(grey, colour)] * 3 + [drawn.astype(np.uint8) * 255]
        assert np.array_equal(inside(tmp_path / "m.png", Image.fromarray(np.stack(layers, axis=2))), drawn)
    opaque = np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=2)
    assert np.array_equal(inside(tmp_path / "m.png", Image.fromarray(opaque)), drawn)


def test_labels_colours_and_soft_masks_are_refused(tmp_path: Path) -> None:
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    labels, ramp = (column // 8).astype(np.uint8), (column * 10).astype(np.uint8)
    red = np.stack([blob() * 128, np.zeros_like(row), np.zeros_like(row)], axis=2).astype(np.uint8)
    soft = np.stack([np.full_like(ramp, 255)] * 3 + [ramp], axis=2)
    for pixels in (labels, (column % 3 == 0).astype(np.uint8) * 7, ramp, red, soft):
        refused("labels, or a soft mask; write 255", inside, tmp_path / "m.png", Image.fromarray(pixels))


def test_a_tall_mask_is_read_in_strips(tmp_path: Path) -> None:
    tall = np.zeros((2 * STRIP + 5, 3, 3), dtype=np.uint8)
    tall[[0, STRIP, -1], 1] = 255
    Image.fromarray(tall).save(tmp_path / "m.png")
    assert read_mask(tmp_path / "m.png").nonzero().tolist() == [[0, 0, 1], [0, STRIP, 1], [0, 2 * STRIP + 4, 1]]


@pytest.mark.parametrize("option", ["masks", "depths"])
def test_a_folder_without_a_file_for_any_image_is_refused(tmp_path: Path, option: str) -> None:
    folders.write_transforms(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"named after the 3 images, such as a\.png, in .*which is no folder"):
        load_scene(tmp_path, **{option: tmp_path / "nothing"})  # pyright: ignore[reportArgumentType]
    write_mask(tmp_path / "others/z.png", blob())
    refused("found none", load_scene, tmp_path, **{option: tmp_path / "others"}, error=FileNotFoundError)


def test_depth_maps_keep_their_numbers_at_any_scale_of_the_picture(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path)
    (tmp_path / "depth").mkdir()
    values = np.random.default_rng(0).normal(size=(1, HEIGHT, WIDTH))
    np.save(tmp_path / "depth/a.npy", values)
    levels = np.arange(4 * HEIGHT * WIDTH, dtype=np.uint16).reshape(2 * HEIGHT, 2 * WIDTH) * 37
    Image.fromarray(levels).save(tmp_path / "depth/b.png")
    first, second, third = load_scene(tmp_path, depths=tmp_path / "depth").load()
    assert first.depth is not None and torch.equal(first.depth, torch.from_numpy(values[0]).float())
    mean = levels.reshape(HEIGHT, 2, WIDTH, 2).mean(axis=(1, 3))
    assert second.depth is not None and third.depth is None
    np.testing.assert_allclose(second.depth.numpy(), mean, rtol=1e-6)  # sums of four numbers in float32


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.full((4, 5), 2.0), "depths that vary, got 2.0 everywhere"),
        (np.array([[1.0, np.nan], [np.inf, 2.0]]), "finite depths, got 2 that are not"),
        (np.zeros((3, 4, 5)), r"of shape \(h, w\), got float64 of shape \(3, 4, 5\)"),
        (np.array([["a", "b"], ["c", "d"]]), "an array of <U1, not of real numbers"),
        (np.array([[None, 1], [2, 3]]), "cannot read"),
        (np.zeros((0, 3)), r"of shape \(h, w\), got float64 of shape \(0, 3\)"),
        (np.array([[1e39, 0.0], [0.0, 1.0]]), "finite depths, got 1 that are not"),
        (np.zeros((3, 0)), r"of shape \(h, w\), got float64 of shape \(3, 0\)"),
    ],
)
def test_depth_maps_that_cannot_be_are_refused(tmp_path: Path, values: np.ndarray, message: str) -> None:
    np.save(tmp_path / "d.npy", values)
    refused(message, read_depth, tmp_path / "d.npy")


def test_files_that_are_no_masks_or_depths_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "d.npy").touch()
    refused(r"expected a depth map, cannot read .*d\.npy", read_depth, tmp_path / "d.npy")
    write_mask(tmp_path / "d.png", blob())
    refused("depth of 16 bits, got mode L", read_depth, tmp_path / "d.png")
    Image.new("1", (1, MOST_ROWS + 1)).save(tmp_path / "tall.png")
    refused(rf"got one of 1 x {MOST_ROWS + 1} px \(at most .* and 65,536 a side\)", read_mask, tmp_path / "tall.png")
    header = b"IHDR" + bytes(12)  # a byte too few
    cut = b"\x89PNG\r\n\x1a\n" + (12).to_bytes(4, "big") + header + crc32(header).to_bytes(4, "big")
    for content, words in ((cut, ": Truncated IHDR"), (b"no picture", "")):
        (tmp_path / "mask.png").write_bytes(content)
        refused(rf"expected a mask, cannot read .*mask\.png{words}", read_mask, tmp_path / "mask.png")


def test_layers_are_found_by_name_with_folders_or_without(tmp_path: Path) -> None:
    (tmp_path / "train").mkdir()
    for file in ("train/r_3.npy", "r_4.npy", "025.png"):
        (tmp_path / file).touch()
    assert find_layer(tmp_path, ["train/r_3"], [".npy"]) == tmp_path / "train/r_3.npy"
    assert find_layer(tmp_path, ["train/r_4"], [".npy"]) == tmp_path / "r_4.npy"
    assert find_layer(tmp_path, ["other/r_4.jpg"], [".npy"]) == tmp_path / "r_4.npy"
    assert find_layer(tmp_path, ["train/r_4"], [".png"]) is None
    assert find_layer(tmp_path, ["rect_026_max.png"], [".npy", ".png"]) == tmp_path / "025.png"
    names = ("a/rect_001_6_r7000.jpg", "rect_001.png", "rect_1_3_r5000.png")
    assert [dtu_number(name) for name in names] == [0, None, None]


def test_a_mask_or_depth_of_another_size_than_its_camera_is_refused(tmp_path: Path) -> None:
    folders.write_transforms(tmp_path)
    view = load_scene(tmp_path).load()[0]
    for layer in ({"mask": torch.ones(3, 3, dtype=torch.bool)}, {"depth": torch.ones(HEIGHT, WIDTH + 1)}):
        refused("as its camera", View, view.name, view.camera, view.image, **layer)


@pytest.mark.parametrize("name", ["images/a.png", "masks/a.png", "depth/a.npy", "transforms.json", "p.ply"])
def test_a_pointer_of_git_lfs_is_named_in_any_file_of_a_scene(tmp_path, name):
    folders.write_transforms(tmp_path, ply_file_path="p.ply" if name == "p.ply" else None)
    for folder in ("masks", "depth"):
        (tmp_path / folder).mkdir()
    (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12345\n")
    depths = tmp_path / "depth" if name == "depth/a.npy" else None
    with pytest.raises(InputError, match=rf"{Path(name).name}.*, got a pointer of git lfs in its place; run `git lfs"):
        load_scene(tmp_path, depths=depths).load()
