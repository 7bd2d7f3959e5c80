"""The limits of the renderer: errors inside their bounds, or an error that names attribute and Gaussian."""

import pandas as pd
import pytest
import torch

import analysis.bench.stress.command as stress
from analysis.bench.command import run_bench
from analysis.bench.options import BenchOptions
from analysis.bench.stress.cases import cases, refusals, steady
from analysis.bench.stress.command import PRECISIONS, Finding, Scene, Study, refused
from analysis.bench.stress.condition import STEP, roundings

CASES = {case.name: case for case in cases(0)}
FAST = [
    "needles, aspect 1e6",
    "one log-scale of 20",
    "across the near plane",
    "world units of 1e-6",
    "zero residual everywhere",
]
REFUSALS = {refusal.name: refusal for refusal in refusals(0)}


@pytest.mark.parametrize("name", FAST)
def test_both_precisions_stay_inside_their_bounds(name):
    findings = Study(CASES[name], 0).run()
    missed = [finding for finding in findings if not finding.holds]
    assert not missed, missed[:3]
    quantities = {finding.quantity for finding in findings}
    assert quantities == {"image", "gradient", "H v", "Gauss-Newton v", "spectrum", "own blocks", "traces"}
    # a bound that allows anything says nothing: float32 has at least three digits in the products of every case
    products = [f for f in findings if f.quantity == "H v" and f.precision == "float32"]
    assert all(f.bound < 1e-2 * max(g.size for g in products) for f in products)


@pytest.mark.parametrize("name", REFUSALS)
def test_what_has_no_derivatives_is_named(name):
    finding = refused(REFUSALS[name])
    assert finding.verdict == "refused", finding.message


def test_every_case_is_drawn_away_from_the_thresholds_in_float32_numbers():
    for case in CASES.values():
        assert steady(case.gaussians, case.camera, case.settings)
        assert torch.equal(case.gaussians.flat, case.gaussians.flat.float().double())


def test_a_rounding_has_the_size_that_it_says():
    x = torch.tensor([3.0, -2.0, 0.0] * 100, dtype=torch.float64)
    changes = (roundings(1)(x) - x)[x != 0] / x[x != 0] / STEP
    # 1 + STEP is itself rounded, to half an eps
    assert (changes.abs() - 1).abs().max() < 2e-16 / STEP * 2 and changes.min() < 0 < changes.max()
    assert torch.equal(roundings(1)(x), roundings(1)(x)) and not torch.equal(roundings(1)(x), roundings(2)(x))


def test_the_same_seed_gives_the_same_findings():
    one, other = (Study(CASES["one Gaussian"], 3).run() for _ in range(2))
    assert one == other


@pytest.fixture
def one_case(monkeypatch):
    monkeypatch.setattr(stress, "cases", lambda seed: iter([CASES["one Gaussian"]]))
    return "one Gaussian"


def test_the_command_prints_and_writes_every_case(one_case, tmp_path, capsys):
    assert run_bench(BenchOptions(subject="stress", out=tmp_path)) == 0
    table = pd.read_csv(tmp_path / "stress.csv")
    assert set(table["case"]) == {one_case, *REFUSALS} and set(table["precision"]) == set(PRECISIONS)
    assert list(table.columns) == list(Finding.__annotations__)
    shown = capsys.readouterr()
    assert "0 outside their bounds" in shown.out and one_case in shown.out
    assert f"1 of 1: {one_case}" in shown.err.splitlines()


def test_one_digit_too_few_is_an_exit_code(one_case, tmp_path, monkeypatch, capsys):
    image = Scene.image
    monkeypatch.setattr(Scene, "image", lambda self: image(self) * (1 + 1e-5))
    assert run_bench(BenchOptions(subject="stress", out=tmp_path)) == 1
    table = pd.read_csv(tmp_path / "stress.csv")
    assert set(table[table["verdict"] == "outside"]["quantity"]) == {"image"}
    assert "outside" in capsys.readouterr().out


def test_an_input_that_passes_where_it_must_not_is_told():
    refusal = REFUSALS["sh nan"]
    good = type(refusal)("good", next(iter(CASES.values())).gaussians, refusal.words)
    assert refused(good).verdict == "not refused" and not refused(good).holds
