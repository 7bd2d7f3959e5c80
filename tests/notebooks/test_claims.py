"""Verdicts follow the numbers: a study made up as the paper has it, one as it does not, and what neither decides."""

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import pytest
from msgspec import convert

from analysis.console.overrides import assignments, overridden
from analysis.records.findings import ATTRIBUTES
from analysis.records.records import ProbeRecord, read_record
from analysis.records.schema import Anisotropy, BlockAnisotropy, End, Index
from analysis.runs.sweep.sweep_file import read_sweep
from notebooks.paper.__main__ import main
from notebooks.paper.effects import UNTESTED, Interval, gain, gains, log_ratios
from notebooks.paper.figures import ONLY
from notebooks.paper.predictors import predictors
from notebooks.paper.statements import ATTRIBUTES_ALONE, AXIS, VIEWPOINTS_ALONE, judgements
from notebooks.paper.study import _hutchinson, _more, _runs, method_name, study, unended
from notebooks.statistics import DRAWS
from splat.training.methods.methods import METHODS, presets
from splat.training.start import Source
from splat.training.state import TrainConfig
from tests.recorded import synthetic, written

LARGER = ("eigenvalue_ratio", "top_mass")  # the more anisotropic
NAMES = ("claims", "predictors", "budget", "axes")
STABLE, ALONE = "stablegs", "stablegs vsp_weight=0"
PAPER = {"eigenvalue_ratio": 0.26, "psnr": 4.9, "attributes": 2.92, "viewpoints": 2.29, "means": 2.46, "over": 0.45,
         "depth": 100.0, "needles": 0.9, "ranks": 1e4, "time": 1.25, "lambda": 0.3,
         "elongation": 0.5, "opacity": 0.6}  # fmt: skip
OTHERWISE = {"eigenvalue_ratio": 1.5, "psnr": -0.2, "attributes": 0.4, "viewpoints": 0.1, "means": -0.3, "over": -0.5,
             "depth": 0.01, "needles": 0.01, "ranks": 3.0, "time": 5.0, "lambda": 2.0,
             "elongation": 1.5, "opacity": -0.3}  # fmt: skip


def made_up(world: dict, seeds: int = 3, spread: float = 0.02) -> pd.DataFrame:
    """A study in which StableGS does what the world says, up to a relative spread over the seeds."""
    rng, rows = np.random.default_rng(0), []
    gains = {"3dgs": 0.0, STABLE: world["psnr"], ALONE: world["attributes"]}
    gains["stablegs asp_weight=0"], gains["dropgaussian"] = world["viewpoints"], world["psnr"] - world["over"]
    gains |= {f"{ALONE} probe.attributes={name}": world["means"] if name == "means" else 0.5 for name in ATTRIBUTES}
    for method, more in gains.items():
        ours = world if method == STABLE else dict.fromkeys(world, 1)
        for seed in range(seeds):
            ratio, top = ours["eigenvalue_ratio"], 50 * ours["lambda"]
            exact = dict.fromkeys(LARGER, 100 * ratio)
            exact |= {"negative_ratio": 10 / ratio, "participation_ratio": 10 / ratio, "gaussians": 8000.0}
            exact |= {"depth_gradient": world["depth"], "needles": world["needles"], "cpu_seconds": 100 * ours["time"]}
            exact["opacity_one_view"] = world["opacity"]
            exact |= {"lambda_max": top, "lambda_second": top / (5 * ours["elongation"])}
            for name in ATTRIBUTES:
                exact[f"hutchinson_{name}"] = (0.2 / world["ranks"]) ** 0.5
                exact[f"hutchinson_{name}_most"] = 2 * exact[f"hutchinson_{name}"]
            row = {"scene": "fern", "method": method, "seed": seed, "steps": 10_000, "views": 3, "threads": 2}
            row |= {name: value * (1 + spread * rng.standard_normal()) for name, value in exact.items()}
            rows.append(row | {"psnr": 16.46 + more + spread * rng.standard_normal(), "needle_count": 0.05})
    return pd.DataFrame(rows)


def test_every_statement_holds_in_a_world_that_is_the_papers():
    assert [each.verdict for each in judgements(made_up(PAPER))] == ["holds"] * 10


def test_no_statement_holds_in_the_opposite_world():
    found = judgements(made_up(OTHERWISE))
    assert [each.verdict for each in found] == ["does not hold"] * 10
    assert all(a.finding != b.finding for a, b in zip(found, judgements(made_up(PAPER)), strict=True))


def test_two_seeds_or_a_study_without_numbers_decide_nothing():
    assert judgements(made_up(PAPER).assign(views=8))[8].verdict == UNTESTED  # gains are of three views
    found = judgements(made_up(PAPER, seeds=2))
    assert {found[n - 1].verdict for n in (1, 3, 4, 7, 8, 9, 10)} == {UNTESTED}
    rows = pd.DataFrame(made_up(PAPER)[["scene", "method", "seed", "views"]])
    assert {each.verdict for each in judgements(rows)} == {UNTESTED}


def test_seeds_that_scatter_more_than_the_effect_decide_nothing():
    rows = made_up(PAPER)
    wide = rows["method"].eq(STABLE)
    rows.loc[wide, "psnr"] = [10.0, 20.0, 30.0]
    rows.loc[wide, ["eigenvalue_ratio", "lambda_max", "cpu_seconds"]] = np.array([[1.0, 100.0, 1000.0]] * 3).T
    found = {each.number: each.verdict for each in judgements(rows)}
    assert {found[n] for n in (1, 7, 9)} == {"undecided"} and found[8] == UNTESTED  # no one viewpoint was trained


def test_a_gain_that_falls_short_of_the_papers_holds_in_part():
    found = judgements(made_up(PAPER | {"psnr": 1.0, "eigenvalue_ratio": 0.6, "lambda": 1.0}))
    assert [found[n - 1].verdict for n in (1, 7, 9)] == ["holds in part"] * 3


def test_an_index_that_contradicts_the_literal_one_is_named():
    rows = made_up(PAPER)
    rows["negative_ratio"] = rows["negative_ratio"].where(rows["method"] != STABLE, 5.0)
    first = judgements(rows)[0]
    assert first.verdict == "holds in part"
    assert "negative ratio" in first.finding


def test_times_are_compared_only_on_one_machine_and_a_cell_counts_once():
    rows = made_up(PAPER).assign(machine="A", cpu_seconds=100.0)
    there = pd.DataFrame(rows[rows["method"].isin(["3dgs", STABLE])]).assign(machine="B", cpu_seconds=7.0)
    there.loc[there["method"] == STABLE, "cpu_seconds"] = 21.0
    rows.loc[rows["method"] == STABLE, "machine"] = "C"  # of which no 3DGS was trained
    found = log_ratios(pd.concat([rows, there]), "cpu_seconds")
    assert np.allclose(np.exp(found), 3.0) and len(found) == 3
    assert log_ratios(rows, "cpu_seconds").empty and len(log_ratios(rows, "eigenvalue_ratio")) == 3
    assert len(gains(pd.concat([rows, there]), STABLE)) == 3


def test_the_interval_covers_the_mean_of_normal_numbers():
    rng = np.random.default_rng(1)
    found = [Interval.of(list(rng.standard_normal(3))) for _ in range(2000)]
    assert 0.93 < np.mean([each.low < 0 < each.high for each in found]) < 0.97


def test_gains_share_the_deviation_of_all_methods():
    """95% intervals of three seeds; alone they would be as wide as Student's with two degrees of freedom."""
    rng, covered, widths = np.random.default_rng(2), [], []
    for _ in range(100):
        rows = pd.DataFrame({"scene": "fern", "method": np.repeat(["3dgs", *"abcdefg"], 3), "seed": [0, 1, 2] * 8})
        rows["psnr"] = rng.standard_normal(24)
        found = gain(rows, "a")
        covered.append(found.low < 0 < found.high)
        widths.append(found.high - found.low)
    assert abs(np.mean(covered) - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 100)
    assert np.mean(widths) < 0.6 * 2 * 4.30 * np.sqrt(2 / 3)  # the width of Student's, on the average


def trainings(scenes: int, methods: int, rng: np.random.Generator) -> pd.DataFrame:
    """Made-up runs of three seeds: 89% of the variance of every number is between methods, and none has to do with another."""
    keys = [(f"s{s}", f"m{m}", seed) for s in range(scenes) for m in range(methods) for seed in range(3)]
    rows = pd.DataFrame(keys, columns=["scene", "method", "seed"])
    scene, method = (pd.factorize(rows[key])[0] for key in ("scene", "method"))
    for name in ("psnr", "train_psnr", "gaussians", "lambda_max", "lambda_min"):
        own, everywhere = rng.standard_normal((scenes, methods)), rng.standard_normal(methods)
        between = (everywhere[method] + own[scene, method]) / np.sqrt(2)
        rows[name] = np.sqrt(0.89) * between + np.sqrt(0.11) * rng.standard_normal(len(rows))
    return rows


@pytest.mark.parametrize(("scenes", "draws"), [(1, 60), (5, 20)])
def test_of_numbers_that_have_nothing_to_do_with_the_score_one_in_twenty_seems_to(scenes, draws):
    """Four of them a study, within four standard errors as if the four were one."""
    rng = np.random.default_rng(scenes)
    table = pd.concat([predictors(trainings(scenes, 12, rng)) for _ in range(draws)])
    assert set(table["clusters"]) == {12 if scenes == 1 else 5}
    for kind in ("all", "given", "within"):
        p, holm, low, high = np.asarray(table[table["kind"] == kind][["p", "holm", "low", "high"]], float).T
        assert np.mean(p < 0.05) < 0.05 + 4 * np.sqrt(0.05 * 0.95 / draws), kind
        assert kind == "within" or np.array_equal(p < 0.05, (low > 0) | (high < 0))
        assert np.all((holm >= p) & (holm <= 1))


def test_what_predicts_the_score_is_found_beyond_what_both_follow_from():
    rows = trainings(1, 24, np.random.default_rng(0))
    rows["psnr"] += 2 * rows["train_psnr"] + 2 * rows["lambda_min"]
    rows["lambda_max"] += 2 * rows["train_psnr"]  # goes with the score through the controls alone
    found = predictors(rows).set_index(["quantity", "kind"])
    assert found.loc[("lambda_max", "all"), "holm"] < 0.05 < found.loc[("lambda_max", "given"), "holm"]
    assert found.loc[("lambda_min", "given"), "holm"] < 0.05 and found.loc[("lambda_min", "within"), "tau"] > 0
    alone = rows["psnr"] - rows.groupby("method")["psnr"].transform("mean")
    apart = predictors(rows.assign(lambda_max=alone)).set_index(["quantity", "kind"]).loc[("lambda_max", "within")]
    assert apart["tau"] == 1 and apart["p"] == 1 / (1 + DRAWS)
    twice = predictors(pd.concat([rows, rows])).set_index(["quantity", "kind"])
    pd.testing.assert_frame_equal(twice, found)  # a training that was repeated counts once


def test_quantities_that_most_runs_lack_are_left_out():
    rows, most = trainings(1, 8, np.random.default_rng(0)), pd.Series(np.arange(24) < 12)
    for name, asked in (("needles", ~most | (most.index % 3 < 2)), ("negative_ratio", most & (most.index > 0))):
        rows[name] = rows["lambda_max"].where(asked)
    assert {"needles"} == {"needles", "negative_ratio"} & {*predictors(rows)["quantity"]}  # most runs lack the other


def test_a_row_has_the_curvature_that_adams_steps_see(tmp_path):
    data, arrays = synthetic()
    data["eigenvalues"]["max"]["lives_on"] = {"participation": 1.1, "needles": 0.9, "needle_count": 3}
    data["eigenvalues"]["max"] |= {"value": 4.0, "renders": {
        "confirmed": False, "optimiser_step": 1e-3, "steps": [1e-4, 1e-3], "ratios": [1.0, 0.5], "errors": [0.0, 0.1],
    }}  # fmt: skip
    carrier = {"gaussian": 4, "share": 0.8, "attribute": "quats"}
    data["eigenvalues"]["max"]["carrier"] = carrier
    written(tmp_path / "probe", data, arrays)
    row = _more(read_record(tmp_path / "probe", ProbeRecord).data)
    assert row["finite_curvature"] == 0.5 * 4.0
    assert row["one_gaussian"] == 0.8


def test_a_map_of_a_run_adds_what_one_view_sees(tmp_path, monkeypatch):
    from types import SimpleNamespace

    from notebooks.paper import study as module

    shares = {"quats": 0.6, "log_scales": 0.5}
    fragile = SimpleNamespace(opacity_one_view=0.25, needles=0.1, needles_trace=shares, depth_gradient=None)
    found = SimpleNamespace(fragility=fragile, provenance=SimpleNamespace(fingerprint=None))
    monkeypatch.setattr(module, "require_own", lambda made, state, path, again: None)
    monkeypatch.setattr(module, "read_map", lambda folder: found if folder == tmp_path / "map" else None)
    assert module._of_map(tmp_path, "state") == {}
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "map.json").touch()
    row = module._of_map(tmp_path, "state")
    assert np.isnan(row.pop("depth_gradient"))
    assert row == {"opacity_one_view": 0.25, "needle_count": 0.1, "needles_quats": 0.6, "needles_log_scales": 0.5}


def test_ten_samples_suffice_where_the_largest_error_is_small():
    rows = made_up(PAPER)
    large = {f"hutchinson_{name}_most": 0.3 for name in ATTRIBUTES}
    assert judgements(rows.assign(**large))[5].verdict == "undecided"
    assert judgements(rows.drop(columns="hutchinson_sh_most"))[5].verdict == UNTESTED
    assert judgements(rows.assign(hutchinson_quats=0.3, **large))[5].verdict == "does not hold"


@pytest.mark.parametrize("least", [0.5, -0.5])
def test_bounds_of_ten_samples_enclose_the_error_of_a_known_spectrum(least):
    spectrum = np.linspace(least, 4.0, 20)
    size, true = np.abs(spectrum).sum(), np.sqrt(2 * (spectrum**2).sum() / 10) / spectrum.sum()
    index = {name: Index(value=x, low=x, high=x, note="") for name, x in
             {"participation_ratio": size**2 / (spectrum**2).sum(), "top_mass": spectrum.max() / size}.items()}  # fmt: skip
    end = End(value=spectrum.max(), residual=0.0)
    about: dict = {"metric": "parameters", "unit": "", "operator": "hessian", "block": "quats", "split": False}
    sizes: dict = {"gaussians": 5, "rank": 20}
    family = BlockAnisotropy(**about, **sizes, lambda_max=end, lambda_min=end, indices=Anisotropy(**index))
    trace = SimpleNamespace(value=spectrum.sum(), standard_error=0.0)
    data = SimpleNamespace(per_attribute=[family], traces={"quats": trace})
    found = _hutchinson(cast(ProbeRecord, data))
    assert found["hutchinson_quats_most"] == pytest.approx(true)
    assert found["hutchinson_quats"] <= true * (1 + 1e-12)


def test_needles_that_dominate_one_of_two_attributes_hold_in_part():
    rows = made_up(PAPER).assign(needles_quats=0.9, needles_log_scales=0.02)
    third = judgements(rows)[2]
    assert third.verdict == "holds in part" and "curvature of log scale on needles: 0.02" in third.finding
    assert judgements(rows.assign(needles_log_scales=0.8))[2].verdict == "holds"
    assert judgements(rows.assign(needles_quats=0.03))[2].verdict == "does not hold"


def test_the_command_reads_a_table_and_writes_it_with_its_verdicts(tmp_path, capsys):
    made_up(PAPER).to_csv(tmp_path / "study.csv", index=False)
    out = tmp_path / "out"
    assert main([str(tmp_path / "study.csv"), "--out", str(out)]) == 0
    wanted = {f"{name}.{suffix}" for name in NAMES for suffix in ("png", "pdf")} | {"captions.md"}
    wanted |= {"study.csv", "claims.csv", "predictors.csv"}
    said = capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == wanted and all(str(out / name) in said for name in wanted)
    assert said.count("\n   holds: ") == 10
    again = study([out / "study.csv"])
    assert [each.verdict for each in judgements(again)] == ["holds"] * 10


def test_the_stored_study_is_read_with_all_of_its_rows():
    path = Path(__file__).parents[2] / "notebooks" / "results" / "study.csv"
    rows = study([path])
    assert len(rows) == len(path.read_text().splitlines()) - 1 and set(rows["lambda_max_reason"]) == {"tolerance"}


def test_a_run_that_has_not_ended_is_left_out_and_said(tmp_path):
    for name in ("ended", "ended/step-2", "under way", "under way/step-2"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "checkpoint.pt").write_bytes(b"")
    (tmp_path / "ended" / "metrics.json").write_bytes(b"")
    assert list(_runs(tmp_path)) == [tmp_path / "ended"]
    assert unended([tmp_path, tmp_path / "study.csv"]) == [tmp_path / "under way"]


def test_a_table_of_something_else_and_a_run_named_twice_are_refused(tmp_path, capsys):
    pd.DataFrame({"scene": ["fern"]}).to_csv(tmp_path / "other.csv", index=False)
    made_up(PAPER).to_csv(tmp_path / "study.csv", index=False)
    for arguments in (["other.csv"], ["study.csv", "study.csv"], ["."]):
        (tmp_path / "empty").mkdir(exist_ok=True)
        paths = [str(tmp_path / name) if name != "." else str(tmp_path / "empty") for name in arguments]
        assert main(paths) == 2
        assert "expected" in capsys.readouterr().err


def test_a_protocol_is_named_and_not_its_settings():
    config = TrainConfig(3000, protocol="llff", method=METHODS["fsgs"]())
    config = overridden(config, presets("fsgs", "llff"))
    config = config.method.scaled(config)
    assert method_name(config) == "fsgs protocol=llff"
    assert method_name(overridden(config, {"neighbours": "4"})) == "fsgs protocol=llff neighbours=4"


NOTEBOOKS = Path(__file__).parents[2] / "notebooks"


def names_in(file: str) -> set[str]:
    """The methods of a sweep, as the table of a study has them."""
    names = set()
    for cell in read_sweep(NOTEBOOKS / file).cells:
        options, method = cell.training, METHODS[cell.training.method]()
        config = TrainConfig(iterations=cell.steps, protocol=options.protocol, method=method)
        preset = presets(options.method, options.protocol)
        config = overridden(config, {key: value for key, value in preset.items() if key not in ("start", "iterations")})
        config = overridden(config, assignments(options.set))
        start = convert(options.start or preset.get("start", "scene"), Source)
        names.add(method_name(config.method.scaled(config), start))
    return names


@pytest.mark.parametrize(
    ("table", "file"),
    [("study.csv", "study_small.toml"), ("study_full.csv", "study.toml"), ("study_lego.csv", "study_lego.toml")],
)
def test_every_stored_training_is_a_cell_of_the_file_that_repeats_it(table, file):
    rows = pd.read_csv(NOTEBOOKS / "results" / table)
    assert set(rows["method"]) <= names_in(file)
    cells = read_sweep(NOTEBOOKS / file).cells
    assert set(rows["steps"]) == {cell.steps for cell in cells} and set(rows["seed"]) <= {cell.seed for cell in cells}


@pytest.mark.parametrize("file", ["study.toml", "study_small.toml"])
def test_the_studies_in_the_repository_decide_every_statement(file):
    names = names_in(file)
    needed = {"3dgs", "stablegs", "stablegs viewpoints=one", ATTRIBUTES_ALONE, VIEWPOINTS_ALONE}
    assert needed | {AXIS.format(name) for name in ATTRIBUTES} | set(ONLY.values()) <= names


def test_the_full_study_has_the_start_of_the_sparse_view_literature():
    assert {"3dgs start=dense", "stablegs start=dense"} <= names_in("study.toml")
