"""The command: what it writes, and one sentence and exit code 2 for every bad input."""

import importlib
import inspect
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

from analysis.bench.options import BenchOptions
from analysis.commands.cli import COMMANDS, GROUPS, at_files, main
from analysis.commands.options import ConvertOptions
from analysis.probe.options import ProbeOptions
from analysis.runs.options import CompareOptions
from analysis.slice.options import SliceOptions
from analysis.train.command import planned
from analysis.train.options import TrainOptions
from analysis.train.scores import render_name
from splat.losses.reference import psnr
from splat.model.gaussians import ATTRIBUTES
from splat.render.forward import background_of
from splat.render.render import render
from splat.scenes.scene import load_scene
from splat.scenes.splits import Split
from splat.training.checkpoint import load_checkpoint
from splat.training.methods.methods import METHODS
from splat.training.methods.stablegs.stablegs import StableGS
from tests.refusals import refused

ROOT = Path(__file__).parents[3]
ITERATIONS = 12


@pytest.fixture
def scene(original, tmp_path) -> Path:
    """A scene that the test may break."""
    return shutil.copytree(original, tmp_path / "still")


def arguments(scene: Path, out: Path, *more: str) -> list[str]:
    run = ["--views", "3", "--iterations", str(ITERATIONS), "--checkpoint-every", "5"]
    return ["train", str(scene), "--out", str(out), *run, *more]


@pytest.fixture(scope="session")
def finished(original, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "finished"
    assert main(arguments(original, out)) == 0
    return out


def one_sentence(capsys, *expected: str) -> None:
    captured = capsys.readouterr()
    assert captured.out == ""
    message = captured.err.strip()
    assert message.startswith("landscape: ") and "\n" not in message, captured.err
    for part in expected:
        assert part in message or re.search(part, message), message


def refuse(capsys, arguments: list[str], *expected: str) -> None:
    """Exit code 2, one sentence, and nothing written where the run would be."""
    out = Path(arguments[arguments.index("--out") + 1])
    before = sorted(out.parent.iterdir())
    capsys.readouterr()
    assert main(arguments) == 2
    one_sentence(capsys, *expected)
    assert sorted(out.parent.iterdir()) == before


def test_a_run_leaves_a_checkpoint_renders_and_metrics_that_agree(finished, original):
    written = ["checkpoint.pt", "metrics.json", "seconds.json", "test", "train.csv"]
    assert sorted(p.name for p in finished.iterdir()) == written
    loaded = load_checkpoint(finished / "checkpoint.pt")
    assert loaded.training.step == ITERATIONS
    assert loaded.scene.find(finished / "checkpoint.pt") == original.resolve()
    metrics = json.loads((finished / "metrics.json").read_text())
    assert (metrics["step"], metrics["gaussians"]) == (ITERATIONS, len(loaded.training.gaussians))
    views = loaded.with_scene(finished / "checkpoint.pt").scene.load(loaded.scene.test)
    assert set(metrics["test"]["views"]) == {view.name for view in views} and len(metrics["train"]["views"]) == 3
    for view in views:
        with torch.no_grad():
            image = render(loaded.training.gaussians, view.camera).image
        assert metrics["test"]["views"][view.name]["psnr"] == psnr(image, view.image)
        with Image.open(finished / "test" / render_name(view.name)) as file:
            pixels = np.asarray(file).transpose(2, 0, 1) / 255
        assert np.abs(pixels - image.clamp(0, 1).numpy()).max() <= 0.5 / 255 + 1e-6
        with Image.open(finished / "test" / "panels" / render_name(view.name)) as file:
            photograph, beside, error = np.split(np.asarray(file), [28, 56], axis=1)  # 24 pixels and a gap
        assert np.array_equal(photograph[:, :24].transpose(2, 0, 1), (view.image * 255).round().numpy())
        assert np.array_equal(beside[:, :24], (pixels * 255).round().transpose(1, 2, 0))
        mean = (image.clamp(0, 1) - view.image).abs().mean(dim=0)
        worst, least = (np.unravel_index(place, (18, 24)) for place in (int(mean.argmax()), int(mean.argmin())))
        assert error.shape == (18, 24, 3) and error[worst].sum() > error[least].sum()


def test_renders_are_named_after_their_views():
    assert render_name("train/r_3") == "train_r_3.png"
    assert render_name("images/IMG_4026.JPG") == "images_IMG_4026.png"
    assert render_name("../../escape") == ".._.._escape.png"


def test_the_table_shows_each_held_out_view_and_what_to_do_next(original, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(arguments(original, out)) == 0
    captured = capsys.readouterr()
    metrics = json.loads((out / "metrics.json").read_text())
    for name, score in metrics["test"]["views"].items():
        row = next(line for line in captured.out.splitlines() if name in line)
        assert f"{score['psnr']:.2f}" in row and f"{score['ssim']:.4f}" in row
    assert f"next: landscape probe {out}\n" in captured.out
    panels = out / "test" / "panels"
    assert f"{out / 'test'}, beside photograph and error: {panels}; scores: {out / 'metrics.json'}" in captured.out
    assert f"step {ITERATIONS} of {ITERATIONS}: " in captured.err
    names = load_checkpoint(out / "checkpoint.pt").scene.train
    assert f"3 views to train on ({', '.join(names)}), 1 held out, 24 x 18 px" in captured.err
    assert "Gaussians from the scene's points; 3dgs, 12 steps, seed 0" in captured.err


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM], ids=["ctrl-c", "a scheduler's"])
def test_a_signal_saves_a_checkpoint_and_says_how_to_continue(finished, original, capsys, monkeypatch, kind):
    out = finished.with_name(f"stopped by {kind.name}")
    command = arguments(original, out, "--checkpoint-every", "1000")

    def press(*given, presses=[]):  # noqa: B006
        presses.append(1)
        if len(presses) == 4:
            os.kill(os.getpid(), kind)
        return background_of(*given)

    before = [signal.getsignal(each) or signal.SIG_DFL for each in (signal.SIGINT, signal.SIGTERM)]
    with monkeypatch.context() as patch:
        patch.setattr("splat.render.loss_and_gradient.background_of", press)
        assert main(command) == 128 + kind
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == before
    said = " ".join(capsys.readouterr().err.split())
    assert f"stopped after step 4; to continue: landscape {shlex.join(command)} --resume" in said
    assert load_checkpoint(out / "checkpoint.pt").training.step == 4 and not (out / "metrics.json").exists()
    assert main([*command, "--resume"]) == 0
    assert (out / "checkpoint.pt").read_bytes() == (finished / "checkpoint.pt").read_bytes()


def test_resuming_a_finished_run_scores_it_again_and_changes_nothing_else(original, finished, tmp_path):
    out = shutil.copytree(finished, tmp_path / "run")
    before = (out / "checkpoint.pt").read_bytes()
    (out / "metrics.json").unlink()
    assert main(arguments(original, out, "--resume")) == 0
    assert (out / "checkpoint.pt").read_bytes() == before and (out / "metrics.json").exists()


def test_resuming_with_other_settings_is_refused_by_name(finished, original, capsys):
    refuse(capsys, arguments(original, finished, "--resume", "--seed", "7"), "seed = 0, got 7", "--resume")
    refuse(capsys, arguments(original, finished, "--resume", "--ssim-weight", "0.5"), "loss.ssim_weight = 0.2, got 0.5")
    refuse(capsys, arguments(original, finished, "--resume", "--downscale", "2"), "downscale = 1.0, got 2.0")


def test_a_folder_that_exists_is_not_touched(original, tmp_path, capsys):
    out = tmp_path / "run"
    out.mkdir()
    (out / "precious").write_text("data")
    refuse(capsys, arguments(original, out), f"but {out} exists", "--resume")
    assert [p.name for p in out.iterdir()] == ["precious"]


def test_a_scene_that_cannot_be_is_refused(scene, tmp_path, capsys):
    def told(folder: Path, *words: str, options: tuple[str, ...] = ()) -> None:
        refuse(capsys, arguments(folder, tmp_path / "run", *options), *words)

    told(
        tmp_path / "nothing",
        "nothing does not exist; name the one that holds the cameras; landscape sfm makes it of photographs",
    )
    (tmp_path / "empty").mkdir()
    told(tmp_path / "empty", "camera poses", "empty folder")
    path = sorted((scene / "images").iterdir())[1]
    whole = path.read_bytes()
    Image.new("RGB", (24, 24)).save(path)
    told(scene, path.name, "24 x 18", "24 x 24")
    path.write_bytes(whole[: len(whole) // 2])
    told(scene, path.name)
    (scene / "transforms.json").unlink()
    told(scene, "camera poses", "COLMAP")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--views 30", "at most 4 training views, .*got 30"),
        ("--views 0", "at least 1 training view, got 0"),
        ("--views 1", "at least two views"),
        ("--iterations 0", "'iterations': expected int >= 1, got 0"),
        ("--sh-degree 4", "'sh_degree': expected int <= 3, got 4"),
        ("--set rates.quats=abc", "'rates.quats': expected float, got 'abc'"),
        ("--downscale 0.5", "downscale of at least 1"),
        ("--ssim-weight 2", "'ssim_weight': expected float <= 1.0, got 2.0"),
        ("--checkpoint-every 0", "checkpoint_every"),
        ("--seed -1", "seed"),
        ("--images elsewhere", "elsewhere"),
        ("--resume", "expected a run to resume.*--resume"),
        ("--set densify.every=50 --set densify.every=60", "expected each KEY once"),
        ("--no-densify --set densify.enabled=true", "--set densify.enabled=true beside the option --densify"),
        ("--seed 3 --set seed=4", "--set seed=4 beside the option --seed, which is 3; leave one out"),
        ("--method sam --protocol llff", r"a method with a published training for llff \(cor-gs, "),
        ("--set protocol=llff", "got 'protocol'"),
        ("--method stablgs", "a method among 3dgs, stablegs.*got 'stablgs'; did you mean stablegs\\?"),
    ],
)
def test_options_that_cannot_be_are_refused(original, tmp_path, capsys, options, words):
    refuse(capsys, arguments(original, tmp_path / "run", *options.split()), words)


@pytest.mark.parametrize("options", ["--iterations -5", "--sh-degree 4", "--method stablgs", "--set gama=1"])
def test_settings_are_refused_before_folders_are_looked_into(tmp_path, capsys, options):
    (out := tmp_path / "run").mkdir()
    refuse(capsys, ["train", str(tmp_path), "--out", str(out), *options.split()], options.split()[1].split("=")[0])


@pytest.mark.parametrize(
    "words", ["train SCENE", "probe a.ply --scene SCENE", "convert a.ply a.pt --scene=SCENE", "map SCENE"]
)
def test_a_scene_or_checkpoint_that_is_not_there_is_refused_before_libraries_load(tmp_path, capsys, monkeypatch, words):
    monkeypatch.setattr("analysis.commands.cli.import_module", lambda name: pytest.fail(f"{name} is loaded"))
    kind = "a checkpoint written by landscape train at" if words.startswith("map") else "a scene folder,"
    assert main(words.replace("SCENE", str(tmp_path / "gone")).split()) == 2
    one_sentence(capsys, f"expected {kind} {tmp_path / 'gone'}")


def test_training_views_are_listed_in_a_file(original, tmp_path, capsys):
    listed, empty, out = tmp_path / "list.txt", tmp_path / "empty.txt", tmp_path / "run"
    names = load_scene(original).names
    listed.write_text(f"{names[3]}\n\n{Path(names[0]).stem}\n")
    empty.write_text("\n")
    scene, split, _, _ = planned(TrainOptions(original, train_list=listed), out)
    assert split.train == (names[3], names[0]) and set(split.test) == {*names} - {names[3], names[0]}
    assert scene.names == names
    train = ["train", str(original), "--out", str(out), "--train-list"]
    refuse(capsys, [*train, str(empty)], "one in each line", "got none")
    refuse(capsys, [*train, str(listed), "--views", "2"], "--views or --train-list, got both")


def test_a_checkpoint_that_is_not_one_is_refused_on_resuming(finished, original, tmp_path, capsys):
    out = tmp_path / "run"
    out.mkdir()
    (out / "checkpoint.pt").write_bytes(b"not a checkpoint")
    refuse(capsys, arguments(original, out, "--resume"), "not one or is damaged")
    (out / "checkpoint.pt").write_bytes((finished / "checkpoint.pt").read_bytes()[:5000])
    refuse(capsys, arguments(original, out, "--resume"), "not one or is damaged")


def test_a_checkpoint_whose_scene_has_moved_says_so_and_takes_its_folder(scene, tmp_path, capsys):
    path = tmp_path / "run" / "checkpoint.pt"
    assert main(arguments(scene, path.parent)) == 0
    loaded = load_checkpoint(path)
    moved = scene.rename(tmp_path / "moved")
    refused("--scene", loaded.with_scene, path, error=FileNotFoundError)
    assert loaded.with_scene(path, moved).scene.names == loaded.with_scene(path, moved).scene.names
    transforms = json.loads((moved / "transforms.json").read_text())
    for frame in transforms["frames"]:
        frame.update(w=12, h=9, fl_x=frame["fl_x"] / 2, fl_y=frame["fl_y"] / 2, cx=6, cy=4.5)
        Image.new("RGB", (12, 9)).save(moved / frame["file_path"])
    (moved / "transforms.json").write_text(json.dumps(transforms))
    smaller = r"changes in 4 of 4: 'images/view_\d+.png': 12 x 9 px instead of 24 x 18 px"
    refused(smaller, loaded.with_scene, path, moved)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ("train", "expected SCENE, got none"),
        ("convert", "expected IN, got none"),
        ("train scene --views three", "expected --views INT|{all}, got 'three'"),
        ("train scene --save-at-psnr 30 high", "expected --save-at-psnr DB ..., got '30'"),
        ("slice run --radius far", "expected --radius FLOAT, got 'far'"),
        ("probe run --device gpu", "expected --device with one of 'auto', 'cpu', 'cuda', got 'gpu'"),
        ("view run --port", "expected a value after --port, got none"),
        ("slice run --wings 2", "expected no more words, got --wings, 2"),
        ("train scene --veiws 3", "expected its options, got --veiws, 3; did you mean --views?"),
        ("train scene --veiws 3 --quik", "expected its options, got --veiws, 3, --quik; did you mean --views?"),
    ],
)
@pytest.mark.parametrize("columns", ["50", "200"])
def test_arguments_that_cannot_be_read_are_said_in_one_sentence(wrong, sentence, columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    assert main(wrong.split()) == 2
    one_sentence(capsys, f"landscape: {sentence}; landscape {wrong.split()[0]} --help has all options, and an example")


def test_what_else_the_parser_says_is_passed_on(monkeypatch, capsys):
    def refused(*_, **__):
        print("╭─ \x1b[31mNews\x1b[0m ─╮\n│ the option is odd │\n╰─╯", file=sys.stderr)
        raise SystemExit(2)

    monkeypatch.setattr("analysis.commands.cli.tyro.cli", refused)
    assert main(["demo"]) == 2
    one_sentence(capsys, "expected options that can be read, got: News the option is odd; landscape demo --help")


def test_the_help_has_every_command_once_in_groups_and_theirs_an_example_within_60_lines(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as caught:
        main(["--help"])
    lines = capsys.readouterr().out.splitlines()
    assert caught.value.code == 0 and len(lines) <= 60
    assert [line for line in lines if line in ("make", "measure", "see", "use", "exchange")] == [*GROUPS]
    assert [line.split()[0] for line in lines if line.startswith("  ")] == [*COMMANDS]
    for name, command in COMMANDS.items():
        with pytest.raises(SystemExit):
            main([name, "--help"])
        said = capsys.readouterr().out
        assert f"Example: landscape {name} {command.example}".rstrip() in " ".join(said.split())
        assert len(said.splitlines()) <= 60, name
        assert ("--trained-by STR" in said) == (name == "convert"), name  # others refer to it, but for what most need
        foreign = name != "convert" and "foreign" in command.options.__dataclass_fields__
        assert ("--scene FOLDER: the scene on which a file" in said and "--views N or all" in said) == foreign, name


def test_a_command_that_there_is_not_is_refused_with_the_one_that_was_meant(capsys):
    assert main(["trian", "scene"]) == 2
    one_sentence(capsys, "expected a command among sfm, train, ", "got 'trian'; did you mean train?")
    assert main([]) == 2
    one_sentence(capsys, "expected a command among sfm, train, ", "got none; landscape --help lists them")


@pytest.mark.parametrize(
    "command", ["sfm", "train", "sweep", "probe", "slice", "compare", "demo", "trajectory", "bench"]
)
def test_help_says_what_an_option_that_is_left_out_stands_for(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "(default: None)" not in said and "(default: )" not in said
    if command == "train":
        assert all(method in said for method in METHODS)


def test_what_the_system_refuses_is_said_with_the_path(original, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(arguments(original, tmp_path / "file" / "run")) == 2
    one_sentence(capsys, f"landscape: cannot write in {tmp_path / 'file'}: Not a directory; choose another --out")


@pytest.mark.parametrize(("policy", "expected"), [(None, "PASSIVE"), ("ACTIVE", "ACTIVE")])
def test_a_process_prints_everything_ends_with_its_code_and_lets_threads_sleep_unless_told(policy, expected):
    program = (
        "import os, sys\nfrom analysis.commands import cli\n"
        "cli.main = lambda: print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules) or 3\ncli.command()"
    )
    left_out = ("OMP_WAIT_POLICY", "PYTHONUNBUFFERED")
    environment = {key: value for key, value in os.environ.items() if key not in left_out}
    environment |= {"OMP_WAIT_POLICY": policy} if policy else {}
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (3, f"{expected} False\n"), done.stderr


def test_the_held_out_views_of_a_scene_without_any_are_not_scored(tmp_path, capsys, original, monkeypatch):
    split = Split(load_scene(original).names[:3], (), "explicit")
    monkeypatch.setattr("analysis.train.command.split_scene", lambda *_: split)
    assert main(arguments(original, tmp_path / "run")) == 0
    assert "nothing was tested" in capsys.readouterr().out
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["test"] is None


def test_random_backgrounds_and_other_losses_train(original, tmp_path):
    out = tmp_path / "run"
    more = "--background random --pixel-loss charbonnier --no-densify --sh-degree 0 --views all"
    assert main(arguments(original, out, *more.split())) == 0
    config = load_checkpoint(out / "checkpoint.pt").training.config
    assert config.random_background and config.loss.pixel == "charbonnier" and not config.densify.enabled
    assert config.sh_degree == 0


def test_a_protocol_sets_what_no_option_gives_and_the_run_says_so(original, tmp_path):
    own = ["--method", "cor-gs", "--protocol", "llff", "--set", "prune_start=3"]
    options = [(), ("--background", "white", "--set", "densify.first_reset=7")]
    for out, more, background, reset in zip(("a", "b"), options, (True, False), (501, 7), strict=True):
        assert main(arguments(original, tmp_path / out, *own, *more)) == 0
        config = load_checkpoint(tmp_path / out / "checkpoint.pt").training.config
        assert (config.protocol, config.iterations) == ("llff", ITERATIONS)
        assert (config.random_background, config.densify.first_reset) == (background, reset)
        assert config.densify.prune_scale is None and config.densify.gradient_threshold == 5e-4
        metrics = json.loads((tmp_path / out / "metrics.json").read_text())
        assert (metrics["method"], metrics["protocol"]) == ("cor-gs", "llff")


def test_the_steps_of_a_protocol_are_taken_unless_others_are_given(original):
    own = TrainOptions(original, method="dropgaussian", protocol="llff")
    for given, steps in (({}, 10_000), ({"iterations": 30}, 30), ({"protocol": "common"}, 2000)):
        assert planned(replace(own, **given), Path("runs"))[2].iterations == steps


def test_a_method_and_its_settings_are_named_on_the_command_line(original, tmp_path):
    out = tmp_path / "stable"
    settings = ["--set", "warm_up=2", "--set", "every=2", "--set", "viewpoints=one"]
    assert main(arguments(original, out, "--method", "stablegs", *settings)) == 0
    method = load_checkpoint(out / "checkpoint.pt").training.config.method
    assert method == StableGS(warm_up=2, every=2, viewpoints="one")
    history = pd.read_csv(out / "history.csv")
    assert set(history["attribute"]) == set(ATTRIBUTES) and min(history["step"].tolist()) == 3


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_a_function_that_takes_what_it_is_given(name):
    command = COMMANDS[name]
    module, function = command.runs.split(":")
    given = [object()] * (1 + command.recorded + (command.draws is not None))
    signature = inspect.signature(getattr(importlib.import_module(f"analysis.{module}"), function))
    signature.bind(*given)
    assert next(iter(signature.parameters.values())).annotation is command.options


def test_a_run_stands_for_its_checkpoint_and_a_checkpoint_for_its_run(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    named = (
        ProbeOptions(run),
        SliceOptions(tmp_path / "none", (run,)),
        BenchOptions(run),
        TrainOptions(tmp_path, from_=run),
        ConvertOptions(run, tmp_path / "out.ply"),
        CompareOptions((run, run / "checkpoint.pt")),
    )
    assert [at_files(options) for options in named] == [*named[:5], CompareOptions((run, run))]
    (run / "checkpoint.pt").touch()
    probe, line, bench, train, convert, _ = (at_files(options) for options in named)
    assert train == TrainOptions(tmp_path, from_=run / "checkpoint.pt")
    assert convert == ConvertOptions(run / "checkpoint.pt", tmp_path / "out.ply")
    assert probe == ProbeOptions(run / "checkpoint.pt") and bench == BenchOptions(run / "checkpoint.pt")
    assert line == SliceOptions(tmp_path / "none", (run / "checkpoint.pt",))


def test_the_version_is_said(capsys):
    assert main(["--version"]) == 0
    assert re.fullmatch(r"splat-landscape \d+\.\S+\n", capsys.readouterr().out)


@pytest.mark.parametrize("command", ["train", "probe", "slice", "map", "prune", "uncertainty"])
@pytest.mark.parametrize("seed", ["-1", str(2**63)])
def test_every_command_has_the_same_rule_for_seeds(tmp_path, capsys, command, seed):
    assert main([command, str(tmp_path), "--seed", seed]) == 2
    assert f"expected a seed in [0, 2^63), got {seed}" in capsys.readouterr().err
