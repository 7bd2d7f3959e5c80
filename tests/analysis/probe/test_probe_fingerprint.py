"""Probes of what has changed since the training, or since they were interrupted."""

import json
import re
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from analysis.commands.cli import main
from analysis.records.records import read_record
from landscape.errors import InputError
from splat.training.checkpoint import load_checkpoint, save_checkpoint
from splat.training.origin import fingerprint

QUICK = ("--quick", "--slice-points", "5")


@pytest.fixture
def there(run, tmp_path) -> Path:
    """A copy of the run beside its scene."""
    shutil.copytree(run.parent / "still", tmp_path / "still")
    (tmp_path / "run").mkdir()
    shutil.copy(run / "double.pt", tmp_path / "run/checkpoint.pt")
    return tmp_path / "run"


def posed(run: Path, change: Callable[[list[dict[str, Any]]], Any]) -> None:
    """Change the frames of the scene beside a run, in the order of their names."""
    path = run.parent / "still/transforms.json"
    content = json.loads(path.read_text())
    change(content["frames"])
    path.write_text(json.dumps(content))


def moved(frames: list[dict[str, Any]]) -> None:
    for frame in frames:
        for row in frame["transform_matrix"][:3]:
            row[3] *= 1.05


def longer(frames: list[dict[str, Any]]) -> None:
    for frame in frames:
        frame["fl_x"] *= 1.03


def swapped(frames: list[dict[str, Any]]) -> None:
    frames[1]["transform_matrix"], frames[2]["transform_matrix"] = (frames[i]["transform_matrix"] for i in (2, 1))


def painted(run: Path) -> None:
    path = run.parent / "still" / load_checkpoint(run / "checkpoint.pt").scene.train[1]
    pixels = np.array(Image.open(path))
    pixels[3, 4] ^= 1
    Image.fromarray(pixels).save(path)


def masked(run: Path) -> None:
    folder = run.parent / "still/masks"
    folder.mkdir()
    name = Path(load_checkpoint(run / "checkpoint.pt").scene.test[0]).stem
    Image.fromarray(np.full((12, 16), 255, np.uint8)).save(folder / f"{name}.png")


CHANGES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "centres": (lambda run: posed(run, moved), r"in 4 of 4: 'images/.*': centre moved by \d.*; and 1 more"),
    "focal": (lambda run: posed(run, longer), r"focal length by \+3%"),
    "swapped": (lambda run: posed(run, swapped), r"centre moved by .* world units, turned by .*°"),
    "distortion": (
        lambda run: posed(run, lambda frames: [frame.update(camera_model="OPENCV", k1=0.01) for frame in frames]),
        r"lens FULL_OPENCV .*, 0.01, .* instead of a pinhole",
    ),
    "photograph": (painted, r"in 1 of 4: 'images/.*': another photograph"),
    "mask": (masked, r"in 1 of 4: 'images/.*': a mask where there was none"),
}


@pytest.fixture
def asked(monkeypatch) -> list[str]:
    """What stages would be kept under, in place of measuring."""
    found = []

    def measure(*given, **_):
        found.append(given[6])
        raise InputError("measured")

    monkeypatch.setattr("analysis.probe.command.measure", measure)
    return found


@pytest.mark.parametrize("change", CHANGES)
def test_what_changed_since_the_training_is_said_before_anything_is_measured(there, asked, capsys, change):
    words = ["probe", str(there / "checkpoint.pt"), *QUICK]
    assert main(words) == 2 and "measured" in capsys.readouterr().err
    CHANGES[change][0](there)
    assert main(words) == 2 and len(asked) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert re.search(CHANGES[change][1], said), said
    assert "restore them, train anew, or go on with --accept-changed" in said
    assert main([*words, "--accept-changed"]) == 2 and "measured" in capsys.readouterr().err
    same = change == "mask"  # of a view that is held out
    assert len(asked) == 2 and (asked[0] == asked[1]) == same


def test_stages_are_kept_for_the_same_data_question_state_and_formulas_alone(there, asked, monkeypatch):
    words, path = ["probe", str(there / "checkpoint.pt"), *QUICK], there / "checkpoint.pt"
    for more in ([], ["--strict"], ["--seed", "1"], ["--loss", "3dgs", "--max-views", "2"], ["--end-products", "50"]):
        assert main([*words, *more]) == 2
    loaded = load_checkpoint(path)
    training, config = loaded.training, loaded.training.config
    loss, render = replace(config.loss, ssim_weight=0.1), replace(config.render, blur=0.2)
    for change in ({"loss": loss}, {"render": render}, {"background": (0.0, 0.5, 0.0)}):
        save_checkpoint(path, replace(training, config=replace(config, **change)), loaded.scene)
        assert main(words) == 2
    gaussians = training.gaussians
    save_checkpoint(path, replace(training, gaussians=gaussians.with_flat(gaussians.flat + 1e-12)), loaded.scene)
    assert main(words) == 2
    save_checkpoint(path, training, loaded.scene)
    monkeypatch.setattr(fingerprint, "FORMULAS", fingerprint.FORMULAS + 1)
    assert main(words) == 2
    assert asked[0] == asked[1] and len({*asked}) == len(asked) - 1


def test_a_probe_that_is_continued_does_not_mix_two_scenes(there, monkeypatch):
    def interrupt(target):
        raise KeyboardInterrupt

    words = ["probe", str(there / "checkpoint.pt"), *QUICK]
    monkeypatch.setattr("analysis.console.drawing.drawing", lambda *_: nullcontext(interrupt))
    assert main(words) == 130 and (there / ".probe-quick.unfinished/traces.msgpack").is_file()
    posed(there, moved)
    monkeypatch.setattr("analysis.console.drawing.drawing", lambda *_: nullcontext(lambda target: []))
    assert main([*words, "--accept-changed"]) == 0
    mixed = read_record(there / "probe-quick").data
    shutil.rmtree(there / "probe-quick")
    assert main([*words, "--accept-changed"]) == 0
    fresh = read_record(there / "probe-quick").data
    assert mixed.traces == fresh.traces and mixed.eigenvalues == fresh.eigenvalues
    assert any(note.startswith("not as in the training, and accepted: 'images/") for note in fresh.notes)
