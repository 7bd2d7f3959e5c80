"""Probes that are refused, interrupted or killed, or whose pictures fail: what they say and what they leave."""

import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

from analysis.commands.cli import main
from analysis.records.records import read_record
from splat.scenes.synthetic import synthetic_scene
from splat.scenes.write import write_transforms_scene
from tests.analysis.probe.probed import SCENE

ROOT = Path(__file__).parents[3]


def refused(capsys, arguments: list[str], *expected: str) -> None:
    assert main(["probe", *arguments]) == 2
    said = capsys.readouterr()
    assert said.err.startswith("landscape: ") and "Traceback" not in said.err and said.out == ""
    message = said.err.strip()
    assert message.count("\n") == 0, message
    for part in expected:
        assert part in message, message


def test_a_seed_below_zero_is_refused_as_that_of_a_training_is(run, tmp_path, capsys):
    refused(capsys, [str(run / "double.pt"), "--out", str(tmp_path / "out"), "--seed=-1"], "seed in [0, 2^63), got -1")
    assert not (tmp_path / "out").exists()


def test_bad_input_gets_one_sentence_and_leaves_nothing(run, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(run.parent / "still", tmp_path / "scene")
    copy.mkdir()
    path = copy / "checkpoint.pt"
    refused(capsys, [str(path)], "expected a checkpoint", "found no such file")
    refused(capsys, [str(copy)], "found a folder without one; name the run that landscape train wrote")
    refused(capsys, [str(run.parent)], f"found a folder of runs; name one of them, such as {run}")
    path.write_bytes(b"not a checkpoint")
    refused(capsys, [str(path)], "not one or is damaged")
    shutil.copy(run / "checkpoint.pt", path)
    (copy / "probe").mkdir()
    refused(capsys, [str(copy / "probe")], f"found a folder within the run {copy}; name that")
    (copy / "probe").rmdir()
    refused(capsys, [str(path), "--scene", str(tmp_path / "nowhere")], "does not exist")
    write_transforms_scene(synthetic_scene(replace(SCENE, views=2)).scene, tmp_path / "other")
    refused(
        capsys, [str(path), "--scene", str(tmp_path / "other")], f"the training's scene still in {tmp_path / 'other'}"
    )
    refused(capsys, [str(path), "--slice-points", "4"], "odd number")
    (copy / "probe").mkdir()
    (copy / "probe" / "thesis.txt").write_text("years of work")
    refused(capsys, [str(path), "--scene", str(tmp_path / "scene")], "older record to replace", "move it away")
    assert sorted(p.name for p in copy.rglob("*")) == ["checkpoint.pt", "probe", "thesis.txt"]


def test_a_scene_that_has_moved_is_named_with_the_option_and_found_there(run, tmp_path, capsys, no_pictures):
    still, away = run.parent / "still", tmp_path / "away"
    still.rename(away)
    try:
        refused(capsys, [str(run / "checkpoint.pt"), "--out", str(tmp_path / "probe")], "--scene")
        options = ["--scene", str(away), "--out", str(tmp_path / "probe"), "--quick"]
        assert main(["probe", str(run / "checkpoint.pt"), *options]) == 0
    finally:
        away.rename(still)
    assert read_record(tmp_path / "probe").data.provenance.scene_folder == str(away)


def test_an_interrupted_probe_keeps_its_stages_and_says_how_to_go_on(run, tmp_path, monkeypatch, capsys):
    def interrupt(target):
        raise KeyboardInterrupt

    words = ["probe", str(run / "checkpoint.pt"), "--out", str(tmp_path / "probe"), "--quick"]
    monkeypatch.setattr("analysis.console.drawing.drawing", lambda *_: nullcontext(interrupt))
    assert main(words) == 130
    assert [path.name for path in tmp_path.iterdir()] == [".probe.unfinished"]
    said = capsys.readouterr().err
    assert "kept: eigenvalues, renders, slice, traces; the same command continues" in said
    assert " ".join(words) in said
    monkeypatch.setattr("analysis.console.drawing.drawing", lambda *_: nullcontext(lambda target: []))
    monkeypatch.setattr("analysis.probe.measurement.extreme_eigenpairs", None)  # it is not searched for again
    assert main([*words, "--strict"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["probe"]
    assert read_record(tmp_path / "probe").data.eigenvalues.max.reason == "tolerance"


def test_numbers_are_kept_where_the_pictures_fail(run, tmp_path, monkeypatch):
    failed = ["drawing failed: no fonts"]
    monkeypatch.setattr("analysis.console.drawing.drawing", lambda *_: nullcontext(lambda target: failed))
    assert main(["probe", str(run / "checkpoint.pt"), "--out", str(tmp_path / "probe"), "--quick"]) == 0
    assert "drawing failed: no fonts" in read_record(tmp_path / "probe").data.notes
    assert "Drawing failed: no fonts." in (tmp_path / "probe" / "report.html").read_text()
