"""Probing a checkpoint: the numbers against a dense Hessian, the record's layout, budgets, refusals, interruptions."""

import json
import math
import shutil
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from analysis.budget import SHARES
from analysis.cli import main
from analysis.measurement import ProbeSettings
from analysis.options import ProbeOptions
from analysis.probe import run_probe, scene_objective
from analysis.probe_record import literal_index
from analysis.probe_table import probe_table
from analysis.records import Record, read_record
from landscape import DenseOperator, EigenSettings, PowerSettings, extreme_eigenpairs, power_ends
from splat.adam import Adam
from splat.checkpoint import load_checkpoint, save_checkpoint
from splat.densify import ScreenGradients
from splat.depth import STEPS, depth_split
from splat.losses import photometric_loss
from splat.render import render
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene

ROOT = Path(__file__).parents[2]
SCENE = SyntheticSettings(gaussians=60, views=5, width=16, height=12)
ATTRIBUTES = ["means", "log_scales", "quats", "opacity_logits", "sh"]
UNLIMITED = ["--seconds", "inf", "--slice-points", "5"]


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run folder with its scene beside it; the checkpoint is in double precision."""
    folder = tmp_path_factory.mktemp("probe")
    write_transforms_scene(synthetic_scene(SCENE).scene, folder / "still")
    out = folder / "run"
    train = [
        "train",
        str(folder / "still"),
        "--out",
        str(out),
        "--iterations",
        "30",
        "--no-densify",
        "--sh-degree",
        "1",
    ]
    assert main(train) == 0
    loaded = load_checkpoint(out / "checkpoint.pt")
    gaussians = loaded.training.gaussians.to(torch.float64)
    state = Adam.zero(gaussians), ScreenGradients.zero(len(gaussians), torch.float64)
    training = replace(loaded.training, gaussians=gaussians, adam=state[0], screen_gradients=state[1])
    save_checkpoint(out / "double.pt", training, loaded.scene)
    return out


@pytest.fixture(scope="module")
def record(run) -> Record:
    assert main(["probe", str(run / "double.pt"), "--out", str(run / "recorded"), *UNLIMITED]) == 0
    return read_record(run / "recorded")


@pytest.fixture
def no_pictures(monkeypatch):
    """For tests of the numbers alone."""
    monkeypatch.setattr("analysis.drawing.drawing", lambda *_: nullcontext(lambda target: []))


@pytest.fixture(scope="module")
def dense(run):
    """(objective, P H P, L, gradient): double backward through the reference renderer, on the quaternions' tangent spaces."""
    path = run / "double.pt"
    loaded = load_checkpoint(path)
    objective = scene_objective(loaded, loaded.load_scene(path))
    active, settings = objective.active, loaded.training.config.loss

    def loss(flat):
        images = (render(active.with_flat(flat), v.camera, backend="reference").image for v in objective.views)
        losses = [photometric_loss(i, v.image.double(), settings) for i, v in zip(images, objective.views, strict=True)]
        return torch.stack(losses).mean()

    point = active.flat.clone().requires_grad_()
    value = loss(point)
    (gradient,) = torch.autograd.grad(value, point, create_graph=True)
    (H,) = torch.autograd.grad(
        gradient, point, torch.eye(len(point), dtype=torch.float64), retain_graph=True, is_grads_batched=True
    )
    gradient = gradient.detach()
    for i, q in enumerate(active.quats):
        rows = slice(active.blocks["quats"].start + 4 * i, active.blocks["quats"].start + 4 * i + 4)
        H[rows] -= torch.outer(q, q @ H[rows])
        H[:, rows] -= torch.outer(H[:, rows] @ q, q)
    return objective, H, float(value.detach()), gradient


def rounding(H) -> float:
    """What the kernels' round-off may do to an entry: they agree with the reference to 1e-10 of the largest."""
    return 1e-10 * float(H.abs().max()) * len(H)


def test_traces_are_within_four_standard_errors_of_the_dense_hessian(record, dense):
    objective, H, _, _ = dense
    assert list(record.data["traces"]) == ATTRIBUTES
    for name, trace in record.data["traces"].items():
        rows = objective.blocks[name]
        exact = float(H[rows, rows].trace())
        assert abs(trace["value"] - exact) <= 4 * trace["standard_error"] + rounding(H), name
        size = float(H[rows, rows].diagonal().abs().sum())
        assert trace["standard_error"] < 0.1 * size, name  # so that the line above says something
        each = {"means": 3, "log_scales": 3, "quats": 3, "opacity_logits": 1, "sh": 3 * objective.active.sh.shape[1]}
        assert trace["dim"] == len(objective.active) * each[name]
        assert trace["tau"] == math.sqrt(max(trace["value"], 0) / trace["dim"])
        assert record.arrays["traces"][name].mean() == pytest.approx(trace["value"], rel=1e-12)


def test_eigenvalues_are_those_of_the_dense_hessian_within_their_residuals(record, dense):
    _, H, _, _ = dense
    true = torch.linalg.eigvalsh((H + H.T) / 2)
    for name, index in (("max", -1), ("second", -2), ("min", 0)):
        end = record.data["eigenvalues"][name]
        assert abs(end["value"] - float(true[index])) <= end["residual"] + rounding(H), name
        assert end["residual"] <= 1e-3 * abs(end["value"]) and end["reason"] == "tolerance"
        assert sum(end["shares"].values()) == pytest.approx(1) and list(end["shares"]) == ATTRIBUTES
    saddle = record.data["anisotropy"]["saddle"]
    assert saddle["low"] <= float(-true[-1] / true[0]) <= saddle["high"]
    share = record.data["anisotropy"]["share"]
    assert share["low"] <= float(true[-1] / true.abs().sum()) <= share["high"]


def test_the_literal_index_is_the_papers_power_iteration_beside_the_certain_bracket(record, dense):
    _, H, _, _ = dense
    ends, literal = record.data["eigenvalues"], record.data["anisotropy"]["literal"]
    true = torch.linalg.eigvalsh((H + H.T) / 2)
    assert literal["low"] <= float(true[-1] / true[0]) <= literal["high"]
    paper = ends["power_max"]["value"] / ends["power_min"]["value"]
    arrived = literal["low"] <= paper <= literal["high"]
    assert literal["value"] == (paper if arrived else ends["max"]["value"] / ends["min"]["value"])
    assert ("did not arrive" in literal["note"]) == (not arrived)


@pytest.mark.parametrize(("steps", "says"), [(2, "by Lanczos"), (2000, "by power iteration")])
def test_a_power_iteration_that_did_not_arrive_gives_no_index(steps, says):
    operator, generator = DenseOperator(torch.diag(torch.linspace(-1, 3, 40, dtype=torch.float64))), torch.Generator()
    power = power_ends(operator, generator.manual_seed(0), PowerSettings(rtol=1e-9, max_matvecs=steps))
    index = literal_index(extreme_eigenpairs(operator, generator), power)
    assert index["value"] == pytest.approx(-3, rel=1e-2) and index["note"].startswith(says)
    assert index["low"] <= index["value"] <= index["high"]


def test_within_a_bracket_without_bound_a_power_iteration_that_ran_out_has_not_arrived():
    operator, generator = (
        DenseOperator(torch.diag(torch.linspace(-1e-3, 3, 400, dtype=torch.float64))),
        torch.Generator(),
    )
    ends = extreme_eigenpairs(operator, generator.manual_seed(0), EigenSettings(max_matvecs=7))
    late, arrived = (
        power_ends(operator, generator, PowerSettings(0.1, atol=1e-2, max_matvecs=steps)) for steps in (2, 3000)
    )
    index = literal_index(ends, late)
    assert index["high"] is None and index["note"].startswith("by Lanczos: the paper's power iteration did not arrive")
    assert literal_index(ends, arrived)["note"].startswith("by power iteration")


def test_the_slice_is_made_of_true_losses_along_the_two_steepest_directions(record, dense):
    objective, H, value, _ = dense
    about, arrays = record.data["slice"], record.arrays["slice"]
    assert arrays["loss"].shape == arrays["model"].shape == arrays["crossed"].shape == (5, 5)
    assert about["center_loss"] == pytest.approx(value, rel=1e-12)
    assert about["points"] == 25 and about["evaluated_points"] == arrays["evaluated"].sum() == about["evaluations"] - 1
    assert arrays["loss"][2, 2] == about["center_loss"] == arrays["model"][2, 2] and not arrays["crossed"][2, 2]
    values, vectors = torch.linalg.eigh((H + H.T) / 2)
    for axis, (name, index) in enumerate((("x", -1), ("y", -2))):
        unit = math.sqrt(2 * about["loss_scale"] / float(values[index]))
        assert about["directions"][axis]["unit"] == pytest.approx(unit, rel=1e-4)
        assert arrays[name] == pytest.approx(np.linspace(-3, 3, 5) * unit, rel=1e-4)
    assert about["loss_scale"] == pytest.approx(1e-3 * value)
    # a vector is known up to its sign and its error: the losses on the axis are those along the dense one
    for sign in (1, -1):
        along = [objective.loss(objective.active.flat + sign * x * vectors[:, -1]) for x in arrays["x"]]
        if along == pytest.approx(arrays["loss"][:, 2].tolist(), rel=1e-4):
            break
    else:
        pytest.fail(f"{along} are not {arrays['loss'][:, 2]}")


def test_the_record_has_the_layout_and_says_what_was_skipped_and_from_where_it_comes(record, dense, run):
    objective, H, value, gradient = dense
    data = record.data
    for key in ("traces", "eigenvalues", "anisotropy", "counts", "checks", "timing", "provenance"):
        assert data[key], key
    assert {"max", "min"} <= set(data["eigenvalues"]) and {"literal", "saddle"} <= set(data["anisotropy"])
    counts, loaded = data["counts"], load_checkpoint(run / "double.pt")
    assert counts["gaussians"] == len(loaded.training.gaussians) and counts["views"] == 3
    assert counts["visible_gaussians"] == counts["gaussians"] - counts["skipped_gaussians"] == len(objective.active)
    assert counts["active_parameters"] == len(H) - len(objective.active) and counts["rank"] <= len(H)
    assert all(check["passed"] for check in data["checks"].values())
    assert set(data["checks"]) == {"symmetry", "round_off", "finiteness", "finite_difference"}
    assert data["objective"]["value"] == pytest.approx(value, rel=1e-12)
    assert data["objective"]["gradient_norm"] == pytest.approx(float(gradient.norm()), rel=1e-9)
    stages = ["load", "linearise", "checks", *SHARES, "skips", "pictures"]
    assert list(data["timing"]) == [*stages, "total"]
    assert sum(data["timing"][stage] for stage in stages) <= data["timing"]["total"]
    provenance = data["provenance"]
    assert (provenance["seed"], provenance["iteration"], provenance["dtype"]) == (0, 30, "float64")
    assert provenance["scene_folder"] == str(run.parent / "still") and provenance["command"].startswith(
        "landscape probe"
    )
    assert record.arrays["spectrum"]["ritz_values"][-1] == pytest.approx(data["eigenvalues"]["max"]["value"], rel=1e-9)
    files = ["slice2d.png", "spectrum.png", "surface.png", "traces.png", "report.html", "probe.json"]
    assert all((record.folder / file).stat().st_size > 5000 for file in files)


def test_what_was_skipped_is_counted_and_its_time_said(record, dense, run):
    objective, _, _, _ = dense
    skipped, gaussians = record.data["skipped"], load_checkpoint(run / "double.pt").training.gaussians
    views = list(objective.linearized)
    assert {name: skip["count"] for name, skip in skipped.items()} == {
        "gaussians_out_of_sight": len(gaussians) - len(objective.active),
        "sh_bands_not_in_use": 0,
        "entries_behind_opaque_fronts": sum(view.entries_behind for view in views),
        "tiles_of_zero_cotangent": sum(view.dark_tiles for view in views),
        "products_of_views_not_concerned": 0,
        "samples_of_finished_traces": sum(128 - trace["probes"] for trace in record.data["traces"].values()),
        "points_of_the_slice_predicted": int((~record.arrays["slice"]["evaluated"]).sum()),
    }
    assert all((skip["seconds_saved"] > 0) <= (skip["count"] > 0) for skip in skipped.values())


def test_the_eigenvectors_are_said_to_live_where_the_dense_ones_do(record, dense):
    objective, H, _, _ = dense
    vectors = torch.linalg.eigh((H + H.T) / 2).eigenvectors
    for name, index in (("max", -1), ("min", 0)):
        where = record.data["eigenvalues"][name]["lives_on"]
        v = objective.active.with_flat(vectors[:, index])
        mass = torch.stack([part.reshape(len(v), -1).square().sum(dim=1) for part in v.attributes.values()]).sum(dim=0)
        assert where["participation"] == pytest.approx(float(1 / mass.square().sum()), rel=1e-2)
        heaviest, share = where["heaviest"][0]
        assert heaviest == int(mass.argmax()) and share == pytest.approx(float(mass.max()), rel=1e-2)


def test_the_finite_probe_meets_the_curvature_where_nothing_is_crossed(record):
    probe = record.data["finite_probe"]
    assert probe["infinitesimal"] == pytest.approx(record.data["eigenvalues"]["max"]["value"], rel=1e-5)
    best = probe["best"]
    bound = probe["round_off"][best] + probe["truncation"][best]
    assert not probe["crossed"][best]
    assert abs(probe["curvatures"][best] - probe["infinitesimal"]) <= bound < 0.1 * probe["infinitesimal"]


def test_positions_are_split_along_and_across_the_rays(record, dense):
    found, objective = record.data["depth"], dense[0]
    split = depth_split(objective, torch.Generator().manual_seed(1))
    assert found["gradient_ratio"] == pytest.approx(split.gradient_ratio, rel=1e-6)
    assert found["gradient_median"] == pytest.approx(split.median_ratio, rel=1e-6)
    assert found["pairs"] == len(split.components) <= len(objective.active) * len(objective.views)
    depth, lateral = found["curvature"]["depth"], found["curvature"]["lateral"]
    whole = record.data["traces"]["means"]
    error = math.hypot(*(trace["standard_error"] for trace in (depth, lateral, whole)))
    assert abs(depth["value"] + lateral["value"] - whole["value"]) < 5 * error
    assert found["curvature_ratio"]["value"] == pytest.approx(2 * depth["value"] / lateral["value"], rel=1e-12)
    assert [row["pixels"] for row in found["rises"]] == list(STEPS)
    for row in found["rises"]:
        assert row["ratio"] == pytest.approx(row["depth"] / row["lateral"], rel=1e-12)
        assert min(row[f"{kind}_error"] for kind in ("depth", "lateral", "ratio")) > 0
        assert 0 <= row["depth_crossed"] <= 1
    console = Console(width=140, record=True, file=StringIO())
    console.print(probe_table(record.data))
    table = console.export_text()
    assert "depth gradient / lateral" in table and "depth curvature / lateral" in table
    assert all(f"depth / lateral rise, {step:g} px" in table for step in STEPS)


def test_quantiles_ascend_and_hold_those_of_the_dense_spectrum(record, dense):
    _, H, _, _ = dense
    found, null = record.data["quantiles"], len(H) - record.data["counts"]["rank"]
    true = torch.linalg.eigvalsh((H + H.T) / 2)
    true = true[true.abs().argsort()][null:].sort().values  # the exact null space left out
    values = [found[share]["value"] for share in found]
    assert values == sorted(values) and len(values) == 7
    held = 0
    for share, entry in found.items():
        at = float(true[min(int(float(share) * len(true)), len(true) - 1)])
        low = -math.inf if entry["low"] is None else entry["low"]
        high = math.inf if entry["high"] is None else entry["high"]
        held += low - rounding(H) <= at <= high + rounding(H)
    assert held == 7


def numbers(record: Record) -> tuple[dict, dict]:
    """All that may not differ between two runs."""
    data = {key: value for key, value in record.data.items() if key not in ("timing", "provenance")}
    data["skipped"] = {name: skip["count"] for name, skip in data["skipped"].items()}
    return data, {group: {k: v.tolist() for k, v in arrays.items()} for group, arrays in record.arrays.items()}


def test_the_same_seed_gives_the_same_numbers_and_another_seed_does_not(run, record, no_pictures):
    for seed, same in ((0, True), (1, False)):
        out = run / f"seed{seed}"
        assert main(["probe", str(run / "double.pt"), "--out", str(out), "--seed", str(seed), *UNLIMITED]) == 0
        assert (numbers(read_record(out)) == numbers(record)) == same


def test_the_table_shows_every_attribute_and_the_files_to_open(run, capsys, no_pictures, monkeypatch):
    monkeypatch.setenv("COLUMNS", "140")
    assert main(["probe", str(run / "checkpoint.pt"), "--quick"]) == 0
    said = capsys.readouterr()
    data = read_record(run / "probe").data
    assert data["provenance"]["dtype"] == "float32" and data["slice"]["points"] == 41 * 41
    assert set(data["eigenvalues"]) == {"max", "second", "min"} and "power iteration" not in said.out
    # what it left out is said, in the record and aloud
    assert any("surface was left out" in note for note in data["notes"]) and "surface was left out" in " ".join(
        said.out.split()
    )
    assert data["finite_probe"] is None and "the finite probe was left out" in data["notes"]
    assert data["depth"] is None and "positions along and across the rays were left out" in data["notes"]
    assert data["anisotropy"]["share"]["value"] is None and "density" not in data["timing"]
    assert "the spectral density was left out, and the indices that need it" in data["notes"]
    skips = data["skipped"]
    assert skips["entries_behind_opaque_fronts"]["seconds_saved"] is None
    assert skips["gaussians_out_of_sight"]["count"] == data["counts"]["skipped_gaussians"]
    for label in ("position", "log scale", "rotation", "opacity", "colour (SH)"):
        assert f"trace of {label}" in said.out
    for label in ("largest eigenvalue", "smallest eigenvalue", "literal", "saddle", "check: symmetry"):
        assert label in said.out
    assert str(run / "probe" / "report.html") in said.out and "probe.json" in said.out
    for stage in ("traces", "eigenvalues", "slice"):
        assert stage in said.err


def test_a_quick_probe_leaves_the_same_pictures_out_whoever_starts_their_drawing(run, tmp_path, monkeypatch):
    begun, drawn = [], []
    monkeypatch.setattr("analysis.drawing.drawing", lambda *told: begun.append(told) or nullcontext(lambda target: []))
    assert main(["probe", str(run / "checkpoint.pt"), "--quick", "--out", str(tmp_path / "command")]) == 0
    monkeypatch.setattr("analysis.recording.draw", lambda module, target, *told: drawn.append((module, *told)) or [])
    assert run_probe(ProbeOptions(run / "checkpoint.pt", quick=True, out=tmp_path / "function")) == 0
    assert begun == drawn == [("make_all", "--without", "surface")]


def test_a_budget_that_ends_is_said_and_what_was_reached_is_recorded(run, tmp_path, capsys, no_pictures):
    out = tmp_path / "short"
    assert main(["probe", str(run / "checkpoint.pt"), "--out", str(out), "--seconds", "1e-6"]) == 0
    data = read_record(out).data
    assert data["eigenvalues"]["max"]["reason"] == "time budget"
    assert data["slice"]["points"] == 41 * 41 > 30 * data["slice"]["evaluated_points"]
    assert any("the slice's interpolation stopped" in note for note in data["notes"])
    assert data["anisotropy"]["share"]["value"] is None
    assert any("density was left out" in note for note in data["notes"])
    assert data["depth"]["rises"] == [] and any("steps along the rays were left out" in note for note in data["notes"])
    assert "density was left out" in " ".join(capsys.readouterr().out.split())


def test_a_failed_check_is_an_error_only_when_strict_and_is_recorded(run, tmp_path, no_pictures, monkeypatch, capsys):
    monkeypatch.setattr("splat.curvature.SceneHessian.apply", skewed(run))
    quick = ["probe", str(run / "checkpoint.pt"), "--quick", "--out"]
    assert main([*quick, str(tmp_path / "lenient")]) == 0
    assert main([*quick, str(tmp_path / "strict"), "--strict"]) == 1
    for name in ("lenient", "strict"):
        checks = read_record(tmp_path / name).data["checks"]
        assert checks["symmetry"]["passed"] is False and checks["finite_difference"]["passed"] is False
    assert "The check of symmetry failed" in " ".join(capsys.readouterr().out.split())


def test_a_seed_below_zero_is_refused_as_that_of_a_training_is(run, tmp_path, capsys):
    refused(capsys, [str(run / "double.pt"), "--out", str(tmp_path / "out"), "--seed=-1"], "seed in [0, 2^63), got -1")
    assert not (tmp_path / "out").exists()


def skewed(run):
    """SceneHessian.apply with a hundredth of the result moved to the next row."""
    from splat.curvature import SceneHessian

    original = SceneHessian.apply

    def apply(self, V):
        product = original(self, V)
        return product + 0.01 * product.roll(1, dims=0)

    return apply


def refused(capsys, arguments: list[str], *expected: str) -> None:
    assert main(["probe", *arguments]) == 2
    said = capsys.readouterr()
    assert said.err.startswith("landscape: ") and "Traceback" not in said.err and said.out == ""
    message = said.err.strip()
    assert message.count("\n") == 0, message
    for part in expected:
        assert part in message, message


def test_bad_input_gets_one_sentence_and_leaves_nothing(run, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(run.parent / "still", tmp_path / "scene")
    copy.mkdir()
    path = copy / "checkpoint.pt"
    refused(capsys, [str(path)], "expected a checkpoint", "found no such file")
    refused(capsys, [str(copy)], "expected a checkpoint", f"found a folder; name the {path} in it")
    path.write_bytes(b"not a checkpoint")
    refused(capsys, [str(path)], "not one or is damaged")
    shutil.copy(run / "checkpoint.pt", path)
    refused(capsys, [str(path), "--scene", str(tmp_path / "nowhere")], "does not exist")
    write_transforms_scene(synthetic_scene(replace(SCENE, views=2)).scene, tmp_path / "other")
    refused(
        capsys, [str(path), "--scene", str(tmp_path / "other")], f"the training's scene still in {tmp_path / 'other'}"
    )
    refused(capsys, [str(path), "--slice-points", "4"], "odd number")
    refused(capsys, [str(path), "--seconds", "0"], "seconds")
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
    assert read_record(tmp_path / "probe").data["provenance"]["scene_folder"] == str(away)


def test_a_probe_that_is_killed_leaves_the_old_record_whole(run, record, tmp_path):
    out = tmp_path / "kept"
    shutil.copytree(record.folder, out)
    before = (out / "probe.json").read_bytes()
    command = ["probe", str(run / "checkpoint.pt"), "--out", str(out), "--quick"]
    process = subprocess.Popen([sys.executable, "-m", "analysis.cli", *command], cwd=ROOT, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 100
    while not list(tmp_path.glob(".kept.partial-*/probe.json")):  # it is writing the new one
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.002)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert (out / "probe.json").read_bytes() == before and read_record(out).data["provenance"]["dtype"] == "float64"


def test_an_interrupted_probe_writes_nothing(run, tmp_path, monkeypatch):
    def interrupt(target):
        raise KeyboardInterrupt

    monkeypatch.setattr("analysis.drawing.drawing", lambda *_: nullcontext(interrupt))
    assert main(["probe", str(run / "checkpoint.pt"), "--out", str(tmp_path / "probe"), "--quick"]) == 130
    assert list(tmp_path.iterdir()) == []


def test_numbers_are_kept_where_the_pictures_fail(run, tmp_path, monkeypatch):
    def fail(target):
        raise RuntimeError("drawing failed: no fonts")

    monkeypatch.setattr("analysis.drawing.drawing", lambda *_: nullcontext(fail))
    assert main(["probe", str(run / "checkpoint.pt"), "--out", str(tmp_path / "probe"), "--quick"]) == 0
    assert "drawing failed: no fonts" in read_record(tmp_path / "probe").data["notes"]
    assert "Drawing failed: no fonts." in (tmp_path / "probe" / "report.html").read_text()


def test_settings_out_of_range_are_refused():
    for wrong in ({"slice_points": 3}, {"slice_points": 6}, {"slice_rise": 0.0}, {"seconds": 0.0}, {"memory": -1.0}):
        with pytest.raises(ValueError, match="expected"):
            replace(ProbeSettings(), **wrong)


def test_the_record_is_strict_json(record):
    json.loads((record.folder / "probe.json").read_text(), parse_constant=lambda name: pytest.fail(name))
