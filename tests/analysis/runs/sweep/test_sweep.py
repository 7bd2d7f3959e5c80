"""Sweeps: what a file stands for, what is refused, and that stopping, crashing and starting again lose and repeat nothing."""

import json
import math
import os
import re
import shutil
import signal
import sys
import threading
from dataclasses import replace
from pathlib import Path
from threading import Event

import pandas as pd
import pytest
import torch
import tyro

from analysis.commands.cli import main
from analysis.records.provenance import usable_cores
from analysis.runs.sweep.sweep import CELLS_ELSEWHERE, _Cells, lock_of, missing, only, probe_arguments
from analysis.runs.sweep.sweep_file import Sweep, arguments, read_sweep
from analysis.runs.sweep.sweep_results import results
from analysis.train.options import TrainOptions
from analysis.train.progress import TrainingTime
from splat.model.untrusted import locked
from splat.render.forward import background_of
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint
from splat.training.origin.fingerprint import FORMULAS
from tests import recorded
from tests.forks import Program, stand_in
from tests.recorded import synthetic
from tests.waiting import PATIENCE, waits_for

FILE = """
out = "out"
iterations = 6
checkpoint_every = 5
seeds = [1, 0]

[scenes.still]
path = "still"
views = 3
iterations = 12

[methods.3dgs]
[methods."asp only"]
method = "stablegs"
densify = false
checkpoint_every = 10
set = { vsp_weight = 0, warm_up = 5, every = 20, probe.attributes = ["means", "sh"], viewpoint.parallax = false }
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A scene and the file of a sweep beside it."""
    folder = tmp_path_factory.mktemp("sweep")
    settings = SyntheticSettings(gaussians=60, views=5, width=24, height=18)
    write_transforms_scene(synthetic_scene(settings).scene, folder / "still")
    (folder / "sweep.toml").write_text(FILE)
    return folder


def written(folder: Path, old: str, new: str, name: str = "changed.toml") -> Path:
    """The file with a part of it changed."""
    assert old in FILE
    path = folder / name
    path.write_text(FILE.replace(old, new))
    return path


def when(condition, act) -> threading.Thread:
    """Act as soon as the condition holds."""

    def watch() -> None:
        waits_for(condition)
        act()

    thread = threading.Thread(target=watch)
    thread.start()
    return thread


@pytest.fixture(scope="module")
def finished(folder) -> Sweep:
    """Two cells, run at once; the first had been stopped after three steps."""
    sweep = read_sweep(written(folder, "[1, 0]", "[1]", "finished.toml"))
    steps = []

    def press(*given):
        steps.append(1)
        if len(steps) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return background_of(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("splat.render.loss_and_gradient.background_of", press)
        assert main(arguments("train", sweep.cells[0].training)) == 130
    assert load_checkpoint(sweep.cells[0].out / "checkpoint.pt").training.step == 3
    assert main(["sweep", str(sweep.file), "--jobs", "2"]) == 0
    return sweep


@pytest.fixture
def no_commands(monkeypatch):
    """A list of the stages that would run, each a success, instead of running them."""
    ran: list[tuple[str, str]] = []

    def command(self, cell, stage, lock) -> int:
        ran.append((cell.name, stage))
        return 0

    monkeypatch.setattr(_Cells, "_command", command)
    return ran


def test_all_methods_of_a_seed_come_before_the_next_seed(folder):
    names = [cell.name for cell in read_sweep(folder / "sweep.toml").cells]
    assert names == ["still/3dgs/1", "still/asp only/1", "still/3dgs/0", "still/asp only/0"]


def test_narrower_settings_go_first_and_paths_are_those_of_the_file(folder):
    plain, asp, *_ = (cell.training for cell in read_sweep(folder / "sweep.toml").cells)
    assert plain == TrainOptions(
        folder / "still", folder / "out/still/3dgs/1", views=3, iterations=12, seed=1, checkpoint_every=5
    )
    assert (asp.method, asp.iterations, asp.checkpoint_every, asp.densify) == ("stablegs", 12, 10, False)
    changes = ("vsp_weight=0", "warm_up=5", "every=20", "probe.attributes=means,sh", "viewpoint.parallax=false")
    assert asp.set == changes
    assert read_sweep(folder / "sweep.toml", Path("elsewhere")).cells[0].out == Path("elsewhere/still/3dgs/1")


def test_cells_of_a_protocol_count_its_steps_unless_the_file_gives_others(folder):
    file = written(folder, "iterations = 12", 'protocol = "llff"')
    for steps in (6, 10_000):
        cells = [cell for cell in read_sweep(file).cells if cell.training.method == "stablegs"]
        assert {cell.steps for cell in cells} == {steps}
        assert "--protocol" in arguments("train", cells[0].training)
        file.write_text(file.read_text().replace("iterations = 6", ""))


def test_a_cell_is_the_command_that_a_user_would_type(folder):
    for cell in read_sweep(folder / "sweep.toml").cells:
        assert tyro.cli(TrainOptions, args=arguments("train", cell.training)[1:]) == cell.training


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('path = "still"', "", "expected the folder of the scene as scenes.still.path"),
        ("views = 3", 'views = "few"', "'scenes.still.views': expected int or 'all', got 'few'"),
        ("views = 3", "view = 3", "expected a key among path, .*, got scenes.still.view"),
        ("views = 3", "seed = 3", "expected a key among path, .*, got scenes.still.seed"),
        ("iterations = 6", "iterations = 0.5", "'iterations': expected int.*, got .*0.5"),
        ("iterations = 6", "iteration = 6", "expected a key among out, seeds, .*, got iteration"),
        ("seeds = [1, 0]", "seeds = [1, 1]", r"expected different seeds, at least one, got seeds = \[1, 1\]"),
        ("seeds = [1, 0]", "seeds = [0.5]", "'seeds.0.': expected int, got"),
        ('out = "out"', "", "expected the folder of the results"),
        ("[scenes.still]", "[scenes]", "expected a table .scenes.path., got path = 'still'"),
        ('"asp only"', '"../asp"', "as it names a folder, got '../asp'"),
        ("set = {", "sets = {", "expected a key among method, .*, got methods.asp only.sets"),
        ('method = "stablegs"', "method = 3 4", "expected a sweep in TOML in .*at line"),
        ("densify = false", "densify = 0", "'methods.asp only.densify': expected bool, got 0"),
    ],
)
def test_a_file_with_a_mistake_is_refused_by_the_key(folder, old, new, message):
    with pytest.raises(ValueError, match=message):
        read_sweep(written(folder, old, new))


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"expected a sweep in TOML at .*gone\.toml, found no such file"):
        read_sweep(tmp_path / "gone.toml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("vsp_weight = 0", "vsp_wait = 0", "still/asp only/1: expected a setting of .*'vsp_wait'.* vsp_weight"),
        ('method = "stablegs"', 'method = "magic"', "still/asp only/1: expected a method among .*, got 'magic'"),
        ("views = 3", "views = 30", "still/3dgs/1: .*at most 4 training views.*got 30"),
        ('path = "still"', 'path = "gone"', "still/3dgs/1: .*gone"),
    ],
)
def test_no_cell_starts_where_one_cannot(folder, no_commands, capsys, old, new, message):
    assert main(["sweep", str(written(folder, old, new)), "--out", str(folder / "never")]) == 2
    assert re.search(message, capsys.readouterr().err)
    assert no_commands == [] and not (folder / "never").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_stops_a_sweep_stops_its_cells_after_they_have_saved(folder, tmp_path, capsys, monkeypatch, number):
    if number == signal.SIGTERM:  # as under nohup, for the sweep and for its cells
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    else:
        stand_in(monkeypatch)
    before = signal.getsignal(signal.SIGINT)
    run = tmp_path / "still/3dgs/1"
    thread = when((run / "seconds.json").exists, lambda: os.kill(os.getpid(), number))
    endless = written(folder, "iterations = 12", "iterations = 1000000")
    try:
        assert main(["sweep", str(endless), "--out", str(tmp_path)]) == 128 + number
        assert signal.getsignal(signal.SIGINT) is before
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        thread.join()
    assert pd.read_csv(tmp_path / "results.csv")["status"].tolist() == ["under way", "to do", "to do", "to do"]
    step = load_checkpoint(run / "checkpoint.pt").training.step
    assert f"stopped after step {step}; to continue: landscape train" in run.with_name("1.log").read_text()
    assert "0 of 4 cells done" in capsys.readouterr().out


def test_a_cell_that_was_stopped_ends_with_the_same_bits(finished, tmp_path):
    cell = finished.cells[0]
    whole = cell.out.with_name("whole")
    assert main(arguments("train", replace(cell.training, out=whole))) == 0
    assert (whole / "checkpoint.pt").read_bytes() == (cell.out / "checkpoint.pt").read_bytes()


def test_what_is_done_is_not_done_again(finished, folder, no_commands):
    before = (folder / "out/results.csv").read_bytes(), (folder / "out/summary.csv").read_bytes()
    assert main(["sweep", str(finished.file)]) == 0 and no_commands == []
    assert before == ((folder / "out/results.csv").read_bytes(), (folder / "out/summary.csv").read_bytes())


def test_only_the_cells_asked_for_run_and_the_tables_keep_the_others(finished, folder, no_commands, capsys):
    whole = read_sweep(folder / "sweep.toml")
    assert [cell.name for cell in only(whole, ["still/asp only", "still/3dgs/0"]).cells] == [
        "still/asp only/1", "still/3dgs/0", "still/asp only/0",
    ]  # fmt: skip
    assert main(["sweep", str(finished.file), "--only", "still/3dgs/1"]) == 0
    assert "1 of 1 cells done" in capsys.readouterr().out and not no_commands
    rows = pd.read_csv(finished.out / "results.csv")
    assert list(rows["status"]) == ["done", "done"] and not list(rows["psnr"][rows["psnr"].isna()])
    assert main(["sweep", str(whole.file), "--only", "still/3d"]) == 2
    assert "expected --only still/3dgs, still/asp only" in capsys.readouterr().err


def test_what_is_done_with_other_settings_is_refused_by_name(finished, folder, no_commands, capsys):
    for old, new, message in [
        ("iterations = 12", "iterations = 13", "iterations = 12, got 13; remove"),
        ("warm_up = 5", "warm_up = 6", "method.warm_up = 5, got 6; remove"),
        ("views = 3", "views = 2", "still/3dgs/1: expected the settings"),
    ]:
        assert main(["sweep", str(written(folder, old, new))]) == 2
        assert message in " ".join(capsys.readouterr().err.split())
    assert no_commands == []


def test_a_cell_that_fails_does_not_end_the_sweep(finished, folder, tmp_path, monkeypatch, capsys):
    def command(self, cell, stage, lock) -> int:
        ran.append((cell.name, stage))
        if cell.method == "3dgs":
            return -9
        if stage == "train":  # its files appear whole, as those of a training do
            cell.out.parent.mkdir(parents=True, exist_ok=True)
            Path(shutil.copytree(finished.cells[1].out, tmp_path / "copy")).rename(cell.out)
        return 0

    ran = []
    monkeypatch.setattr(_Cells, "_command", command)
    probing = written(folder, "[scenes.still]", "[probe]\n[scenes.still]")
    words = ["sweep", str(probing), "--out", str(tmp_path / "out")]
    assert main(words) == 1
    failed, good = ("still/3dgs/1", "still/3dgs/0"), ("still/asp only/1", "still/asp only/0")
    assert sorted(ran) == sorted([(name, "train") for name in failed + good] + [(name, "probe") for name in good])
    said = " ".join(capsys.readouterr().out.split())
    assert "still/3dgs/1: train ended with exit code -9; see" in said and "the same command continues" in said
    statuses = pd.read_csv(tmp_path / "out/results.csv").set_index(["method", "seed"])["status"]
    assert statuses.loc[("3dgs", 1)] == "failed" and statuses.loc[("asp only", 1)] == "done"


def test_damaged_scores_end_a_sweep_before_it_starts(finished, folder, tmp_path, no_commands, capsys):
    path = Path(shutil.copytree(folder / "out", tmp_path / "out")) / "still/3dgs/1/metrics.json"
    path.write_text("")
    assert main(["sweep", str(folder / "sweep.toml"), "--out", str(tmp_path / "out")]) == 2
    assert f"in {path}, got a damaged file" in " ".join(capsys.readouterr().err.split()) and no_commands == []


def test_a_cell_of_another_sweep_is_left_to_it(folder, tmp_path, no_commands, capsys):
    words = ["sweep", str(folder / "sweep.toml"), "--out", str(tmp_path)]
    taken = read_sweep(folder / "sweep.toml", tmp_path).cells[0]
    lock_of(taken).parent.mkdir(parents=True)
    with locked(lock_of(taken), "this alone"):
        assert main([*words, "--only", taken.name]) == CELLS_ELSEWHERE
    assert "still/3dgs/1: another sweep is at it 0 of 1 cells done" in " ".join(capsys.readouterr().out.split())
    assert no_commands == [] and not list(tmp_path.rglob(".*"))


def test_two_sweeps_share_the_cells_and_the_last_writes_all(folder, tmp_path, monkeypatch):
    """The second lists all as missing, and begins when the first has made one."""
    words = ["sweep", str(written(folder, "iterations = 12", "iterations = 40")), "--out", str(tmp_path)]
    cell, run = read_sweep(folder / "changed.toml", tmp_path).cells[0], _Cells.run

    def waits(cells: _Cells) -> None:
        waits_for(lambda: (cell.out / "metrics.json").exists() and not lock_of(cell).exists())
        run(cells)

    monkeypatch.setattr(_Cells, "run", waits)
    stand_in(monkeypatch)
    with Program([sys.executable, "-m", "analysis.commands.cli", *words]) as first:
        codes = {main(words), first.wait(timeout=PATIENCE)}
    assert codes <= {0, CELLS_ELSEWHERE} and 0 in codes
    rows = pd.read_csv(tmp_path / "results.csv")
    assert list(rows["status"]) == ["done"] * 4 and list(rows["psnr"].notna()) == [True] * 4
    logs = [path.read_text() for path in tmp_path.rglob("*.log")]
    assert [log.count("$ landscape train") for log in logs] == [1] * 4


def test_a_cell_is_probed_once_and_again_where_the_control_is_new(finished, folder):
    controlled = "[probe]\nsplit_control = true"
    with_probe = read_sweep(written(folder, "[scenes.still]", "[probe]\n[scenes.still]", "probed.toml"))
    control = read_sweep(written(folder, "[scenes.still]", f"{controlled}\n[scenes.still]"))
    cell = with_probe.cells[0]
    assert missing(cell, finished) == [] and missing(cell, with_probe) == missing(cell, control) == ["probe"]
    data, arrays = synthetic()
    data["provenance"] |= recorded.own(cell.out)
    recorded.written(cell.out / "probe", data, arrays)
    try:
        assert missing(cell, with_probe) == [] and missing(cell, control) == ["probe"]
        assert probe_arguments(cell, control)[4:] == ["--split-control"]
        row = results([cell], {cell.name: "done"}).iloc[0]
        assert row["trace_means"] == data["traces"]["means"]["value"] and row["lambda_min_error"] == 3.0
        assert (row["negative_ratio_low"], row["negative_ratio_high"]) == (1 / 143.0, 1 / 139.0)
        assert row["top_mass"] is None
        data["provenance"] |= recorded.own(cell.out, split_control=True)  # more than was asked for
        recorded.written(cell.out / "probe", data, arrays)
        assert missing(cell, with_probe) == missing(cell, control) == []
        for other in ({"loss": "3dgs", "seed": 1}, {"quick": True}):
            data["provenance"] |= recorded.own(cell.out, **other)
            recorded.written(cell.out / "probe", data, arrays)
            assert missing(cell, with_probe) == ["probe"]
        data["provenance"] |= recorded.own(cell.out)
        data["provenance"]["fingerprint"] |= {"formulas": FORMULAS + 1}  # no reason to do it again
        recorded.written(cell.out / "probe", data, arrays)
        assert missing(cell, with_probe) == []
        data["provenance"]["fingerprint"] |= {"state": "of another"}
        recorded.written(cell.out / "probe", data, arrays)
        assert missing(cell, with_probe) == ["probe"]
    finally:
        shutil.rmtree(cell.out / "probe")
    scores = cell.out / "metrics.json"
    text, state = scores.read_text(), load_checkpoint(cell.out / "checkpoint.pt").state
    scores.write_text(text.replace(state, "of another"))
    assert missing(cell, finished) == ["train"]  # which scores again
    scores.write_text(text)
    assert missing(cell, finished) == []


def test_the_results_are_the_runs_own_metrics(finished, folder):
    rows = pd.read_csv(folder / "out/results.csv")
    assert rows["status"].tolist() == ["done"] * 2 and rows["seed"].tolist() == [1, 1]
    for cell, row in zip(finished.cells, rows.to_dict("records"), strict=True):
        metrics = json.loads((cell.out / "metrics.json").read_text())
        assert (row["psnr"], row["train_ssim"]) == (metrics["test"]["psnr"], metrics["train"]["ssim"])
        assert row["gaussians"] == len(load_checkpoint(cell.out / "checkpoint.pt").training.gaussians)
        assert row["wall_seconds"] == metrics["seconds"]["wall"] > 0 and metrics["seconds"]["step"] == 12
    share = max(1, int(os.environ.get("OMP_NUM_THREADS", usable_cores())) // 2)
    began = share if torch.get_num_threads() == share else math.nan  # the first began in this process
    assert rows["threads"].tolist() == pytest.approx([began, share], nan_ok=True)


def test_the_time_left_is_told_at_the_pace_of_the_steps_so_far(folder, tmp_path, monkeypatch):
    """Two of four trainings of 12 steps, one of which was there before."""
    sweep = read_sweep(folder / "sweep.toml", tmp_path)
    monkeypatch.setattr(TrainingTime, "read", lambda run: TrainingTime(12 * (run == sweep.cells[0].out), 0.0, 0.0))
    cells = _Cells(sweep, {cell.name: [] for cell in sweep.cells}, 1, Event(), sweep)
    monkeypatch.setattr("analysis.runs.sweep.sweep.monotonic", lambda: cells.start + 60)
    assert cells.left(12) == "--" and cells.left(24) == "0:02:00"
