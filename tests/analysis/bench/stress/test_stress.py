"""The limits of the renderer: errors inside their bounds, or an error that names attribute and Gaussian."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import pandas as pd
import pytest
import torch

import analysis.bench.stress as stress
from analysis.bench.command import run_bench
from analysis.bench.options import BenchOptions
from analysis.bench.stress import BACKGROUND, WITH_SSIM, cases, gaussians_of, set_rows, steady
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.model.gaussians import ATTRIBUTES, Gaussians
from splat.scenes.view import View
from tests.analysis.bench.stress.condition import STEP, roundings
from tests.analysis.bench.stress.study import Scene, Study

CASES = {case.name: case for case in cases(0)}
FAST = ["needles, aspect 1e6", "one log-scale of 20", "across the near plane", "world units of 1e-6"]
FAST += ["zero residual everywhere"]


@dataclass(frozen=True, eq=False)
class Refusal:
    """An input that must raise a ValueError whose message has these words."""

    name: str
    gaussians: Gaussians
    words: tuple[str, ...]


def refusals(seed: int) -> Iterator[Refusal]:
    """Inputs that must be refused; Gaussian 1 is the bad one."""

    def bad(name: str, attribute: str, value: object) -> Refusal:
        change = set_rows(attribute, value, 1)
        return Refusal(name, gaussians_of(3, torch.Generator().manual_seed(seed), change), (attribute, "Gaussian 1 "))

    for attribute in ATTRIBUTES:
        for value in (float("nan"), float("inf")):
            yield bad(f"{attribute} {value}", attribute, value)
    yield bad("quaternion of length 0", "quats", 0.0)
    yield bad("quaternion of length 1e-12", "quats", 5e-13)
    yield bad("quaternion of length 1e12", "quats", 5e11)
    yield bad("log-scales of 400", "log_scales", 400.0)
    yield bad("sh of 1e20", "sh", 1e20)
    everywhere = gaussians_of(3, torch.Generator().manual_seed(seed), set_rows("opacity_logits", -50.0))
    yield Refusal("all transparent", everywhere, ("expected Gaussians in sight",))


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
    refusal, case = REFUSALS[name], CASES["one Gaussian"]
    view = View("", case.camera, case.target)
    with pytest.raises(ValueError) as caught:
        SceneObjective(refusal.gaussians.to(torch.float32), [view], WITH_SSIM, BACKGROUND, case.settings)
    assert all(word in str(caught.value) for word in refusal.words), caught.value


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


def test_an_error_of_one_digit_too_many_is_outside_its_bound(monkeypatch):
    image = Scene.image
    monkeypatch.setattr(Scene, "image", lambda self: image(self) * (1 + 1e-5))
    missed = [finding for finding in Study(CASES["one Gaussian"], 0).run() if not finding.holds]
    assert {finding.quantity for finding in missed} == {"image"}


@pytest.fixture
def one_case(monkeypatch):
    monkeypatch.setattr(stress, "cases", lambda seed: iter([CASES["one Gaussian"]]))
    return "one Gaussian"


def test_the_command_prints_and_writes_every_case(one_case, tmp_path, capsys):
    assert run_bench(BenchOptions(subject="stress", out=tmp_path)) == 0
    table = pd.read_csv(tmp_path / "stress.csv")
    assert list(table["case"]) == [one_case]
    errors = table.iloc[0].drop("case")
    assert {"image", "gradient", "H v", "Gauss-Newton v", "traces", "lambda max", "lambda min"} == {*errors.index}
    assert all(0 <= error < 1e-4 for error in errors)
    assert one_case in capsys.readouterr().out


def test_a_number_that_is_none_is_an_exit_code(one_case, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(SceneHessian, "apply", lambda self, v: v * float("nan"))
    monkeypatch.setattr(stress, "cases", lambda seed: iter([replace(CASES["one Gaussian"], dense=False)]))
    assert run_bench(BenchOptions(subject="stress", out=tmp_path)) == 1
    assert "got NaN in one Gaussian" in capsys.readouterr().out
