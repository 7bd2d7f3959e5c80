"""`landscape sfm`: what it says, and where it puts the scene."""

from pathlib import Path

import pytest
from PIL import Image

from analysis.commands.cli import main
from splat.scenes.sfm.sfm import Mapped


@pytest.fixture
def photos(tmp_path) -> Path:
    (tmp_path / "photos").mkdir()
    for name in ("a.png", "b.png", "c.png"):
        Image.new("RGB", (40, 30), (90, 100, 110)).save(tmp_path / "photos" / name)
    return tmp_path / "photos"


def said(capsys) -> str:
    return " ".join(capsys.readouterr().out.split())


def test_the_scene_lies_beside_the_photographs_and_says_what_was_left_out(photos, capsys, monkeypatch):
    asked = []

    def make(folder, out, stage):
        asked.append((folder, out))
        with stage("finding features") as report:
            report(3, 3, "photographs")
        return Mapped(5, tuple(f"{i}.png" for i in range(7)), (5, 4), 120, 0.456)

    monkeypatch.setattr("analysis.commands.sfm.scene_from_photos", make)
    out = photos.with_name("photos-scene")
    assert main(["sfm", str(photos)]) == 0
    assert asked == [(photos, out)]
    text = said(capsys)
    assert f"{out}: 5 of 12 photographs placed, 120 points, mean reprojection error 0.46 px" in text
    assert "left out: 0.png, 1.png, 2.png, 3.png, 4.png and 2 more; they overlap" in text
    assert "fell apart into 2 models, of 5, 4; the largest was kept" in text
    assert text.endswith(f"next: landscape train {out}")


def test_one_model_of_all_photographs_needs_no_more_words(photos, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("analysis.commands.sfm.scene_from_photos", lambda *_: Mapped(3, (), (3,), 40, 0.5))
    assert main(["sfm", str(photos), "--out", str(tmp_path / "my scene")]) == 0
    text = said(capsys)
    assert "left out" not in text and "fell apart" not in text
    assert text.endswith(f"next: landscape train '{tmp_path / 'my scene'}'")


def test_photographs_that_make_no_model_are_refused_in_one_sentence(photos, capsys):
    assert main(["sfm", str(photos), "--out", str(photos.parent / "scene")]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("landscape: expected photographs of one scene from different places")
    assert [path.name for path in photos.parent.iterdir()] == ["photos"]
