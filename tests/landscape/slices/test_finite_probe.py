import numpy as np
import pytest
import torch

from landscape.operators.operator import DenseOperator
from landscape.slices.finite_probe import NOISE_POINTS, ORDER, STEPS, evaluation_noise, finite_probe
from landscape.slices.grid_evaluations import Control
from tests.oracles import symmetric_matrix
from tests.refusals import misused

N = 5
A = torch.from_numpy(symmetric_matrix(np.linspace(-1, 3, N), seed=0))
CENTER = torch.linspace(1, 2, N, dtype=torch.float64)
V = torch.linspace(-1, 0.5, N, dtype=torch.float64)
QUARTIC = 0.7


def quartic(theta):
    """Curvature A at CENTER, and a fourth derivative of 24 * QUARTIC along V / |V|^2."""
    step = theta.double() - CENTER
    return 2 + step @ A @ step / 2 + QUARTIC * float(step @ V / (V @ V)) ** 4


def probed(loss, center=CENTER, steps=STEPS, **more):
    return finite_probe(loss, center, V.to(center.dtype), DenseOperator(A), steps, **more)


def test_a_finite_step_sees_the_fourth_derivative():
    found = probed(quartic)
    exact = float(V @ A @ V)
    assert found.infinitesimal == pytest.approx(exact, rel=1e-14)
    # c(d) = v.Av + 2 QUARTIC d^2, a step of d V being one of d along V / |V|^2
    expected = exact + 2 * QUARTIC * found.steps.square()
    assert ((found.curvatures - expected).abs() <= found.round_off).all()
    assert found.discontinuous is None and found.evaluations == 2 * len(STEPS) + 1 + NOISE_POINTS


@pytest.mark.parametrize("sigma", [1e-9, 1e-6])
def test_noise_is_measured_and_bounds_the_round_off(sigma):
    random = np.random.default_rng(0)
    found = probed(lambda theta: float(quartic(theta)) + sigma * random.standard_normal())
    # 20 differences, as good as 8 independent ones: within a factor of 3 in all but one of 1,000 cases
    assert sigma / 3 < found.noise < 3 * sigma
    expected = float(V @ A @ V) + 2 * QUARTIC * found.steps.square()
    # the bound is four standard errors for the true noise
    assert ((found.curvatures - expected).abs() <= found.round_off * sigma / min(found.noise, sigma)).all()
    assert torch.allclose(found.round_off * found.steps.square(), torch.tensor(4 * 6**0.5 * found.noise).double())


ONE, STEP = torch.ones(1, dtype=torch.float64), 2.0**-7
DOUBLING = [0.7 * STEP * 2.0**k for k in range(-5, 6)]


def judged(loss, curvature=2.0, least=STEP / 10, steps=DOUBLING):
    return finite_probe(
        lambda x: loss(float(x - 1)), ONE, ONE, DenseOperator(curvature * ONE[None]), steps
    ).confirmation(least)


def test_doubling_steps_confirm_a_curvature_that_they_have():
    assert judged(lambda t: 1 + t**2) == (True, (DOUBLING[0], DOUBLING[-1]))
    assert judged(lambda t: 1 - t**2, -2.0)[0] is True
    # the fourth power makes c(d) more than twice the curvature from a step on, where it is refuted
    quartic = lambda t: 1 + t**2 + 1.1 * t**4 / DOUBLING[6] ** 2  # noqa: E731
    assert judged(quartic) == (True, (DOUBLING[0], DOUBLING[5]))
    assert judged(quartic, least=DOUBLING[6]) == (False, None)


@pytest.mark.parametrize("curvature", [2.0, -2.0, 3 / DOUBLING[5], 300.0])
def test_a_kink_confirms_no_curvature(curvature):
    assert judged(abs, curvature) == (False, None)
    assert judged(lambda t: 1 + abs(t) - t**2, -2.0)[0] is False  # a rise along what is curved down


def test_what_round_off_hides_is_neither_confirmed_nor_refuted():
    random = np.random.default_rng(0)
    for curvature in (2.0, -2.0):
        assert judged(lambda t: 1 + t**2 + 0.1 * random.standard_normal(), curvature) == (None, None)


@pytest.mark.parametrize("shortest", [0, 3, 5])
def test_what_a_resolved_step_refutes_is_not_confirmed_however_many_shorter_ones_round_off_hides(shortest):
    random, noise = np.random.default_rng(0), DOUBLING[5] ** 2 / 10
    assert judged(lambda t: 1 + t**2 + noise * random.standard_normal(), -2.0, steps=DOUBLING[shortest:]) == (
        False,
        None,
    )


def test_round_off_beside_steps_that_confirm_leaves_a_curvature_open():
    # without noise the first four steps confirm it; noise hides the first two
    quartic = lambda t: 1 + t**2 + 1.1 * t**4 / DOUBLING[4] ** 2  # noqa: E731
    assert judged(quartic) == (True, (DOUBLING[0], DOUBLING[3]))
    random, noise = np.random.default_rng(0), DOUBLING[2] ** 2 / 12
    noisy = lambda t: quartic(t) + noise * random.standard_normal()  # noqa: E731
    assert judged(noisy) == (None, None)
    assert judged(noisy, least=DOUBLING[6]) == (False, None)


def test_the_measured_noise_is_unbiased():
    values = np.random.default_rng(1).standard_normal((2000, NOISE_POINTS)) + 3 * np.arange(NOISE_POINTS) ** 3
    squares = np.array([evaluation_noise(row) ** 2 for row in values])
    assert abs(squares.mean() - 1) < 4 * squares.std() / len(squares) ** 0.5


def test_with_a_control_a_few_evaluations_tell_the_rest():
    def rough(theta):
        return float(theta.square().sum() + 0.3 * theta.abs().sum() + 1e-9 * torch.sin(1e9 * theta).sum())

    def whole(theta):
        return rough(theta) + 0.01 * float((theta**4).sum())

    steps, center = [0.01 * 2**k for k in range(11)], torch.zeros(2, dtype=torch.float64)
    v, controls = torch.tensor([0.0, 1.0], dtype=torch.float64), (None, Control(rough, torch.tensor([1])))
    H = DenseOperator(2 * torch.eye(2, dtype=torch.float64))
    alone, found = (finite_probe(whole, center, v, H, steps, control=each) for each in controls)
    off = (found.curvatures - alone.curvatures).abs()
    assert found.evaluations == 1 + 2 * 4 < alone.evaluations / 4 and found.center_loss == alone.center_loss
    assert (off[[4, 6, 8, 10]] < 1e-9).all() and off[9] > 0.01 and (off <= found.round_off).all()


def test_noise_is_at_least_the_resolution_of_what_the_objective_returns():
    found = probed(lambda theta: torch.tensor(3.0))
    assert found.noise == 3 * torch.finfo(torch.float32).eps and not found.curvatures.any()
    assert probed(lambda theta: 3.0).noise == 3 * torch.finfo(torch.float64).eps


def test_the_round_off_of_float32_parameters_is_within_its_bound():
    found = probed(quartic, center=CENTER.float())
    v, center = V.float().double(), CENTER.float().double()
    shift = float((center - CENTER) @ V / (V @ V))
    exact = float(v @ A @ v) + 2 * QUARTIC * (found.steps.square() + 6 * shift**2)
    error = (found.curvatures - exact).abs()
    assert (error <= found.round_off).all()
    # the rounding of theta + d v is what is left: without it the bound would not hold
    assert (error > 4 * 6**0.5 * found.noise / found.steps.square()).any()


def test_across_a_kink_the_probe_sees_two_slopes_and_marks_them():
    def kinked(theta):
        along = float((theta - CENTER) @ V / (V @ V))
        return 1 + abs(along - 0.01), along > 0.01

    found = probed(kinked, steps=(0.001, 0.1, 1.0))
    assert found.discontinuous is not None and found.discontinuous.tolist() == [False, True, True]
    # |d - a| + |d + a| - 2 a = 2 (d - a) for d > a
    assert found.curvatures[1:].tolist() == pytest.approx([2 * 0.09 / 0.01, 2 * 0.99], rel=1e-10)
    assert abs(float(found.curvatures[0])) <= float(found.round_off[0])


def test_the_record_is_plain_and_what_is_not_finite_is_none():
    def wall(theta):
        return float("inf") if float((theta - CENTER) @ V / (V @ V)) > 0.5 else quartic(theta)

    record = probed(wall, steps=(0.01, 0.1, 1.0)).record()
    assert record["steps"] == [0.01, 0.1, 1.0] and record["crossed"] is None
    assert isinstance(record["curvatures"], list) and record["curvatures"][2] is None


def test_progress_counts_the_evaluations():
    seen = []
    found = probed(quartic, steps=(0.1, 1.0), progress=lambda *state: seen.append(state[:2]))
    assert seen == [(i + 1, found.evaluations) for i in range(found.evaluations)]


def test_bad_probes_are_refused():
    misused("directions that are not zero", finite_probe, quartic, CENTER, 0 * V, DenseOperator(A))
    for steps in ((1.0,), (0.0, 1.0), (1.0, 0.5)):
        misused("positive steps that increase", probed, quartic, steps=steps)
    misused("finite objective at the centre", probed, lambda theta: float("nan"))
    with pytest.raises(ValueError, match=f"more than {ORDER} values, got {ORDER}"):
        finite_probe(quartic, CENTER, V, DenseOperator(A), noise_points=ORDER)


@pytest.mark.parametrize("rounded", [float, np.float32, lambda value: value.item()], ids=["float", "numpy", "item"])
def test_values_that_were_float32_before_bound_the_round_off_as_such(rounded):
    found = probed(lambda theta: rounded(quartic(theta).float()))
    assert found.noise >= torch.finfo(torch.float32).eps * found.center_loss
    expected = float(V @ A @ V) + 2 * QUARTIC * found.steps.square()
    assert ((found.curvatures - expected).abs() <= found.round_off).all()
