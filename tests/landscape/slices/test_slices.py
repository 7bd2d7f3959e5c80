import numpy as np
import pytest
import torch

from landscape.operators.operator import DenseOperator
from landscape.slices.refinement import SliceSettings
from landscape.slices.slices import curvature_reach, evaluate_slice, symmetric_axis
from tests.oracles import symmetric_matrix
from tests.refusals import misused

N = 9
A = torch.from_numpy(symmetric_matrix(np.linspace(-1, 2, N), seed=0))
G = torch.linspace(-0.2, 0.3, N, dtype=torch.float64)
CENTER = torch.linspace(1, 2, N, dtype=torch.float64)
EIGENVALUES, EIGENVECTORS = torch.linalg.eigh(A)
AXES = [symmetric_axis(2.0, 5), symmetric_axis(0.5, 3)]
ALL = SliceSettings(tolerance=None)


def quadratic(theta):
    step = theta.double() - CENTER
    return 7 + G @ step + step @ A @ step / 2


def test_the_slice_of_a_quadratic_is_its_model(monkeypatch):
    monkeypatch.setattr("landscape.slices.grid_evaluations.PART", 4)  # parameters are moved in three parts
    directions = torch.stack([EIGENVECTORS[:, -1], EIGENVECTORS[:, 0] + EIGENVECTORS[:, 3]], dim=1)
    result = evaluate_slice(quadratic, CENTER, directions, AXES, gradient=G, operator=DenseOperator(A), settings=ALL)
    assert result.loss.shape == (5, 3) and result.center_loss == 7 and result.evaluations == 16
    assert result.evaluated.all() and result.reason == "exact" and result.interpolation_error == 0
    assert result.model is not None and (result.loss - result.model).abs().max() < 1e-13
    assert result.slope is not None and torch.allclose(result.slope, directions.T @ G, rtol=0, atol=1e-14)
    assert result.curvature is not None
    assert torch.allclose(result.curvature, directions.T @ A @ directions, rtol=0, atol=1e-14)


def test_the_model_is_the_same_from_the_matrix_of_the_directions():
    directions = torch.stack([EIGENVECTORS[:, -1], EIGENVECTORS[:, 0] + EIGENVECTORS[:, 3]], dim=1)
    by_operator, by_curvature = (
        evaluate_slice(quadratic, CENTER, directions, AXES, G, H, ALL)
        for H in (DenseOperator(A), directions.T @ A @ directions)
    )
    assert by_operator.model is not None and by_curvature.model is not None
    assert torch.allclose(by_operator.model, by_curvature.model, rtol=0, atol=1e-14)


def test_rows_follow_the_first_direction_and_columns_the_second():
    weights = torch.tensor([[1.0, 0.0], [0.0, 10.0]] + [[0.0, 0.0]] * 7, dtype=torch.float64)
    result = evaluate_slice(lambda theta: theta[:2].sum(), torch.zeros(N), weights, AXES, settings=ALL)
    expected = AXES[0][:, None] + 10 * AXES[1][None, :]
    assert torch.allclose(result.loss, expected, rtol=0, atol=1e-6)


def test_along_one_direction_it_is_a_curve():
    result = evaluate_slice(quadratic, CENTER, EIGENVECTORS[:, -1:], AXES[:1], torch.zeros(N), DenseOperator(A), ALL)
    slope = float(EIGENVECTORS[:, -1] @ G)
    expected = 7 + slope * AXES[0] + AXES[0].square()  # the largest eigenvalue is 2
    assert torch.allclose(result.loss, expected, rtol=0, atol=1e-13)
    assert result.model is not None and torch.allclose(result.model, 7 + AXES[0].square(), rtol=0, atol=1e-13)


def test_the_difference_is_what_the_quadratic_misses():
    result = evaluate_slice(
        lambda theta: (theta**3).sum() / 6,
        torch.ones(1, dtype=torch.float64),
        torch.ones(1, 1),
        [symmetric_axis(0.3, 7)],
        gradient=torch.tensor([0.5]),
        operator=DenseOperator(torch.ones(1, 1, dtype=torch.float64)),
        settings=ALL,
    )
    assert result.model is not None
    assert torch.allclose(result.loss - result.model, result.coordinates[0] ** 3 / 6, rtol=0, atol=1e-15)


def test_points_are_rounded_once_to_the_dtype_of_the_center():
    seen = []
    center, direction = CENTER.float(), EIGENVECTORS[:, :1].float()
    evaluate_slice(lambda theta: seen.append(theta) or 0.0, center, direction, AXES[:1], settings=ALL)
    direction = EIGENVECTORS[:, 0].float().double()
    assert torch.equal(seen[1], (CENTER.float().double() - 2.0 * direction).float())
    assert torch.equal(seen[0], CENTER.float()) and torch.equal(seen[3], CENTER.float())


def test_points_on_another_smooth_piece_than_the_centre_are_marked():
    def pieces(theta):
        return quadratic(theta), bool(theta[0] > 0.5)

    result = evaluate_slice(pieces, torch.zeros(N), torch.eye(N)[:, :2], AXES, settings=ALL)
    assert result.discontinuous is not None
    assert torch.equal(result.discontinuous, (AXES[0] > 0.5)[:, None].expand(5, 3))


def test_the_reach_is_where_the_quadratic_has_risen_by_the_given_amount():
    reach = curvature_reach(float(EIGENVALUES[-1]), rise=0.3)
    axes = [symmetric_axis(reach, 3)]
    result = evaluate_slice(quadratic, CENTER, EIGENVECTORS[:, -1:], axes, 0 * G, DenseOperator(A), ALL)
    assert result.model is not None and float(result.model[-1]) - 7 == pytest.approx(0.3, abs=1e-13)
    assert curvature_reach(-8.0, rise=1.0, multiple=3.0) == 1.5


def test_the_axis_holds_zero_itself():
    axis = symmetric_axis(0.1, 41)
    assert axis[20] == 0 and axis[0] == pytest.approx(-0.1) and torch.equal(axis, -axis.flip(0))


def test_progress_counts_the_points():
    seen = []
    directions = EIGENVECTORS[:, :2]
    evaluate_slice(quadratic, CENTER, directions, AXES, settings=ALL, progress=lambda *state: seen.append(state[:2]))
    assert seen == [(i, 15) for i in range(1, 16)]


def test_bad_slices_are_refused():
    misused("directions that are not zero", evaluate_slice, quadratic, CENTER, 0 * EIGENVECTORS[:, :2], AXES)
    misused("both gradient and operator", evaluate_slice, quadratic, CENTER, EIGENVECTORS[:, :2], AXES, gradient=G)
    misused("generator for the hold-out points", evaluate_slice, quadratic, CENTER, EIGENVECTORS[:, :2], AXES)
    with pytest.raises(ValueError, match="coordinates that increase"):
        evaluate_slice(quadratic, CENTER, EIGENVECTORS[:, :1], [torch.tensor([0.0, 1.0, 1.0])])
    with pytest.raises(ValueError, match="finite objective at the centre"):
        evaluate_slice(lambda theta: torch.inf, CENTER, EIGENVECTORS[:, :2], AXES, settings=ALL)
    misused("odd number of points", symmetric_axis, 1.0, 4)
    misused("radius above 0", symmetric_axis, 0.0)
    misused("curvature that is not zero", curvature_reach, 0.0, 1.0)
