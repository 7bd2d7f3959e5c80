"""The sparse-view protocols against their published lists."""

from fractions import Fraction
from pathlib import Path

import pytest

from splat.scenes.scene import load_scene
from splat.scenes.splits import explicit_split, llff_split, split_scene, usual_views
from tests.refusals import refused
from tests.splat.scenes import folders

FERN = tuple(f"image{i:03d}.png" for i in range(20))


def test_llff_holds_out_every_eighth_and_spreads_n_over_the_rest() -> None:
    split = llff_split(FERN[::-1], 3)
    assert split.test == (FERN[0], FERN[8], FERN[16])
    assert split.train == (FERN[1], FERN[10], FERN[19])  # places 0, 8, 16 of the other 17


def test_llff_rounds_to_nearest_and_half_to_even_as_the_public_code_does() -> None:
    names = tuple(f"{i:02d}" for i in range(16))  # 14 to train on; linspace(0, 13, 3) = 0, 6.5, 13
    others = [name for i, name in enumerate(names) if i % 8]
    assert llff_split(names, 3).train == (others[0], others[6], others[13])
    assert llff_split(names, 4).train == (others[0], others[4], others[9], others[13])  # 0, 4.33, 8.67, 13


def test_without_a_number_all_but_the_test_views_train() -> None:
    split = llff_split(FERN)
    assert sorted(split.train + split.test) == list(FERN) and len(split.test) == 3


@pytest.mark.parametrize(
    ("n", "message"), [(18, "at most 17 training views, .* got 18"), (0, "at least 1"), (-1, "at least 1")]
)
def test_more_views_than_there_are_or_none_are_refused(n: int, message: str) -> None:
    refused(message, llff_split, FERN, n)


def test_one_image_cannot_be_split() -> None:
    refused("at least 2 images", llff_split, ["a"])


def test_blender_has_the_published_views_in_full_and_reduced_scenes(tmp_path: Path) -> None:
    folders.write_blender(tmp_path / "full", tuple(range(100)), tuple(range(200)))
    folders.write_blender(tmp_path / "reduced", (2, 16, 26, 55, 73, 75, 86, 93), tuple(range(0, 200, 8)))
    full, reduced = (split_scene(load_scene(tmp_path / name), 8) for name in ("full", "reduced"))
    assert full == reduced
    assert full.train == tuple(f"train/r_{k}" for k in (26, 86, 2, 55, 75, 93, 16, 73))
    assert full.test == tuple(f"test/r_{k}" for k in range(0, 200, 8)) and len(full.test) == 25
    assert split_scene(load_scene(tmp_path / "reduced"), 3).train == full.train[:3]


def test_by_default_blender_trains_on_eight_views_and_others_on_three(tmp_path: Path) -> None:
    folders.write_blender(tmp_path / "blender", (2, 16, 26, 55, 73, 75, 86, 93), (0, 8))
    folders.write_colmap(tmp_path / "colmap")
    assert [usual_views(load_scene(tmp_path / name)) for name in ("blender", "colmap")] == [8, 3]


def test_blender_refuses_more_views_than_there_are(tmp_path: Path) -> None:
    folders.write_blender(tmp_path, (2, 16, 26, 55, 73, 75, 86, 93), (0, 8))
    refused("at most 8 training views", split_scene, load_scene(tmp_path), 9)
    refused("at least 1", split_scene, load_scene(tmp_path), 0)


def test_a_blender_scene_with_other_views_spreads_them_evenly_and_says_so(tmp_path: Path) -> None:
    folders.write_blender(tmp_path, tuple(range(5)), tuple(range(3)))
    split = split_scene(load_scene(tmp_path), 3)
    assert split.train == ("train/r_0", "train/r_2", "train/r_4") and split.test == ("test/r_0",)
    assert "evenly spaced" in split.protocol


def test_explicit_views_are_named_by_name_or_last_part() -> None:
    names = ("images/a.png", "images/b.png", "other/b.jpg", "other/c.png")
    split = explicit_split(names, ["images/b.png", "a", "c"])
    assert split.train == ("images/b.png", "images/a.png", "other/c.png") and split.test == ("other/b.jpg",)
    assert explicit_split(names, ["a"], ["c.png"]).test == ("other/c.png",)


@pytest.mark.parametrize(
    ("train", "test", "message"),
    [
        (["b"], None, "'b': 2 views have it"),
        (["z"], None, "'z': no view has it"),
        (["images/a.png", "a"], None, "each once"),
        ([], None, "each once"),
        (["a"], ["a"], "'images/a.png' in both lists"),
    ],
)
def test_lists_that_cannot_be_are_refused(train: list[str], test: list[str] | None, message: str) -> None:
    refused(message, explicit_split, ("images/a.png", "images/b.png", "other/b.jpg", "other/c.png"), train, test)


def test_the_protocols_fit_the_real_scenes(fern: Path, lego: Path) -> None:
    assert split_scene(load_scene(fern), 3).train == ("image001.png", "image010.png", "image019.png")
    split = split_scene(load_scene(lego), 8)
    assert len(split.train) == 8 and len(split.test) == 25


@pytest.mark.parametrize("n", [12, 24])
def test_mip_nerf_360_holds_out_every_eighth_and_spreads_n_over_the_rest(n: int) -> None:
    garden = tuple(f"DSC{7956 + i:05d}.JPG" for i in range(185))
    others = [name for i, name in enumerate(garden) if i % 8]
    places = [round(Fraction(i * (len(others) - 1), n - 1)) for i in range(n)]  # exact, half to even
    split = llff_split(garden, n)
    assert split.train == tuple(others[place] for place in places) and len(set(split.train)) == n
    assert split.test == garden[::8] and len(split.test) == 24
