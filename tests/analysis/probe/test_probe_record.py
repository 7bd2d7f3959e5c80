"""The record of a probe, its table, and what they say of budgets and of failed checks."""

import json
import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from analysis.commands.cli import main
from analysis.measures.localization import masses
from analysis.probe.command import run_probe
from analysis.probe.measurement import STREAMS
from analysis.probe.options import ProbeOptions
from analysis.probe.settings import ProbeSettings
from analysis.records.findings import findings
from analysis.records.json_files import plain
from analysis.records.page.summary import summary
from analysis.records.quantities import extent
from analysis.records.records import ProbeRecord, Record, read_record
from analysis.records.schema import INDICES
from analysis.records.tables import number_rows
from splat.curvature.hessian import SceneHessian
from splat.losses.reference import LossSettings
from splat.training.checkpoint import load_checkpoint, save_checkpoint
from tests.analysis.probe.probed import unlimited


def test_the_record_has_counts_checks_stages_and_provenance(record, dense, run):
    objective, H, value, gradient = dense
    data = record.data
    assert list(dict(data.eigenvalues.items())) == ["max", "second", "min", "power_max", "power_min"]
    assert tuple(dict(data.anisotropy.items())) == INDICES
    counts, loaded = data.counts, load_checkpoint(run / "double.pt")
    assert counts.gaussians == len(loaded.training.gaussians) and counts.views == 3
    assert counts.visible_gaussians == len(objective.active)
    assert counts.active_parameters == len(H) - len(objective.active) and counts.rank <= len(H)
    assert all(check.passed for check in data.checks.values())
    assert set(data.checks) == {"symmetry", "round_off", "finiteness", "finite_difference"}
    assert data.objective.value == pytest.approx(value, rel=1e-12)
    assert data.objective.gradient_norm == pytest.approx(float(gradient.norm()), rel=1e-9)
    measured_on = [name for name in STREAMS if name not in ("", "renders")]
    stages = ["load", "linearise", "checks", *measured_on, "pictures"]
    stages.insert(stages.index("slice"), "renders")  # its stream is the last, so that the others' numbers stay
    assert list(data.timing) == [*stages, "total"]
    assert sum(data.timing[stage] for stage in stages) <= data.timing["total"]
    provenance = data.provenance
    assert (provenance.seed, provenance.iteration, provenance.dtype) == (0, 30, "float64")
    assert provenance.scene_folder == str(run.parent / "still") and provenance.command.startswith("landscape probe")
    assert record.arrays["spectrum"]["ritz_values"][-1] == pytest.approx(data.eigenvalues.max.value, rel=1e-9)
    files = ["slice2d.png", "spectrum.png", "surface.png", "traces.png", "report.html", "probe.json"]
    assert all((record.folder / file).stat().st_size > 5000 for file in files)


def test_a_checkpoint_can_be_probed_with_the_loss_of_3dgs(run, tmp_path, no_pictures):
    loaded = load_checkpoint(run / "double.pt")
    other = replace(loaded.training, config=replace(loaded.training.config, loss=LossSettings("l2", literal=True)))
    for name, training, options in (("plain", loaded.training, []), ("other", other, ["--loss", "3dgs"])):
        save_checkpoint(run / f"{name}.pt", training, loaded.scene)
        words = ["probe", str(run / f"{name}.pt"), "--quick", "--out", str(tmp_path / name)]
        assert main([*words, *options]) == 0
    plain, probed = (read_record(tmp_path / name, ProbeRecord).data for name in ("plain", "other"))
    assert probed.objective == plain.objective and probed.traces == plain.traces


def test_the_record_is_strict_json(record):
    json.loads((record.folder / "probe.json").read_text(), parse_constant=lambda name: pytest.fail(name))


def numbers(record: Record) -> tuple[dict, dict]:
    """All that may not differ between two runs."""
    data = {key: value for key, value in plain(record.data).items() if key not in ("timing", "provenance")}
    return data, {group: {k: v.tolist() for k, v in arrays.items()} for group, arrays in record.arrays.items()}


def test_the_same_seed_gives_the_same_numbers_and_another_seed_does_not(run, record, no_pictures):
    for seed, same in ((0, True), (1, False)):
        again = unlimited(run / "double.pt", run / f"seed{seed}", "--seed", str(seed))
        assert (numbers(again) == numbers(record)) == same


def test_a_quick_probe_says_what_it_left_out_and_the_files_to_open(run, capsys, no_pictures, monkeypatch):
    monkeypatch.setenv("COLUMNS", "140")
    assert main(["probe", str(run), "--quick"]) == 0
    said = capsys.readouterr()
    data = read_record(run / "probe-quick").data
    assert data.provenance.dtype == "float32" and data.slice.points == 21 * 21
    assert set(dict(data.eigenvalues.items())) == {"max", "second", "min"} and "power iteration" not in said.out
    # what it left out is said, in the record and in the report
    words = f"no surface is drawn; landscape slice {run} renders more"
    assert any(words in line.text for line in findings(data))
    assert data.depth is None and "positions along and across the rays were left out" in data.notes
    assert data.anisotropy.top_mass.value is None and "density" not in data.timing
    assert "the spectral density was left out, and the indices that need it" in data.notes
    rows = {name for rows in number_rows(data).values() for name, *_ in rows}
    for label in ("position", "log scale", "rotation", "opacity", "colour (SH)"):
        assert f"trace of {label}" in rows
    assert rows >= {"largest eigenvalue", "smallest eigenvalue", "eigenvalue ratio", "negative ratio", "symmetry"}
    assert "participation ratio" not in rows and "participation ratio" not in said.out
    assert str(run / "probe-quick" / "report.html") in said.out
    for stage in ("traces", "eigenvalues", "slice"):
        assert stage in said.err


def test_a_quick_probe_leaves_out_the_same_pictures_however_it_is_started(run, tmp_path, monkeypatch):
    begun, drawn = [], []
    monkeypatch.setattr("analysis.console.drawing.drawing", lambda *of: begun.append(of) or nullcontext(lambda _: []))
    assert main(["probe", str(run / "checkpoint.pt"), "--quick", "--out", str(tmp_path / "command")]) == 0
    monkeypatch.setattr("analysis.console.recording.draw", lambda module, _, *told: drawn.append((module, *told)) or [])
    assert run_probe(ProbeOptions(run / "checkpoint.pt", quick=True, out=tmp_path / "function")) == 0
    assert begun == drawn == [("make_all",)]


def test_the_summary_says_of_both_ends_what_renders_say_and_who_carries_them(record, dense):
    data = record.data
    lines = dict(line.split(maxsplit=1) for line in summary(data, Path("run/probe/report.html")))
    assert "all 4 passed" in lines["checks"] and ">" not in str(lines)
    assert re.match(r"half of all curvature lies in \S+( to \S+)? of [\d,]+ directions", lines["spread"])
    spread = data.anisotropy.participation_ratio
    assert lines["spread"].endswith(f"participation ratio {extent((spread.low, spread.high))} (one training)")
    for name, end in (("steepest", data.eigenvalues.max), ("negative", data.eigenvalues.min)):
        steps, least = end.renders.steps, end.renders.optimiser_step
        assert steps == pytest.approx([steps[0] * 2**k for k in range(len(steps))]) and steps[5] == least
        vector = torch.from_numpy(record.arrays["eigenvectors"]["largest" if name == "steepest" else "smallest"][:, 0])
        mass = int(masses(vector, dense[0].active).argmax())
        assert end.carrier.gaussian == int(dense[0].mask.nonzero()[mass, 0])
        assert " of " in end.carrier.shape
        told = {True: "renders agree within a factor of 2 at ", False: "not confirmed by renders", None: "not resolved"}
        assert told[end.renders.confirmed] in lines[name] and "one training" in lines[name]


def skewed():
    """SceneHessian.apply with a hundredth of the result moved to the next row."""
    original = SceneHessian.apply

    def apply(self, V):
        product = original(self, V)
        return product + 0.01 * product.roll(1, dims=0)

    return apply


def test_a_failed_check_is_an_error_only_when_strict_and_is_recorded(run, tmp_path, no_pictures, monkeypatch, capsys):
    monkeypatch.setattr(SceneHessian, "apply", skewed())
    quick = ["probe", str(run / "checkpoint.pt"), "--quick", "--out"]
    assert main([*quick, str(tmp_path / "lenient")]) == 0
    assert main([*quick, str(tmp_path / "strict"), "--strict"]) == 1
    for name in ("lenient", "strict"):
        checks = read_record(tmp_path / name).data.checks
        assert checks["symmetry"].passed is False
        assert checks["finite_difference"].passed is True  # that is of single views
    said = " ".join(capsys.readouterr().out.split())
    assert "The check of symmetry failed" in said and "not symmetry (" in said and "steepest" not in said


def test_settings_out_of_range_are_refused():
    for key, value in (("slice_points", 3), ("slice_points", 6), ("density_matvecs", 5), ("memory", -1.0)):
        wrong: dict = {key: value}
        with pytest.raises(ValueError, match="expected"):
            replace(ProbeSettings(), **wrong)
