"""Comparisons: what is refused, what is said, and that the table, the file and the page carry the records' own numbers."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image

from analysis.commands.cli import main
from analysis.probe.command import asked
from analysis.records.json_files import plain
from analysis.records.provenance import provenance_of
from analysis.records.quantities import SCORES, measured, quantity
from analysis.records.schema import Index
from analysis.records.tables import bracketed
from analysis.runs import compared
from figures.compare import draw_comparison
from landscape.errors import InputError
from notebooks.paper.study import row_of
from splat.losses.reference import LossSettings
from splat.model.files.splat_ply import splat_ply
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint, open_subject, save_checkpoint
from splat.training.origin.fingerprint import FORMULAS
from tests.figures.test_trajectory_figure import rows
from tests.recorded import depth_section, long_numbers, own, synthetic, written

ITERATIONS = 4
KEYS = ["value", "low", "high"]
SETTINGS = SyntheticSettings(gaussians=60, views=5, width=16, height=12)
FACTOR = {"value": 2.5, "low": 2.0, "high": 3.1, "note": ""}


def record(folder: Path, scale: float, **changes) -> None:
    """A record in place of a probe, with the split control."""
    data, arrays = synthetic(scale)
    data["provenance"] |= {"iteration": ITERATIONS} | own(folder.parent) | changes
    effect = {"operator": "hessian", "index": "negative_ratio", **FACTOR}
    effects = [effect | {"block": block} for block in ("all", "means")]
    data["split_control"] = {"gaussians": 20182, "rms": 0.01 * scale, "largest": 0.1, "psnr": 40.0 / scale}
    data["split_control"]["effects"] = effects
    end = {"value": 4.0, "residual": 0.1, "reason": "tolerance"}
    about = {"operator": "hessian", "block": "means", "metric": "parameters", "unit": "units of the parameters"}
    index = {"value": 7.0 * scale, "low": 6.0 * scale, "high": 9.0 * scale, "note": ""}
    names = ("eigenvalue_ratio", "negative_ratio", "top_mass", "participation_ratio")
    family = {"gaussians": 10091, "dim": 30273, "rank": 30000, "lambda_max": end, "lambda_min": end}
    share = {name: value / 10 if name != "note" else value for name, value in index.items()}
    family |= {"indices": dict.fromkeys(names, index) | {"top_mass": share}, "split": False}
    data["per_attribute"] = [about | family, about | family | {"split": True, "gaussians": 20000}]
    written(folder, data, arrays)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """Two trainings of the same scene, with records in place of probes."""
    folder = tmp_path_factory.mktemp("compare")
    write_transforms_scene(synthetic_scene(SETTINGS).scene, folder / "still")
    run = ["train", str(folder / "still"), "--iterations", str(ITERATIONS), "--out"]
    assert main([*run, str(folder / "runs/plain/0")]) == 0
    assert main([*run, str(folder / "runs/sam/0"), "--method", "sam"]) == 0
    for name, scale in (("plain", 1.0), ("sam", 0.5)):
        record(folder / "runs" / name / "0/probe", scale)
    return folder / "runs"


@pytest.fixture
def runs(trained, tmp_path) -> list[str]:
    """Copies that a test may break."""
    shutil.copytree(trained.parent, tmp_path / "all")
    return [str(tmp_path / "all/runs" / name / "0") for name in ("plain", "sam")]


@pytest.fixture
def no_pictures(monkeypatch):
    monkeypatch.setattr("analysis.runs.compare.draw", lambda module, target: [])


@pytest.fixture
def probed(monkeypatch) -> list[tuple]:
    """Options and command of every probe that is asked for, each of which leaves a record."""
    asked = []

    def probe(options, command) -> int:
        asked.append((options, command))
        record(options.checkpoint.parent / "probe", 1.0)
        return 0

    monkeypatch.setattr("analysis.runs.compared.run_probe", probe)
    return asked


def changed(run: str, **config) -> None:
    """The run's checkpoint with other settings."""
    path = Path(run) / "checkpoint.pt"
    loaded = load_checkpoint(path)
    loaded.training.config = replace(loaded.training.config, **config)
    save_checkpoint(path, loaded.training, loaded.scene)


def other_units(run: str) -> dict:
    """A family of the run in other units."""
    families = json.loads((Path(run) / "probe/probe.json").read_text())["per_attribute"]
    return families[0] | {"unit": "steps of the optimiser"}


def refused(capsys, words: list[str], *expected: str) -> None:
    assert main(["compare", *words]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    for part in expected:
        assert part in " ".join(captured.err.split())


def test_depth_over_lateral_is_compared_where_a_probe_has_it(runs, tmp_path, no_pictures, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "140")
    assert main(["compare", *runs, "--out", str(tmp_path / "without")]) == 0
    assert "depth / lateral" not in capsys.readouterr().out
    path = Path(runs[0]) / "probe/probe.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"depth": depth_section()}))
    assert main(["compare", *runs, "--out", str(tmp_path / "with")]) == 0
    lines = {line.strip().split("  ")[0]: line for line in capsys.readouterr().out.splitlines() if "depth" in line}
    for name, value in (("gradient", "0.00680"), ("curvature", "3.80"), ("rise at 0.1 px", "0.280")):
        assert value in lines[f"depth / lateral {name}"] and lines[f"depth / lateral {name}"].rstrip().endswith("–")
    table = pd.read_csv(tmp_path / "with/compare.csv").set_index(["section", "quantity", "run"])
    rise = table.loc[("depth over lateral", "rise at 0.1 px", "plain/0")]
    assert [float(rise[key]) for key in KEYS] == pytest.approx([0.28, 0.24, 0.32])
    assert "Depth over lateral" in (tmp_path / "with/compare.html").read_text()


def test_the_file_holds_the_numbers_of_the_records_and_metrics(trained, tmp_path, no_pictures):
    folders = [trained / "plain/0", trained / "sam/0"]
    assert main(["compare", *map(str, folders), "--out", str(tmp_path)]) == 0
    table = pd.read_csv(tmp_path / "compare.csv", dtype={"value": str}).set_index(["section", "quantity", "run"])
    for label, scale in (("plain/0", 1.0), ("sam/0", 0.5)):
        data, _ = synthetic(scale)
        metrics = json.loads((trained / label / "metrics.json").read_text())
        trace, top, ratio = data["traces"]["quats"], data["eigenvalues"]["max"], data["anisotropy"]["negative_ratio"]
        expected = {
            ("trace", "rotation"): [trace[key] for key in KEYS],
            ("spectrum", "largest eigenvalue"): [top["value"] + sign * top["residual"] for sign in (0, -1, 1)],
            ("anisotropy", "negative ratio"): [ratio[key] for key in KEYS],
            ("anisotropy", "negative ratio, split control"): [2.5, 2.0, 3.1],
            ("per_attribute", "Hessian, position: negative ratio"): [7 * scale, 6 * scale, 9 * scale],
            ("per_attribute", "Hessian, position: negative ratio, split control"): [2.5, 2.0, 3.1],
        }
        for key, numbers in expected.items():
            assert table.loc[(*key, label)][KEYS].astype(float).tolist() == pytest.approx(numbers), key
        assert float(table.loc[("held-out views", "PSNR (dB)", label)]["value"]) == metrics["test"]["psnr"]
        assert float(table.loc[("run", "seconds of training", label)]["value"]) == metrics["seconds"]["wall"]


def test_the_page_and_the_terminal_show_every_run_with_errors_and_brackets(trained, tmp_path, capsys, no_pictures):
    assert main(["compare", str(trained / "plain/0"), str(trained / "sam/0"), "--out", str(tmp_path)]) == 0
    said, page = capsys.readouterr().out, (tmp_path / "compare.html").read_text()
    # scores have their own places
    lines = [line for line in said.splitlines() if not any(name in line for name in SCORES.values())]
    assert len(lines) > 20 and long_numbers("\n".join(lines)) == []
    assert "http" not in page.replace("http-equiv", "") and "<script" not in page
    assert "which hardly changes the image" in page
    for scale in (1.0, 0.5):
        data, _ = synthetic(scale)
        trace, ratio = data["traces"]["means"], bracketed(Index(**data["anisotropy"]["negative_ratio"]))
        for text in (measured(trace["value"], trace["standard_error"]), ratio.value, "× 2.5", "2.00 … 3.10"):
            assert text in said and text in page
        assert (
            f"by {quantity(0.01 * scale)} (root mean square; {quantity(40 / scale)} dB), and 182 of the halves" in page
        )
        assert bracketed(Index(value=7 * scale, low=6 * scale, high=9 * scale, note="")).bracket in page


def test_no_ratio_is_compared_whose_end_renders_do_not_confirm(runs, tmp_path, capsys, no_pictures):
    path = Path(runs[0]) / "probe/probe.json"
    data = json.loads(path.read_text())
    rendered = {"steps": [1e-3], "optimiser_step": 1e-3, "ratios": [-1.0], "errors": [0.1], "confirmed": False}
    data["eigenvalues"]["min"]["renders"] = rendered
    path.write_text(json.dumps(data))
    assert main(["compare", *runs, "--out", str(tmp_path)]) == 0
    table = pd.read_csv(tmp_path / "compare.csv").set_index(["section", "quantity", "run"])["value"]
    for name in ("eigenvalue ratio", "negative ratio"):
        found = table.loc[("anisotropy", name)].isna()
        assert found.tolist() == [True, False]
    assert capsys.readouterr().out.count("not confirmed by renders") == 1


def test_seeds_are_compared_by_mean_and_spread(runs, capsys, no_pictures, tmp_path):
    folders = [Path(run).parent for run in runs]
    for folder, scale in zip(folders, (1.0, 0.5), strict=True):
        shutil.copytree(folder / "0", folder / "1")
        shutil.rmtree(folder / "1/probe")
        record(folder / "1/probe", 1.1 * scale)
    assert main(["compare", *map(str, folders), "--out", str(tmp_path / "cells")]) == 0
    said, page = capsys.readouterr().out, (tmp_path / "cells/compare.html").read_text()
    assert "sam and plain differ by more than the spread of their seeds in" in said and "trace of position" in said
    trace = synthetic(1.0)[0]["traces"]["means"]["value"]
    cell = measured(1.05 * trace, 0.1 * trace / 2**0.5)
    assert cell in said and cell in page and "The pictures show the first run of each group" in said
    spread, of_one = "stands the standard deviation over them", "Behind ± stands one standard error"
    assert all(words in page and words in said for words in (spread, "sam (n = 2)")) and of_one not in page
    assert main(["compare", *runs, "--out", str(tmp_path / "runs")]) == 0
    page = (tmp_path / "runs/compare.html").read_text()
    assert of_one in page and spread not in page and "(n = " not in page and "probe's seed 0, on " in page
    table = pd.read_csv(tmp_path / "cells/compare.csv")
    assert set(table["run"]) == {"plain/0", "plain/1", "sam/0", "sam/1"}
    assert json.loads((tmp_path / "cells/compare.json").read_text())["runs"].keys() == {"plain", "sam"}


def test_pictures_are_drawn_from_the_records_and_lie_in_the_page(trained, tmp_path):
    assert main(["compare", str(trained / "plain/0"), str(trained / "sam/0"), "--out", str(tmp_path)]) == 0
    drawn = sorted(path.stem for path in tmp_path.glob("*.png"))
    assert drawn == ["compare_densities", "compare_sections", "compare_slices", "compare_traces"]
    assert (tmp_path / "compare.html").read_text().count("data:image/webp;base64,") == 4


def test_pictures_of_an_earlier_comparison_do_not_stay(runs, tmp_path, no_pictures):
    old = tmp_path / "compare_slices.png"
    Image.new("RGB", (8, 8)).save(old)
    assert main(["compare", *map(str, runs), "--out", str(tmp_path)]) == 0
    assert not old.exists() and "data:image" not in (tmp_path / "compare.html").read_text()


def test_other_functions_are_not_compared(runs, capsys):
    changed(runs[1], background=(1.0, 1.0, 1.0))
    refused(capsys, runs, "expected runs with the same background")
    path = Path(runs[0]) / "checkpoint.pt"
    loaded = load_checkpoint(path)
    small = {name: replace(view, size=(8, 6)) for name, view in loaded.scene.views.items()}
    save_checkpoint(path, loaded.training, replace(loaded.scene, views=small))
    refused(capsys, runs, "expected runs with the same sizes of the views")
    save_checkpoint(path, loaded.training, replace(loaded.scene, train=loaded.scene.train[::-1]))
    refused(capsys, runs, "expected runs with the same training views")
    assert not (Path(runs[0]).parents[1] / "compare").exists()


def test_probes_of_other_losses_are_not_compared(runs, capsys, no_pictures):
    changed(runs[1], loss=LossSettings(literal=True), protocol="llff")
    assert main(["compare", *runs]) == 0  # both records are of one loss
    said = " ".join(capsys.readouterr().out.split())
    assert "The losses of the trainings are not the same." in said and "The protocol is not the same." in said
    assert said.index("The protocol is not") < said.index("trace of position")  # before the table
    path = Path(runs[1]) / "probe/probe.json"
    data = json.loads(path.read_text())
    path.write_text(json.dumps(data | {"objective": data["objective"] | {"loss": "L1 + 0.2 (1 − SSIM)"}}))
    refused(capsys, runs, "expected runs with the same loss", "L1 + 0.2 (1 − SSIM) in sam/0", "--loss 3dgs")


def test_runs_trained_with_other_losses_are_probed_with_that_of_3dgs(runs, capsys, probed, no_pictures):
    changed(runs[1], loss=LossSettings(literal=True))
    for run in runs:
        shutil.rmtree(Path(run) / "probe")
    refused(capsys, runs, "; ".join(f"landscape probe {run}/checkpoint.pt --loss 3dgs" for run in runs))
    assert main(["compare", *runs, "--probe"]) == 0
    assert [(options.loss, command[-1]) for options, command in probed] == [("3dgs", "3dgs")] * 2


def test_trajectories_of_other_functions_are_not_drawn_into_one_picture(runs, capsys, monkeypatch):
    monkeypatch.setattr("analysis.runs.trajectories.draw", lambda module, target: [])
    for run in runs:
        rows().to_csv(Path(run) / "trajectory.csv", index=False)
    assert main(["trajectory", *runs]) == 0
    changed(runs[1], loss=LossSettings("l2"))
    assert main(["trajectory", *runs]) == 2
    assert "expected runs with the same loss" in capsys.readouterr().err


def test_a_run_without_a_record_is_refused_with_the_command_or_probed(runs, capsys, probed, no_pictures):
    for run in runs:
        shutil.rmtree(Path(run) / "probe")
    earlier = own(Path(runs[1]))["fingerprint"] | {"state": "of an earlier step"}
    record(Path(runs[1]) / "probe", 1.0, fingerprint=earlier)
    commands = [f"landscape probe {run}/checkpoint.pt" for run in runs]
    refused(capsys, runs, "expected probed runs", "; ".join(commands), "--probe")
    assert main(["compare", *runs, "--probe"]) == 0 and [" ".join(command) for _, command in probed] == commands
    assert (Path(runs[0]).parents[1] / "compare/compare.csv").exists()


def test_what_has_to_be_kept_in_mind_is_said(runs, capsys, no_pictures):
    assert main(["compare", *runs]) == 0
    assert "not the same" not in capsys.readouterr().out
    data, arrays = synthetic()
    data["provenance"] |= {"iteration": ITERATIONS, "dtype": "float64"} | own(Path(runs[1]))
    data["provenance"]["fingerprint"]["question"] |= {"settings.eigen.rtol": 0.5, "settings.quick": True}
    data["provenance"]["fingerprint"]["formulas"] = FORMULAS + 1
    data["checks"]["symmetry"]["passed"] = False
    written(Path(runs[1]) / "probe", data, arrays)
    (Path(runs[1]) / "metrics.json").unlink()
    changed(runs[1], seed=3)
    assert main(["compare", *runs]) == 0
    said = " ".join(capsys.readouterr().out.split())
    for part in (
        "The seed is not the same",
        "The precision is not the same",
        "The probes were run with different settings (those of plain/0, sam/0): eigen.rtol 0.001, 0.5; quick None, True.",
        f"The probes are of versions {FORMULAS}, {FORMULAS + 1} of the formulas: probe again.",
        "sam/0: The check of symmetry failed",
        "sam/0: It was not scored.",
        "plain/0: The search for the smallest eigenvalue ended at its matvec budget: it may lie farther out. So it is",
        f"landscape probe {runs[1]}/checkpoint.pt --split-control",
    ):
        assert part in said
        page = (Path(runs[0]).parents[1] / "compare/compare.html").read_text()
        assert part in " ".join(page.replace("<code>", "").replace("</code>", "").split())


def test_what_holds_of_many_runs_is_said_once_and_seeds_may_differ(runs, capsys, no_pictures):
    data, arrays = synthetic()
    data["checks"]["symmetry"]["passed"] = False
    data["anisotropy"]["top_mass"] |= {"value": None, "low": None, "high": None}
    for run, seed in zip(runs, (0, 3), strict=True):
        changed(run, seed=seed)
        data["provenance"] |= {"iteration": ITERATIONS} | own(Path(run))
        written(Path(run) / "probe", data, arrays)
    assert main(["compare", *runs]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("The check of symmetry failed") == 1 and "So it is of sam/0." in said
    assert "The seed is not the same" in said and " share " not in said
    shutil.copytree(runs[1], Path(runs[0]).with_name("3"))
    assert main(["compare", str(Path(runs[0]).parent), runs[1]]) == 0
    assert "The seed is not the same" not in capsys.readouterr().out


def test_families_that_only_one_run_has_are_in_no_other_units(runs, capsys, no_pictures):
    words, folder = "The units of --per-attribute are not the same.", Path(runs[1]) / "probe"
    data, arrays = synthetic()
    data["provenance"] |= {"iteration": ITERATIONS} | own(Path(runs[1]))
    for changes, said in (({"per_attribute": []}, False), ({"per_attribute": [other_units(runs[0])]}, True)):
        written(folder, data | changes, arrays)
        assert main(["compare", *runs]) == 0
        assert (words in capsys.readouterr().out) == said


def test_damaged_scores_are_named(runs, capsys):
    path = Path(runs[1]) / "metrics.json"
    path.write_text('{"test":')
    refused(capsys, runs, f"expected the scores of landscape train in {path}, got a damaged file")


def test_files_of_other_tools_are_compared_as_they_were_probed(trained, tmp_path, capsys, monkeypatch, no_pictures):
    scene, files = str(trained.parent / "still"), [tmp_path / "a.ply", tmp_path / "b.ply"]
    for file in files:
        file.write_bytes(splat_ply(synthetic_scene(SETTINGS).truth, tool="splat-landscape"))
    words = [*map(str, files), "--scene", scene, "--views", "3", "--opacity-reg", "0.01"]
    commands = [
        f"landscape probe {file} --out {tmp_path}/probe-{file.stem} --opacity-reg 0.01 --scene {scene} --views 3"
        for file in files
    ]
    refused(capsys, words, "expected probed runs", "; ".join(commands), "--probe")
    commanded = []

    def probe(options, command) -> int:
        commanded.append(" ".join(command))
        subject = open_subject(options.checkpoint, options.foreign)
        data, arrays = synthetic()
        made = provenance_of(asked(options, subject.checkpoint), subject, command)
        data["provenance"] = plain(made)
        written(options.out, data, arrays)
        return 0

    monkeypatch.setattr("analysis.runs.compared.run_probe", probe)
    assert main(["compare", *words, "--probe"]) == 0 and commanded == commands
    assert main(["compare", *words]) == 0  # both are there
    files[0].with_name("probe-a").rename(tmp_path / "probe")  # as of landscape probe without --out
    found = []
    kept = compared.compared
    monkeypatch.setattr("analysis.runs.compare.compared", lambda *a: found.append(kept(*a)) or found[-1])
    assert main(["compare", *map(str, files), str(trained / "plain/0")]) == 0
    assert all(each.scene.train == found[2].scene.train for each in found)
    assert [each.training.config.loss.opacity_reg for each in found] == [0.01, 0.01, 0.0]
    capsys.readouterr()
    refused(capsys, [*words, "--trained-by", "gsplat-raw"], "no record of the checkpoint in", "--trained-by gsplat-raw")
    assert "was not scored" in (tmp_path / "compare/compare.html").read_text()


def replaced(run: str) -> None:
    """The run's checkpoint, by another of the same step."""
    loaded = load_checkpoint(Path(run) / "checkpoint.pt")
    loaded.training.gaussians = loaded.training.gaussians.with_flat(loaded.training.gaussians.flat + 0.01)
    save_checkpoint(Path(run) / "checkpoint.pt", loaded.training, loaded.scene)


def test_records_of_a_checkpoint_that_was_replaced_are_refused_or_measured_anew(runs, capsys, probed, no_pictures):
    replaced(runs[0])
    refused(capsys, runs, f"no record of the checkpoint in {runs[0]}, where {runs[0]}/probe is of another; run land")
    assert main(["compare", *runs, "--probe"]) == 0 and len(probed) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert f"{runs[0]}/probe was of another checkpoint or renderer, and has been measured anew" in said
    assert f"left out: expected in {runs[0]}/metrics.json a record of the checkpoint beside it, got one" in said
    assert "plain/0: It was not scored." in said and main(["compare", *runs]) == 0


def test_another_file_of_the_same_name_and_step_is_not_the_one_that_was_probed(trained, tmp_path, capsys):
    truth = synthetic_scene(SETTINGS).truth
    files, scene = [tmp_path / "a/point_cloud.ply", tmp_path / "b/point_cloud.ply"], str(trained.parent / "still")
    for file, gaussians in zip(files, (truth, truth.with_flat(1.01 * truth.flat)), strict=True):
        file.parent.mkdir()
        file.write_bytes(splat_ply(gaussians, tool="splat-landscape"))
        words = ["probe", str(file), "--scene", scene, *["--views", "3", "--quick", "--slice-points", "5", "--out"]]
        assert main([*words, str(file.parent / "probe")]) == 0
    shutil.copy(files[1], files[0])
    capsys.readouterr()
    refused(capsys, [*map(str, files), "--scene", scene, "--views", "3"], f"where {tmp_path}/a/probe is of another")


def test_views_that_were_changed_between_two_probes_are_said(runs, capsys, no_pictures):
    data, arrays = synthetic()
    data["provenance"] |= {"iteration": ITERATIONS} | own(Path(runs[1]))
    name, view = next(iter(data["provenance"]["fingerprint"]["data"].items()))
    view["lens"] = [1.03 * length for length in view["lens"]]
    written(Path(runs[1]) / "probe", data, arrays)
    assert main(["compare", *runs]) == 0
    said = " ".join(capsys.readouterr().out.split())
    for whose in ("its training", "plain/0"):
        assert f"The views of sam/0's probe are not those of {whose}: '{name}': focal length by +3%" in said


@pytest.mark.parametrize("what", ["metrics.json", "probe/probe.json"])
def test_a_study_refuses_records_of_another_checkpoint(runs, what):
    assert row_of(Path(runs[0]))["steps"] == ITERATIONS
    path = Path(runs[0]) / what
    text = path.read_text()
    state = load_checkpoint(Path(runs[0]) / "checkpoint.pt").state
    assert state in text
    path.write_text(text.replace(state, "of another"))
    with pytest.raises(InputError, match=f"in {path} a record of the checkpoint beside it, got one of another"):
        row_of(Path(runs[0]))


def test_figures_of_a_comparison_are_of_the_records_that_were_compared(runs, tmp_path, no_pictures):
    assert main(["compare", *runs, "--out", str(tmp_path)]) == 0
    replaced(runs[1])
    record(Path(runs[1]) / "probe", 1.0)
    with pytest.raises(InputError, match=r"expected the record that was compared in .*, got another; compare again"):
        draw_comparison(tmp_path)


def test_at_least_two_different_runs_are_asked_for(runs, capsys):
    refused(capsys, runs[:1], "expected at least two runs")
    refused(capsys, [runs[0], runs[0]], "expected at least two runs, each once")
    refused(capsys, [runs[0], runs[0] + "/probe"], "expected a checkpoint written by landscape train")
