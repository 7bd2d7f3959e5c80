"""Slicing a checkpoint: losses that are renders, directions that are what they are called, interruptions, refusals."""

import math
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from msgspec import convert

from analysis.commands.cli import main
from analysis.records.json_files import plain
from analysis.records.records import Record, read_record
from analysis.records.schema import FiniteProbe
from analysis.slice.command import _finite_curvature
from figures.make_all import recorded_figures
from figures.plane import plane
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.model.gaussians import Gaussians
from splat.scenes.synthetic import synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint, open_subject
from splat.training.origin.fingerprint import Fingerprint
from tests.analysis.probe.probed import SCENE, save_double
from tests.recorded import soft, synthetic, synthetic_line, written

ROOT = Path(__file__).parents[3]
POINTS = ["--points", "9", "--all-points"]
EPS = np.finfo(np.float64).eps


def behind(gaussians: Gaussians) -> Gaussians:
    """One Gaussian out of every view's sight."""
    gaussians.means[0] += 1e4
    return gaussians


def turned(gaussians: Gaussians) -> Gaussians:
    """Other parameters with a quaternion of the other sign and another length."""
    gaussians.flat.add_(0.01 * torch.randn(gaussians.flat.shape, generator=torch.Generator().manual_seed(5)))
    gaussians.quats[3] *= -2.5
    return gaussians


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("slice")
    write_transforms_scene(synthetic_scene(SCENE).scene, folder / "still")
    train = ["train", str(folder / "still"), "--out", str(folder / "run"), "--iterations", "30", "--sh-degree", "1"]
    assert main([*train, "--no-densify"]) == 0
    out = folder / "run"
    save_double(out / "checkpoint.pt", out / "double.pt")
    save_double(out / "checkpoint.pt", out / "behind.pt", behind)
    save_double(out / "checkpoint.pt", out / "turned.pt", turned)
    save_double(out / "checkpoint.pt", out / "few.pt", lambda gaussians: gaussians.select(torch.arange(9)))
    return out


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch):
    """For tests of the numbers alone."""
    monkeypatch.setattr("analysis.console.recording.draw", lambda module, target: [])


@pytest.fixture(scope="module")
def objective(run) -> SceneObjective:
    return objective_of(run / "double.pt")


def objective_of(path: Path) -> SceneObjective:
    return open_subject(path).objective()


def sliced(out: Path, checkpoint: Path, *options: str) -> Record:
    assert main(["slice", str(checkpoint), "--out", str(out), *options]) == 0
    assert [path.name for path in out.parent.glob(".*")] == []
    return read_record(out)


def check_renders(record: Record, objective: SceneObjective) -> None:
    """Every evaluated point of a float64 slice is the loss there, and the model is the second-order one."""
    arrays, vectors = record.arrays["slice"], torch.from_numpy(record.arrays["directions"]["vectors"])
    axes = [torch.from_numpy(arrays[name]) for name in "xy" if name in arrays]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, len(axes))
    at = points @ vectors.T + objective.active.flat
    known = np.flatnonzero(arrays["evaluated"].ravel())
    truth = [objective.loss(at[i]) for i in known]
    assert arrays["loss"].ravel()[known].tolist() == pytest.approx(truth, rel=1e-12)
    span = SceneHessian(objective, keep_null=True).apply(vectors).T @ vectors
    slope = vectors.T @ objective.gradient
    model = objective.loss(objective.active.flat) + points @ slope + ((points @ span) * points).sum(1) / 2
    assert arrays["model"].ravel().tolist() == pytest.approx(model.tolist(), rel=1e-9)
    for direction, curvature, first in zip(record.data.slice.directions, span.diagonal(), slope, strict=True):
        assert direction.curvature == pytest.approx(float(curvature), rel=1e-9)
        assert direction.slope == pytest.approx(float(first), rel=1e-9, abs=1e-15)


@pytest.fixture(scope="module")
def eigen(run, tmp_path_factory) -> Record:
    """Along the eigenvectors, computed: no probe lies beside the checkpoint."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("analysis.console.recording.draw", lambda module, target: [])
        return sliced(tmp_path_factory.mktemp("eigen") / "slice", run / "double.pt", *POINTS)


def test_the_default_is_the_plane_of_the_two_largest_eigenvalues(eigen, objective):
    check_renders(eigen, objective)
    H = SceneHessian(objective).apply(torch.eye(objective.active.flat.numel(), dtype=torch.float64))
    true = torch.linalg.eigvalsh((H + H.T) / 2)
    first, second = eigen.data.slice.directions
    assert abs(first.curvature - float(true[-1])) <= first.residual <= 1e-3 * first.curvature
    assert abs(second.curvature - float(true[-2])) <= second.residual <= 1e-3 * second.curvature
    x = eigen.arrays["slice"]["x"]
    assert (x[0], x[4], x[-1]) == pytest.approx((-3 * first.unit, 0.0, 3 * first.unit), rel=4 * EPS, abs=0.0)
    assert first.unit == pytest.approx(math.sqrt(2e-3 * eigen.data.slice.center_loss / first.curvature))
    assert eigen.data.counts.renders == 3 * (81 + 1) and eigen.data.finite_probe is None


def probed(folder: Path, made: Fingerprint, vectors: np.ndarray) -> None:
    """The record of a probe with these eigenvectors."""
    data, _ = synthetic()
    data["provenance"] |= {"fingerprint": plain(made)}
    written(folder / "probe", data, {"eigenvectors": {"largest": vectors}})


def test_the_probes_eigenvectors_are_taken_where_they_are_the_checkpoints(run, eigen, tmp_path):
    path, scene = tmp_path / "run" / "double.pt", ["--scene", str(run.parent / "still")]
    path.parent.mkdir()
    shutil.copy(run / "double.pt", path)
    vectors, made = eigen.arrays["directions"]["vectors"], eigen.data.provenance.fingerprint
    probed(path.parent, made, -vectors)  # told apart from those that Lanczos finds
    taken = sliced(tmp_path / "taken", path, *scene, *POINTS)
    assert np.array_equal(taken.arrays["directions"]["vectors"], -vectors)
    assert taken.data.counts.products == 6  # of two vectors: to confirm them, for their curvatures, for the model
    turned = vectors @ np.array([[0.8, -0.6], [0.6, 0.8]])
    swapped = np.ascontiguousarray(vectors[:, ::-1])  # true eigenvectors, but the first is not the steepest
    other, notes = replace(made, state="another"), [f"eigenvectors were not taken from {path.parent / 'probe'}: "]
    notes[0] += "it is a probe of another checkpoint; probe again"
    for number, recorded in enumerate((vectors, turned, vectors[:-1], swapped)):
        probed(path.parent, made if number else other, recorded)
        computed = sliced(tmp_path / str(number), path, *scene, *POINTS)
        assert computed.data.notes == ([] if number else notes)
        assert computed.data.counts.products > 6
        for found, exact in zip(computed.data.slice.directions, eigen.data.slice.directions, strict=True):
            assert abs(found.curvature - exact.curvature) <= found.residual + exact.residual


def test_a_probe_that_cannot_be_read_is_named_and_damaged_directions_are_found_again(run, tmp_path, capsys):
    path, out = tmp_path / "run" / "double.pt", tmp_path / "run" / "slice-eigenvectors-1d"
    (path.parent / "probe").mkdir(parents=True)
    shutil.copy(run / "double.pt", path)
    (path.parent / "probe" / "probe.json").write_text("{")
    unfinished = out.with_name(f".{out.name}.unfinished")
    unfinished.mkdir(parents=True)
    (unfinished / "directions.msgpack").write_bytes(b"PK\x03\x04")
    record = sliced(out, path, "--scene", str(run.parent / "still"), "--dimension", "1", *POINTS)
    (note,) = record.data.notes
    assert "probe.json" in note and "damaged" in note and note in " ".join(capsys.readouterr().out.split())


def test_random_directions_are_as_long_as_each_attribute_of_each_gaussian(run, objective, tmp_path):
    record = sliced(tmp_path / "slice", run / "double.pt", "--along", "random", "--radius", "2e-3", *POINTS)
    check_renders(record, objective)
    active, vectors = objective.active, torch.from_numpy(record.arrays["directions"]["vectors"])
    for column in vectors.T:
        for name, rows in active.blocks.items():
            lengths = column[rows].view(len(active), -1).norm(dim=1)
            assert torch.allclose(lengths, active.flat[rows].view(len(active), -1).norm(dim=1), rtol=1e-12), name
    assert record.arrays["slice"]["y"][-1] == 2e-3
    again = sliced(tmp_path / "again", run / "double.pt", "--along", "random", *POINTS)
    assert again.arrays["slice"]["y"][-1] == 1e-3
    other = sliced(tmp_path / "other", run / "double.pt", "--along", "random", *POINTS, "--seed", "1")
    assert np.array_equal(again.arrays["directions"]["vectors"], vectors)
    assert not np.allclose(other.arrays["directions"]["vectors"], vectors)


def test_along_the_gradient_slope_and_finite_steps_are_those_of_renders(run, objective, tmp_path):
    record = sliced(tmp_path / "slice", run / "double.pt", "--along", "gradient", "--points", "21")
    check_renders(record, objective)
    (direction,) = record.data.slice.directions
    assert direction.slope == pytest.approx(float(objective.gradient.norm()), rel=1e-9)
    probe, v = record.data.finite_probe, torch.from_numpy(record.arrays["directions"]["vectors"][:, 0])
    assert float(v.norm()) == pytest.approx(1)
    assert probe.infinitesimal == pytest.approx(direction.curvature, rel=1e-12)
    assert probe.steps[-1] == pytest.approx(record.arrays["slice"]["x"][-1]) == 1e4 * probe.steps[0]
    center = objective.active.flat
    for step, value, bound in zip(probe.steps, probe.curvatures, probe.round_off, strict=True):
        ends = objective.loss(center + step * v), objective.loss(center - step * v)
        assert abs((sum(ends) - 2 * objective.loss(center)) / step**2 - value) <= bound
    assert record.data.counts.renders == 3 * (record.data.slice.evaluations + probe.evaluations)


def test_finite_steps_are_said_as_a_range_without_those_that_are_hidden():
    probe = synthetic_line()[0]["finite_probe"]
    said = soft(_finite_curvature(convert(probe, FiniteProbe)))
    assert "from 41.0 to 70.0, at the 3 of 4 steps that round-off does not hide (±1.00 × 10⁻⁵ to ±0.00100)" in said
    assert said.endswith(", 2 of them with another order of splats")
    hidden = probe | {"curvatures": [None] * 4, "round_off": [None] * 4, "crossed": None}
    said = _finite_curvature(convert(hidden, FiniteProbe))
    assert said == "at finite steps: round-off hides the curvature at all 4 steps"


def test_a_line_leads_to_the_other_checkpoint_with_all_gaussians(run, tmp_path):
    gaussians = load_checkpoint(run / "double.pt").training.gaussians
    for start, end in (("behind", "double"), ("double", "turned")):
        record = sliced(tmp_path / start, run / f"{start}.pt", str(run / f"{end}.pt"), "--points", "9", "--all-points")
        x, loss = record.arrays["slice"]["x"], record.arrays["slice"]["loss"]
        assert x.tolist() == [-0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5]
        for at, name in ((0.0, start), (1.0, end)):
            objective = objective_of(run / f"{name}.pt")
            truth = objective.loss(objective.active.flat)
            assert float(loss[x == at][0]) == pytest.approx(truth, rel=1e-12)
        assert record.arrays["directions"]["vectors"].shape == (len(gaussians.flat), 1)
    way = gaussians.with_flat(torch.from_numpy(record.arrays["directions"]["vectors"][:, 0])).quats
    assert way.norm(dim=1).max() <= math.sqrt(2)  # unit quaternions that turn the same way, the shorter one


def test_an_adaptive_slice_says_what_it_rendered(run, objective, tmp_path, capsys):
    record = sliced(tmp_path / "slice", run / "double.pt", "--points", "21", "--tolerance", "0.3")
    check_renders(record, objective)
    about = record.data.slice
    assert about.resolved and about.reason == "tolerance" and about.points == 21 * 21
    said = capsys.readouterr()
    words = " ".join(said.out.split())
    assert f"Of the slice's 441 points {about.evaluated_points} are renders" in words
    assert np.isfinite(record.arrays["slice"]["loss"]).all()
    assert str(tmp_path / "slice") in said.out and "slice.json" in said.out


def test_an_interrupted_slice_keeps_the_old_record_says_how_to_go_on_and_can(run, eigen, tmp_path, monkeypatch, capsys):
    out = shutil.copytree(eigen.folder, tmp_path / "slice")
    before, evaluate, calls = (out / "slice.json").read_bytes(), SceneObjective.evaluate, []

    def interrupted(self, flat):
        calls.append(flat)
        if len(calls) == 61:
            raise KeyboardInterrupt
        return evaluate(self, flat)

    monkeypatch.setattr("landscape.slices.grid_evaluations.SAVE_EVERY", 0.0)
    monkeypatch.setattr(SceneObjective, "evaluate", interrupted)
    options = ["--points", "11", "--all-points"]
    words = ["slice", str(run / "double.pt"), "--out", str(out), *options]
    assert main(words) == 130
    said = " ".join(capsys.readouterr().err.split())
    assert f"what was rendered is kept; to continue: landscape {shlex.join(words)}" in said
    assert (out / "slice.json").read_bytes() == before
    made = len(calls)  # other threads may have gone on until they were told
    record = sliced(out, run / "double.pt", *options)
    # of the 60 evaluations before it was stopped, a few were of the centre; the rest of the 121 are made now
    assert len(calls) - made <= 121 - 60 + 2 * 5
    whole = sliced(tmp_path / "whole", run / "double.pt", *options)
    for group, arrays in whole.arrays.items():
        for name, array in arrays.items():
            assert np.array_equal(array, record.arrays[group][name]), name
    assert record.data.counts.products == 4 < whole.data.counts.products  # its eigenvectors were kept too


def test_numbers_are_kept_where_the_pictures_fail(run, tmp_path, monkeypatch):
    monkeypatch.setattr("analysis.console.recording.draw", lambda module, target: ["drawing failed: no fonts"])
    record = sliced(tmp_path / "slice", run / "double.pt", "--along", "gradient", *POINTS)
    assert "drawing failed: no fonts" in record.data.notes


def test_the_pictures_are_those_of_a_plane_or_of_a_line(run, eigen, tmp_path, monkeypatch):
    from analysis.console.drawing import draw

    monkeypatch.setattr("analysis.console.recording.draw", draw)
    sliced(tmp_path / "line", run / "double.pt", "--along", "gradient", *POINTS)
    assert [path.name for path in (tmp_path / "line").glob("*.png")] == ["slice1d.png"]
    assert recorded_figures(eigen) == ("slice2d", "surface")


def test_a_plane_leads_through_three_checkpoints(run, tmp_path):
    names = ("behind", "double", "turned")
    record = sliced(tmp_path / "plane", *(str(run / f"{name}.pt") for name in names), "--points", "9", "--all-points")  # pyright: ignore[reportArgumentType]
    arrays, places = record.arrays["slice"], ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
    for name, (x, y) in zip(names, places, strict=True):
        objective = objective_of(run / f"{name}.pt")
        truth = objective.loss(objective.active.flat)
        assert float(arrays["loss"][arrays["x"] == x][:, arrays["y"] == y][0, 0]) == pytest.approx(truth, rel=1e-12)
    assert [direction.name for direction in record.data.slice.directions] == ["line₁", "line₂"]
    assert plane(record).others == [(1.0, 0.0), (0.0, 1.0)]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--points", "4"], ["odd number"]),
        (["--radius", "0"], ["radii", "above 0"]),
        (["--radius", "1", "--radius", "1", "--radius", "1"], ["at most 2 radii"]),
        (["--tolerance", "2"], ["tolerance between 0 and 1"]),
        (["--along", "line"], ["no other checkpoint", "name it"]),
        (["--along", "gradient", "--dimension", "2"], ["one dimension of gradient", "eigenvectors and random"]),
        (["--seed", "-1"], ["seed in [0, 2^63), got -1"]),
        (["--along", "random", "--radius", "100"], ["too long"]),
        (["OTHER", "--along", "gradient"], ["one more checkpoint", "leave out --along"]),
        (["OTHER", "BEHIND", "BEHIND"], ["at most three checkpoints"]),
        (["OTHER", "BEHIND", "--dimension", "1"], ["two checkpoints for a line, got three"]),
        (["OTHER", "OTHER"], ["directions that are not parallel"]),
        (["FEW"], ["15 Gaussians with SH degree", "got 9", "after densification"]),
        (["SAME"], ["differ"]),
        (["NOWHERE"], ["nowhere.pt", "no such file"]),
    ],
)
def test_bad_input_gets_one_sentence_and_leaves_no_record(run, tmp_path, capsys, options, words):
    named = {"BEHIND": "behind", "OTHER": "turned", "SAME": "double", "FEW": "few"}
    named = {key: str(run / f"{name}.pt") for key, name in named.items()} | {"NOWHERE": str(tmp_path / "nowhere.pt")}
    out = tmp_path / "out" / "slice"
    arguments = [str(run / "double.pt"), *(named.get(option, option) for option in options), "--out", str(out)]
    assert main(["slice", *arguments]) == 2
    said = capsys.readouterr()
    message = said.err.strip().splitlines()[-1]
    assert message.startswith("landscape: ") and "Traceback" not in said.err and said.out == ""
    for part in words:
        assert part in message, message
    kept = [] if "100" not in options else [".slice.unfinished"]  # no error deletes what was rendered
    assert [path.name for path in out.parent.glob("*")] == kept


def test_a_folder_of_something_else_is_not_replaced(run, tmp_path, capsys):
    (tmp_path / "thesis.txt").write_text("years of work")
    assert main(["slice", str(run / "double.pt"), "--out", str(tmp_path)]) == 2
    assert "without slice.json" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
