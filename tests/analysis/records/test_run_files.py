"""A damaged file of a run is named, with what to do, by everything that reads it."""

import json
import re
from pathlib import Path

import pytest

from analysis.records.run_files import Scores, ViewScores, read_scores
from analysis.runs.sweep.sweep_file import Cell
from analysis.runs.sweep.sweep_results import results
from analysis.train.options import TrainOptions
from analysis.train.progress import TrainingTime
from tests.refusals import refused

SCORES = {"psnr": 20.0, "ssim": 0.5, "lpips": None}
METRICS = {"gaussians": 9, "train": SCORES | {"psnr": "Infinity"}, "test": None}
SECONDS = {"step": 3, "wall": 1.5, "cpu": 2, "threads": 2}


WORDS = SCORES | {"ssim": "good"}


def swept(run: Path) -> float:
    """The training views' PSNR, as a sweep reads it."""
    cell = Cell("still", "3dgs", TrainOptions(Path("still"), out=run))
    return results([cell], {cell.name: "done"})["train_psnr"].item()


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("", "a damaged file (Input data was truncated)"),
        ('{"test":', "a damaged file (Input data was truncated)"),
        ("[1]", "another: expected `object`, got `array`;"),
        (json.dumps(METRICS | {"train": 3}), "another: expected `object | null`, got `int` - at `$.train`;"),
        (json.dumps(METRICS | {"test": WORDS}), "another: expected `float | null`, got `str` - at `$.test.ssim`;"),
        (json.dumps({"train": SCORES}), "another: object missing required field `gaussians`;"),
        (
            json.dumps(METRICS | {"seconds": {"wall": "x"}}),
            "another: expected `float`, got `str` - at `$.seconds.wall`;",
        ),
    ],
)
def test_damaged_scores_are_named_with_what_to_do(tmp_path, text, got):
    path = tmp_path / "metrics.json"
    path.write_text(text)
    for read in (read_scores, swept):
        said = refused(re.escape(f"expected the scores of landscape train in {path}, got {got}"), read, tmp_path)
        assert said.endswith("remove it and repeat the training's command with --resume, which scores again")


def test_scores_that_are_whole_are_read(tmp_path):
    (tmp_path / "metrics.json").write_text(json.dumps(METRICS))
    train = ViewScores(psnr=float("inf"), ssim=0.5, lpips=None)
    assert read_scores(tmp_path) == Scores(gaussians=9, train=train) and swept(tmp_path) == float("inf")


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("", "a damaged file (Input data was truncated)"),
        ("3", "another: expected `object`, got `int`;"),
        (json.dumps({"foo": 1}), "another: object missing required field `step`;"),
        (json.dumps(SECONDS | {"wall": "long"}), "another: expected `float`, got `str` - at `$.wall`;"),
    ],
)
def test_damaged_seconds_are_named_with_what_to_do(tmp_path, text, got):
    path = tmp_path / "seconds.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(f"expected the seconds of a training in {path}, got {got}")) as e:
        TrainingTime.read(tmp_path)
    assert str(e.value).endswith("remove it: nothing but the time until its last checkpoint is lost")
    path.write_text(json.dumps(SECONDS | {"later": 1}))
    assert TrainingTime.read(tmp_path) == TrainingTime(3, 1.5, 2, 2)
