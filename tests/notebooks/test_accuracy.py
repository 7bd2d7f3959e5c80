"""The accuracy study's figures mean what they say: truth, products counted, ratios, and peers that are run as they are."""

import importlib.util
import math
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg

from analysis.bench.accuracy.cases import Case, MeteredOperator
from analysis.bench.accuracy.command import JACOBIAN, PASS, Answer, Method, Run, measure, points, truth_of
from figures import accuracy as figure
from landscape.operators.operator import DenseOperator, SumOperator
from notebooks.accuracy import __main__ as accuracy
from notebooks.accuracy.__main__ import precision_runs
from notebooks.accuracy.cases import (
    MatrixOperator,
    StudyCase,
    matrix_cases,
    spectra,
    splat_case,
    splat_cases,
    truth_of_matrix,
)
from notebooks.accuracy.methods import own_methods
from notebooks.accuracy.peers import PACKAGES, peer_methods, scipy_methods
from notebooks.accuracy.ratios import needed, ratios
from splat.curvature.hessian import SceneHessian
from splat.losses.reference import LossSettings
from splat.scenes.synthetic import SyntheticSettings

TINY = SyntheticSettings(50, 2, 10, 8, sh_degree=0)
BLOCKS = {"a": slice(0, 24), "b": slice(24, 60)}


def case_of(values: torch.Tensor, name: str = "case") -> StudyCase:
    vectors = torch.linalg.qr(torch.randn(60, 60, generator=torch.Generator().manual_seed(3), dtype=torch.float64)).Q
    matrix = (vectors * values) @ vectors.T
    matrix = (matrix + matrix.T) / 2
    return StudyCase(name, "matrices", MatrixOperator(matrix, BLOCKS), truth_of_matrix(matrix, BLOCKS))


@pytest.fixture(scope="module")
def matrix() -> StudyCase:
    return case_of(torch.linspace(-1, 3, 60, dtype=torch.float64) ** 3)


@pytest.fixture(scope="module")
def pixels_alone() -> StudyCase:
    return splat_case("tiny", 0.2, LossSettings(ssim_weight=0.0), 0, TINY)


@pytest.fixture(scope="module")
def with_ssim() -> StudyCase:
    return splat_case("tiny, SSIM", 0.2, LossSettings(), 0, TINY)


def by_name(quantity: str, name: str, origin: str | None = None) -> list[Method]:
    found = [m for m in own_methods() if m.quantity == quantity and m.name == name]
    return [m for m in found if origin is None or m.origin == origin]


class CountingDense(DenseOperator):
    """Counts independently of what the study counts."""

    count = 0

    def apply(self, V: torch.Tensor) -> torch.Tensor:
        self.count += V.shape[1]
        return super().apply(V)


def test_the_truth_of_a_diagonal_matrix_is_what_its_entries_say():
    values = torch.tensor([4.0, -1.0, 3.0, 2.0], dtype=torch.float64)
    truth = truth_of_matrix(torch.diag(values), {"a": slice(0, 2), "b": slice(2, 4)})
    assert truth.traces == {"a": 3.0, "b": 5.0} and truth.scales == {"a": 5.0, "b": 5.0}
    assert (truth.largest, truth.smallest, truth.absolute_sum) == (4.0, -1.0, 10.0)
    assert truth.participation_ratio == pytest.approx(100 / 30)
    assert truth.diagonal is not None and torch.equal(truth.diagonal, values)


def test_the_matrices_have_the_spectra_prescribed():
    for case, values in zip(matrix_cases(0), spectra().values(), strict=True):
        assert isinstance(case.operator, DenseOperator)
        got = torch.linalg.eigvalsh(case.operator.matrix)
        assert float((got - values.sort().values).abs().max()) < 1e-12 * float(values.abs().max())


def test_a_scenes_matrix_is_its_operator(with_ssim):
    V = torch.randn(with_ssim.operator.dim, 3, generator=torch.Generator().manual_seed(0))
    objective = with_ssim.objective
    assert objective is not None and with_ssim.price is not None
    product = SceneHessian(objective).apply(V)
    assert float((with_ssim.operator.apply(V) - product).norm()) < 1e-3 * float(product.norm())
    assert with_ssim.price(9) == pytest.approx(with_ssim.price(8) + with_ssim.price(1))


def test_the_products_counted_are_those_applied(matrix):
    seen = CountingDense(matrix.operator.matrix, BLOCKS)
    # of a matrix a block's product skips columns: hidden in a sum, it is applied as it is
    case = Case("counted", "matrices", SumOperator([seen]), matrix.truth)
    _ = case.ends  # kept, and not counted
    methods = {method.name: method for method in (*own_methods((24,)), *scipy_methods())}
    for method in methods.values():
        if method.applies(case):
            seen.count = 0
            assert {run.matvecs for run in measure(case, method, 0)} == {seen.count}, method.name
            assert seen.count > 0


def test_products_with_a_block_are_those_of_the_whole(matrix):
    meter, V = MeteredOperator(matrix), torch.zeros(60, 2, dtype=torch.float64)
    V[24:60] = torch.randn(36, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert float((meter.apply(V) - matrix.operator.matrix @ V).abs().max()) < 1e-13 * 27 * 8
    assert not meter.apply(torch.zeros(60, 1, dtype=torch.float64)).any() and meter.matvecs == 3


def test_an_exact_method_has_no_error_and_says_so(pixels_alone):
    (method,) = by_name("traces", "exact pass, pixel pairs sampled", "default")
    runs = measure(pixels_alone, method, 0)
    assert {run.part for run in runs} == set(pixels_alone.operator.blocks)
    # float32 products against float64: independent roundings of what is added up
    assert all(run.true_error < 10 * pixels_alone.round_off and run.reported_error == 0 for run in runs)
    assert runs[0].matvecs == PASS
    (diagonal,) = by_name("diagonal", "own blocks, pixels alone")
    assert measure(pixels_alone, diagonal, 0)[0].true_error < 10 * pixels_alone.round_off


def test_the_default_for_the_ends_of_a_scene_begins_at_its_own_blocks(with_ssim, matrix):
    (default,) = (m for m in own_methods() if m.quantity == "ends" and m.origin == "default" and m.applies(with_ssim))
    (other,) = (m for m in own_methods() if m.quantity == "ends" and m.origin == "default" and m.applies(matrix))
    assert (default.name, other.name) == ("led by own blocks", "Lanczos, both extremes")
    largest, smallest = measure(with_ssim, default, 0)
    assert largest.true_error < 1e-3 and smallest.true_error < 1e-3
    assert largest.matvecs % 1 == pytest.approx(PASS % 1)  # whole products, and a pass over the pixels


def test_sampled_coupling_is_charged_by_its_jacobian_products(with_ssim):
    method = next(m for m in by_name("traces", "exact pass, pixel pairs sampled") if m.settings == "8 samples")
    assert measure(with_ssim, method, 0)[0].matvecs == pytest.approx(2 * PASS + 8 * 5 * JACOBIAN)


def test_intervals_of_the_defaults_cover(matrix):
    (default,) = by_name("traces", "chosen by its probes", "default")
    covered = [run.covered for seed in range(10) for run in measure(matrix, default, seed)]
    # 20 at 95%: 12 or fewer have a probability of 1e-6, were they independent
    assert sum(covered) > 12


def test_true_errors_are_shares_of_their_scale(matrix):
    def answered(quantity: str, *answers: Answer) -> list[Run]:
        return measure(matrix, Method(quantity, "known", "", lambda *_: list(answers)), 0)

    truth = matrix.truth
    off = truth.traces["a"] + 0.5 * truth.scales["a"]
    (run,) = answered("traces", Answer("a", off, 0.1 * truth.scales["a"], off - 1e-3, off + 1e-3))
    assert run.true_error == pytest.approx(0.5) and run.reported_error == pytest.approx(0.1) and run.covered == 0
    (run,) = answered("ends", Answer("smallest", 1.1 * truth.smallest))
    assert run.true_error == pytest.approx(0.1) and math.isnan(run.covered) and math.isnan(run.reported_error)
    (run,) = answered("sums", Answer("participation ratio", 2 * truth.participation_ratio, low=1.0, high=1e9))
    assert (run.quantity, run.covered) == ("participation ratio", 1.0) and run.true_error == pytest.approx(1)
    assert truth.diagonal is not None
    half = truth.diagonal.clone()
    half[:30] += 1
    (run,) = answered("diagonal", Answer("all", half, torch.zeros(60), half, half))
    assert run.covered == 0.5 and run.true_error == pytest.approx(30**0.5 / float(truth.diagonal.norm()))


def test_an_end_that_is_zero_is_measured_by_the_other():
    case = case_of(torch.cat([torch.zeros(50), torch.arange(1, 11)]).double())
    assert truth_of(case, "ends", "smallest")[1] == pytest.approx(10) == truth_of(case, "ends", "largest")[1]


def test_the_precisions_of_a_scene_are_those_of_its_own_kernels(with_ssim):
    assert with_ssim.products is not None
    errors = {run.method: run.true_error for run in precision_runs(with_ssim, 0)}
    Z = torch.randn(with_ssim.operator.dim, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    single, double = (with_ssim.products[dtype].apply(Z.to(dtype)).double() for dtype in (torch.float32, torch.float64))
    assert errors["float64"] == 0
    # the mean of quadratic forms errs by no more than the products do, a few seeds' spread left as room
    assert 0 < errors["float32 products, float64 sums"] < 4 * float((single - double).norm() / double.norm())


def test_the_same_seed_gives_the_same_runs_but_for_the_seconds(matrix):
    from dataclasses import replace

    methods = {method.name: method for method in [*own_methods((24,)), *peer_methods((24,))[0]]}
    for method in methods.values():
        if method.applies(matrix):
            one, other = ([replace(run, seconds=0.0) for run in measure(matrix, method, 5)] for _ in range(2))
            assert str(one) == str(other), method.name


def test_scipy_finds_both_ends(matrix):
    tight = [m for m in scipy_methods() if m.settings == "tol 0.001"]
    assert len(tight) == 3
    larger = max(abs(matrix.truth.largest), abs(matrix.truth.smallest))
    for method in tight:
        for run in measure(matrix, method, 0):
            # a value is as near to an eigenvalue as its residual is small; lobpcg's is a share of the larger end
            _, scale = truth_of(matrix, "ends", run.part)
            assert run.true_error <= 1e-3 * (larger / scale if "lobpcg" in method.name else 1), method.name


@pytest.mark.parametrize("module", PACKAGES)
def test_an_absent_peer_is_named_and_the_others_run(module, monkeypatch):
    real = importlib.import_module

    def without(name, *rest):
        if name == module:
            raise ImportError(f"No module named {name!r}")
        return real(name, *rest)

    monkeypatch.setattr("notebooks.accuracy.peers.importlib.import_module", without)
    methods, missing = peer_methods()
    sentence = next(text for text in missing if text.startswith(PACKAGES[module]))
    assert "pip install" in sentence and any(m.name.startswith("SciPy") for m in methods)
    assert not any(m.name.lower().startswith(PACKAGES[module].split("-for-")[0]) for m in methods)


@pytest.mark.parametrize("module", PACKAGES)
def test_an_installed_peer_estimates_what_it_is_asked_for(module, matrix):
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"{PACKAGES[module]} is not installed (the extra `peers`)")
    state = torch.random.get_rng_state()
    prefix = PACKAGES[module].split("-for-")[0]
    methods = [m for m in peer_methods((48,))[0] if m.name.lower().startswith(prefix)]
    assert methods
    best: dict[str, float] = {}
    for method in methods:
        runs = [run for seed in range(2) for run in measure(matrix, method, seed)]
        assert all(run.matvecs > 0 and np.isfinite(run.true_error) for run in runs), method.name
        rms = float(np.sqrt(np.mean([run.true_error**2 for run in runs])))
        best[method.name] = min(rms, best.get(method.name, math.inf))
    # to a digit at the best of their settings, but for the diagonal of a matrix that is dense
    assert all(error < 0.5 for error in best.values()), best
    assert torch.equal(torch.random.get_rng_state(), state)


def table_of(
    case: str = "c", family: str = "matrices", alike: str = "", **methods: tuple[str, dict[str, tuple[float, float]]]
) -> pd.DataFrame:
    """Runs of four seeds that all have the same matvecs and error.  alike: the estimator of all peers, else their names."""

    def run(name: str, origin: str, setting: str, seed: int, cost: float, error: float) -> Run:
        estimator = alike if alike and origin == "peer" else name
        about = (case, family, "traces", "all", name, estimator, setting, origin, seed)
        return Run(*about, cost, cost / 10, error, 0.0, 1.0)

    return pd.DataFrame(
        vars(run(name, origin, setting, seed, cost, error))
        for name, (origin, settings) in methods.items()
        for setting, (cost, error) in settings.items()
        for seed in range(4)
    )


RIVAL = {"10": (10.0, 1e-1), "1000": (1000.0, 1e-3)}


@pytest.mark.parametrize(
    ("default", "ratio", "bound", "holds"),
    [
        ((80.0, 1e-2), 0.8, "", "yes"),
        ((200.0, 1e-2), 2.0, "", "no"),
        ((80.0, 1e-9), 0.08, "≤", "yes"),
        ((2000.0, 1e-9), 2.0, "≤", "open"),
        ((8.0, 0.9), 0.8, "≥", "open"),
        ((30.0, 0.9), 3.0, "≥", "no"),
    ],
)
def test_a_ratio_is_read_at_equal_error_and_beyond_a_rivals_settings_it_is_a_bound(default, ratio, bound, holds):
    rivals: dict[str, Any] = {
        "r": ("peer", RIVAL),
        "quick": ("peer", {"5": (5.0, 0.95)}),
        "failed": ("peer", {"1": (1.0, math.nan)}),
    }
    (line,) = ratios(table_of(d=("default", {"": default}), **rivals), {"c": 1e-16}).to_dict("records")
    assert (line["bound"], line["holds"], line["asked"], line["rival"]) == (bound, holds, 1.1, "r")
    assert [line[name] for name in ("ratio", "seconds_ratio", "low", "high")] == pytest.approx([ratio] * 4)


def test_packages_that_have_an_estimator_alike_are_one_rival():
    lucky, other = ("peer", {"50": (50.0, 6e-3)}), ("peer", {"50": (50.0, 8e-3)})

    def bound(error: float, alike: str) -> tuple[str, str]:
        table = table_of(alike=alike, d=("default", {"": (100.0, error)}), lucky=lucky, other=other)
        line = ratios(table, {"c": 0.0}).iloc[0]
        return line["rival"], line["bound"]

    assert bound(6.5e-3, "") == ("lucky", "≥")
    # the root of their mean square is 7.07e-3
    assert bound(7.0e-3, "both") == ("both", "≤") and bound(7.1e-3, "both") == ("both", "≥")


def test_scenes_together_are_their_geometric_mean():
    scenes = [
        table_of(case=name, family="splats", d=("default", {"": (cost, 1e-2)}), r=("peer", RIVAL))
        for name, cost in (("a", 20.0), ("b", 80.0))
    ]
    matrix = table_of(d=("default", {"": (99.0, 1e-2)}), r=("peer", RIVAL))
    found = ratios(pd.concat([*scenes, matrix]), {"a": 0.0, "b": 0.0, "c": 0.0})
    assert found["case"].tolist() == ["a", "b", "c", "all 2 scenes"]
    alone, together = found.iloc[1], found.iloc[3]
    assert alone["ratio"] == pytest.approx(0.8) and alone["holds"] == "no" and alone["asked"] == 0.5
    assert together["ratio"] == pytest.approx(0.4) == together["low"] and together["holds"] == "yes"
    assert together["bound"] == "" and together["needs"] == pytest.approx(40)


def test_errors_below_the_round_off_count_as_it():
    rival = {"10": (10.0, 1e-9), "20": (20.0, 1e-12)}
    table = table_of(d=("default", {"": (15.0, 1e-13)}), r=("peer", rival))
    (line,) = ratios(table, {"c": 1e-6}).to_dict("records")
    assert (line["rival_needs"], line["error"]) == (10.0, 1e-6)
    assert points(table, {"c": 1e-6})["true_error"].tolist() == [1e-6] * 3


def test_a_setting_counts_with_the_largest_error_of_the_costlier_ones():
    costs = np.array([10.0, 100.0, 1000.0])
    lucky = np.array([1e-1, 1e-3, 1e-2])
    assert needed(lucky, costs, 1e-2) == (pytest.approx(100.0), "")
    assert needed(lucky, costs, 1e-3) == (1000.0, "≤")
    failed = np.array([1e-1, 1e-3, np.inf])  # what failed with more work says nothing of less
    assert needed(failed, costs, 1e-3) == (pytest.approx(100.0), "")


@pytest.fixture
def small(monkeypatch, matrix):
    monkeypatch.setattr(accuracy, "chosen_cases", lambda names, scenes: [matrix])
    chosen = {"chosen by its probes", "Hutch++", "Lanczos, both extremes"}
    monkeypatch.setattr(accuracy, "own_methods", lambda: (m for m in own_methods() if m.name in chosen))
    monkeypatch.setattr(accuracy, "peer_methods", lambda: (list(scipy_methods()), ["curvlinops is left out (why)"]))


def test_the_command_prints_writes_and_draws(small, tmp_path, capsys):
    assert accuracy.main(["--out", str(tmp_path), "--repetitions", "2"]) == 0
    runs = pd.read_csv(tmp_path / "accuracy.csv")
    assert list(runs.columns) == list(Run.__annotations__)
    assert set(runs["quantity"]) == {"traces", "ends", "diagonal", "precision"}
    shown = capsys.readouterr().out
    assert "curvlinops is left out (why)" in shown and "at equal true error" in shown and "asked for" in shown
    assert "what rounding adds" in shown and "float32 products, float64 sums" in shown
    for name in ("traces", "ends", "precision"):
        assert (tmp_path / f"accuracy_{name}.png").stat().st_size > 10_000
    assert not list(tmp_path.glob(".*"))


def test_a_study_of_one_quantity_and_one_case_leaves_the_others_out(tmp_path, monkeypatch):
    run = Run("", "", "", "", "", "", "", "", 0, 1.0, 1.0, 1.0, 1.0, 1.0)
    met: set[tuple[str, str]] = set()

    def note(case: Case, method: Method, seed: int) -> list[Run]:
        met.add((case.name, method.quantity))
        return [run]

    monkeypatch.setattr(accuracy, "measure", note)
    monkeypatch.setattr(accuracy, "report", lambda *_: None)
    words = ["--out", str(tmp_path), "--repetitions", "1", "--quantity", "ends", "--case", "flat"]
    assert accuracy.main(words) == 0 and met == {("flat", "ends")}
    with pytest.raises(ValueError, match=r"expected --case to be one of 'far from a fit', .*'flat', got 'round'"):
        accuracy.main(["--out", str(tmp_path), "--case", "round"])
    with pytest.raises(ValueError, match="at least 1 scene"):
        accuracy.main(["--out", str(tmp_path), "--scenes", "0"])


def test_scenes_of_a_kind_are_different_worlds():
    recipes = splat_cases(0, scenes=2)
    assert [name for name in recipes if name.startswith("far")] == ["far from a fit", "far from a fit #2"]
    one, other = (recipes[name].args for name in ("near a fit", "near a fit #2"))
    assert one[:3] == ("near a fit", 0.02, LossSettings()) and other[1:3] == one[1:3]
    assert one[3] != other[3] and one[4].seed != other[4].seed


def test_the_figure_shows_every_method_and_the_default():
    runs = table_of(d=("default", {"": (80.0, 1e-2)}), r=("peer", RIVAL))
    drawn = figure.draw(points(runs, {"c": 0.0}), "traces")
    FigureCanvasAgg(drawn).draw()
    (legend,) = drawn.legends
    assert {text.get_text() for text in legend.get_texts()} == {"r", "default"}
    lines = {line.get_label(): np.asarray(line.get_xydata()).tolist() for line in drawn.axes[0].lines}
    assert lines["r"] == [[10.0, 1e-1], [1000.0, 1e-3]] and lines["default"] == [[80.0, 1e-2]]
