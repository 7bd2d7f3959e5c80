"""How a training goes: train.csv, the lines of the terminal, TensorBoard, and the checkpoints that stay."""

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest
import torch

from analysis.commands.cli import main
from analysis.train import command
from splat.losses.reference import psnr
from splat.render.render import render
from splat.training.checkpoint import load_checkpoint, save_checkpoint
from tests.splat.photometric import photometric_loss

STEPS = 25


def words(scene: Path, out: Path, *more: str) -> list[str]:
    every = ["--iterations", str(STEPS), "--log-every", "10", "--checkpoint-every", "5"]
    return ["train", str(scene), "--out", str(out), "--views", "3", *every, *more]


@pytest.fixture(scope="module")
def run(original, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("progress") / "run"
    assert main(words(original, out, "--keep-checkpoints", "all")) == 0
    return out


def test_a_row_is_the_first_training_view_as_the_checkpoint_renders_it(run):
    table = pd.read_csv(run / "train.csv")
    assert list(table["step"]) == [0, 10, 20, 25] and list(table["seconds"]) == sorted(table["seconds"])
    for _, row in table.iloc[1:].iterrows():
        path = run / f"step-{row['step']:.0f}" / "checkpoint.pt"
        loaded = load_checkpoint(path)
        training, (view,) = loaded.training, loaded.with_scene(path).scene.load(loaded.scene.train[:1])
        with torch.no_grad():
            image = render(training.gaussians, view.camera, torch.zeros(3), training.config.render).image
        assert row["psnr"] == pytest.approx(psnr(image, view.image), rel=1e-6)
        assert row["loss"] == pytest.approx(float(photometric_loss(image, view.image, training.config.loss)), rel=1e-5)
        assert row["gaussians"] == len(training.gaussians)


def test_what_is_kept_is_the_checkpoint_of_its_step_and_finds_its_scene(original, run):
    assert {path.name for path in run.glob("step-*")} == {"step-5", "step-10", "step-15", "step-20", "step-25"}
    last, kept = load_checkpoint(run / "checkpoint.pt"), load_checkpoint(run / "step-25" / "checkpoint.pt")
    assert torch.equal(last.training.gaussians.flat, kept.training.gaussians.flat)
    assert (run / "step-25" / kept.scene.relative).resolve() == original.resolve()


def test_the_first_checkpoint_whose_training_views_reach_a_level_stays(original, run, tmp_path, monkeypatch):
    """By the mean of the squared errors, looked at every few steps; a level that is not reached has no folder."""

    def level(step: int) -> float:
        path = run / f"step-{step}" / "checkpoint.pt"
        loaded = load_checkpoint(path)
        training, views = loaded.training, loaded.with_scene(path).scene.load(loaded.scene.train)
        errors = []
        for view in views:
            with torch.no_grad():
                image = render(training.gaussians, view.camera, torch.zeros(3), training.config.render).image
            errors.append((image.clamp(0, 1) - view.image).square().mean())
        return float(-10 * torch.stack(errors).mean().log10())

    monkeypatch.setattr(command, "LOOK", 10)
    low, high = level(10), level(20)
    assert low < high
    asked = [f"{low - 0.5:.6g}", f"{(low + high) / 2:.6g}", "99"]
    out = tmp_path / "run"
    assert main(words(original, out, "--save-at-psnr", *asked)) == 0
    kept = {path.name: load_checkpoint(path / "checkpoint.pt") for path in out.glob("psnr-*")}
    assert {name: each.training.step for name, each in kept.items()} == {f"psnr-{asked[0]}": 10, f"psnr-{asked[1]}": 20}
    same = load_checkpoint(run / "step-20" / "checkpoint.pt").training.gaussians.flat
    assert torch.equal(kept[f"psnr-{asked[1]}"].training.gaussians.flat, same)  # a look changes nothing
    before = (out / f"psnr-{asked[0]}" / "checkpoint.pt").read_bytes()
    assert main(words(original, out, "--save-at-psnr", *asked, "--resume")) == 0
    assert (out / f"psnr-{asked[0]}" / "checkpoint.pt").read_bytes() == before


def test_the_oldest_of_those_that_stay_go_but_for_what_else_is_in_their_folders(original, tmp_path, monkeypatch):
    out = tmp_path / "run"

    def probed(path, training, reference):
        if path.parent.name == "step-10":
            (path.parent / "probe").mkdir()
        save_checkpoint(path, training, reference)

    monkeypatch.setattr(command, "save_checkpoint", probed)
    assert main(words(original, out, "--keep-checkpoints", "2")) == 0
    assert {path.parent.name for path in out.glob("step-*/checkpoint.pt")} == {"step-20", "step-25"}
    assert {path.name for path in out.glob("step-*")} == {"step-10", "step-20", "step-25"}


@contextmanager
def killed_at(step: int) -> Iterator[None]:
    """A training that is killed where its row of that step is written and its checkpoint is not."""

    class Killed(BaseException):
        """Reported by no handler of errors."""

    def killed(path, training, reference):
        if training.step == step:
            raise Killed
        save_checkpoint(path, training, reference)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "save_checkpoint", killed)
        with pytest.raises(Killed):
            yield


def test_a_row_is_there_when_it_is_made_and_a_resumed_run_continues_the_file(original, run, tmp_path):
    out = tmp_path / "run"
    with killed_at(20):
        main(words(original, out))
    written = (out / "train.csv").read_text()
    assert [line.split(",")[0] for line in written.splitlines()] == ["step", "0", "10", "20"]
    (out / "train.csv").write_text(written + "2")  # of a line that was cut short
    assert main(words(original, out, "--resume")) == 0
    ended, whole = (pd.read_csv(each / "train.csv").drop(columns=["seconds", "cpu"]) for each in (out, run))
    pd.testing.assert_frame_equal(ended, whole, check_exact=True)


def test_off_a_terminal_every_row_is_a_line_with_the_time_left(original, tmp_path, capsys):
    assert main(words(original, tmp_path / "run")) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("step ")]
    assert [line.split(":")[0] for line in lines] == [f"step {step} of 25" for step in (0, 10, 20, 25)]
    for line, (_, row) in zip(lines, pd.read_csv(tmp_path / "run" / "train.csv").iterrows(), strict=True):
        fits = f"loss {row['loss']:.4f}, {row['psnr']:.2f} dB of the first training view"
        assert re.search(rf": {fits}( after .*)?, {row['gaussians']:.0f} Gaussians, ", line)
        assert line.endswith(" s left") == (row["step"] in (10, 20))


def test_a_row_says_what_was_done_to_the_gaussians_since_the_one_before(original, tmp_path, capsys):
    settings = ["start=0", "stop_share=1", "first_reset=17", "reset_every=100"]
    changes = [word for setting in settings for word in ("--set", f"densify.{setting}")]
    assert main(words(original, tmp_path / "run", *changes)) == 0
    lines = re.findall(r"^step \d+ of .*", capsys.readouterr().err, re.M)
    after = [found[1] if (found := re.search(" after (.*?),", line)) else "" for line in lines]
    assert after == ["", "density control", "density control and a reset of opacities", "density control"]


def test_gaussians_that_more_than_triple_in_the_first_tenth_are_said_with_the_reason(original, tmp_path, capsys):
    fast = ["start=0", "every=1", "gradient_threshold=1e-9"]
    for name, settings in {"usual": fast[1:], "fast": fast}.items():
        changes = [word for setting in settings for word in ("--set", f"densify.{setting}")]
        assert main(words(original, tmp_path / name, *changes)) == 0
        said = " ".join(capsys.readouterr().err.split())
        why = "more than 3 times those of the start: each of 2 rounds of density control since step 1 adds one for each"
        assert (why in said) == (name == "fast") and said.count("times those of the start") == (name == "fast")


def test_tensorboard_is_given_the_rows(original, tmp_path):
    reader = "tensorboard.backend.event_processing.event_accumulator"
    package = pytest.importorskip(reader, reason="pip install -e '.[tensorboard]'")
    out = tmp_path / "run"
    assert main(words(original, out, "--track", "tensorboard")) == 0
    events, table = package.EventAccumulator(str(out / "tracked")).Reload(), pd.read_csv(out / "train.csv")
    for name in ("loss", "psnr", "gaussians"):
        found = events.Scalars(name)
        assert [each.step for each in found] == list(table["step"])
        assert [each.value for each in found] == pytest.approx(list(table[name]), rel=1e-6)


@pytest.mark.parametrize("name", ["wandb", "trackio"])
def test_other_trackers_are_given_the_rows_by_the_calls_that_they_share(original, tmp_path, monkeypatch, name):
    module, calls = ModuleType(name), []
    for call in ("init", "log", "finish"):
        monkeypatch.setattr(module, call, lambda *a, call=call, **named: calls.append((call, a, named)), raising=False)
    monkeypatch.setitem(sys.modules, name, module)
    assert main(words(original, tmp_path / "run", "--track", name)) == 0
    first, *rows, last = calls
    assert first == ("init", (), {"project": "landscape", "name": "run"}) and last == ("finish", (), {})
    table = pd.read_csv(tmp_path / "run" / "train.csv")
    assert [named["step"] for _, _, named in rows] == list(table["step"])
    assert [values["loss"] for _, (values,), _ in rows] == list(table["loss"])


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--track", "tensorboard"], "pip install tensorboard"),
        (["--track", "trackio"], "pip install trackio"),
        (["--keep-checkpoints", "-1"], "expected keep_checkpoints of at least 0, or all, got -1"),
        (["--save-at-psnr", "30", "-1"], "expected save_at_psnr in dB above 0, got 30.0 -1.0"),
        (["--log-every", "0"], "expected log_every of at least 1, got 0"),
    ],
)
def test_what_cannot_be_done_is_refused_before_a_folder_is_made(original, tmp_path, capsys, monkeypatch, more, message):
    for name in ("torch.utils.tensorboard", "trackio"):
        monkeypatch.setitem(sys.modules, name, None)
    assert main(words(original, tmp_path / "run", *more)) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "run").exists()


def test_a_train_csv_of_something_else_is_refused(original, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(words(original, out)) == 0
    (out / "train.csv").write_text("step,what\nfirst,2\n")
    assert main(words(original, out, "--resume")) == 2
    said = capsys.readouterr().err
    assert f"expected the rows of landscape train in {out / 'train.csv'}" in said and "remove it" in said
