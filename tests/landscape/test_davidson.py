"""Davidson's method: the pairs are those of the operator whatever its approximation says, and sooner found where that is
near."""

from dataclasses import replace

import pytest
import torch

from landscape.davidson import Davidson
from landscape.eigen import EigenSettings, extreme_eigenpairs
from landscape.operator import CountingOperator, DenseOperator
from tests.landscape.spectra import SPECTRA, Broken, N, Noisy, eigenvalues, generator, operator
from tests.oracles import symmetric_matrix


class Diagonal:
    """D of given eigenvalues, along the axes."""

    def __init__(self, values):
        self.values = values

    def function(self, f, V):
        return f(self.values).to(V)[:, None] * V


def scene_like(seed=0, coupling=0.1, n=400):
    """A dense small end far below the large one, as a scene has it, and every fiftieth pair of axes coupled."""
    source = generator(seed)
    values = torch.logspace(-4, 2, n, dtype=torch.float64)
    values[:3] = torch.tensor([-0.03, -0.02, -0.01])
    width = (values.abs() + 1e-3).sqrt()
    coupled = torch.randn(n, n, generator=source, dtype=torch.float64) * (torch.rand(n, n, generator=source) < 0.02)
    return DenseOperator(torch.diag(values) + coupling * width[:, None] * (coupled + coupled.T) * width)


def steepest(H, largest, smallest):
    diagonal = H.matrix.diagonal()
    chosen = torch.cat([diagonal.topk(largest).indices, diagonal.topk(smallest, largest=False).indices])
    return torch.eye(H.dim, dtype=torch.float64)[:, chosen]


def solve(H, settings, approximation=None, start=None, seed=0, progress=None):
    approximation = Diagonal(H.matrix.diagonal()) if approximation is None else approximation
    return extreme_eigenpairs(H, generator(seed), settings, start, progress, approximation)


SETTINGS = {
    "one pair": EigenSettings(rtol=1e-3),
    "with restarts": EigenSettings(2, 2, rtol=1e-6, basis=28, max_matvecs=4000),
    "whole basis": EigenSettings(2, 3, rtol=1e-8, basis=1000),
    "one end": EigenSettings(0, 2, rtol=1e-5),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("case", SETTINGS)
@pytest.mark.parametrize("name", SPECTRA)
def test_whatever_the_approximation_the_ends_are_the_ends_and_residuals_those_of_the_vectors(name, case, dtype):
    """In a random basis the diagonal says nothing of the spectrum."""
    H, settings = operator(name, dtype), SETTINGS[case]
    true, unit = eigenvalues(H), torch.finfo(dtype).eps
    rounding = 10 * unit * float(true.abs().max())
    ends = solve(H, settings)
    for pairs, outside in ((ends.largest, true[-1]), (ends.smallest, true[0])):
        if not len(pairs):
            continue
        V = pairs.vectors.double()
        residuals = (H.matrix.double() @ V - pairs.values * V).norm(dim=0)
        assert (residuals <= pairs.residuals + rounding).all()
        assert (pairs.residuals <= residuals + settings.rtol * pairs.values.abs() + rounding).all()
        assert (V.T @ V - torch.eye(len(pairs))).abs().max() < N * unit
        asked = max(float(pairs.residuals[0]), settings.rtol * abs(float(pairs.values[0])))
        assert abs(pairs.values[0] - outside) <= asked + rounding
    assert ends.ritz is not None
    values, residuals = ends.ritz
    assert ((values[:, None] - true).abs().min(dim=1).values <= residuals + 10 * rounding).all()


@pytest.mark.parametrize("rtol", [1e-1, 1e-3, 1e-6])
def test_where_the_approximation_is_near_it_needs_half_the_products_of_a_recurrence_from_the_same_start(rtol):
    H, settings = scene_like(), EigenSettings(2, 1, rtol=rtol)
    true, start = eigenvalues(H), steepest(H, 2, 1)
    recurrence, ends = extreme_eigenpairs(H, generator(), settings, start), solve(H, settings, start=start)
    assert ends.matvecs <= recurrence.matvecs / 2
    assert torch.allclose(ends.largest.values, true.flip(0)[:2], rtol=rtol, atol=0)
    assert torch.allclose(ends.smallest.values, true[:1], rtol=rtol, atol=0)
    assert ends.method == "davidson" and recurrence.method == "lanczos"


@pytest.mark.parametrize("side", [1, -1])
def test_a_correction_is_the_error_of_the_vector_to_first_order(side):
    """The axis of the end is off by t (at the lower end -t), but for the square of the coupling."""
    errors, n = [], 30
    coupled = torch.from_numpy(symmetric_matrix(torch.linspace(-1, 1, n).numpy(), seed=0))
    diagonal = torch.cat([torch.linspace(-1, 1, n - 1), torch.tensor([2.0])]).double()
    axis = torch.eye(n, dtype=torch.float64)[:, -1]
    for coupling in (1e-2, 1e-3):
        H = DenseOperator(side * (torch.diag(diagonal) + coupling * coupled))
        exact = torch.linalg.eigh(H.matrix).eigenvectors[:, -1 if side > 0 else 0]
        error = exact / exact[-1] - axis
        approximation = Diagonal(H.matrix.diagonal())
        space = Davidson(H, generator(), EigenSettings(int(side > 0), int(side < 0)), approximation, axis)
        space.expand(False)
        ritz, value = space.ritz(), float(H.matrix[-1, -1])
        space.vectors, space.residuals = axis[None], (H.matrix[:, -1] - value * axis)[None]
        t = space._correction(replace(ritz, values=torch.full_like(ritz.values, value)), ritz.wanted[0], 0)
        assert abs(float(t @ axis)) < 1e-12 and abs(float(t.norm()) - 1) < 1e-12
        errors.append(float((side * t - error / error.norm()).norm()))
    assert errors[0] < 0.05 and errors[1] < 0.15 * errors[0]


def test_where_couplings_make_the_ends_guards_and_chain_find_them_more_often_than_a_recurrence_does():
    """A run is wrong where a value is off by 1.5 times what was asked for."""
    wrong, n = {"davidson": 0, "lanczos": 0}, 300
    for seed in range(100):
        source = generator(seed)
        values = 0.1 * torch.randn(n, generator=source, dtype=torch.float64) ** 3
        width = (values.abs() + 0.02).sqrt()
        coupled = torch.randn(n, n, generator=source, dtype=torch.float64)
        coupled *= torch.rand(n, n, generator=source, dtype=torch.float64) < 0.02
        H = DenseOperator(torch.diag(values) + 0.35 * width[:, None] * (coupled + coupled.T) * width)
        true, settings = eigenvalues(H), EigenSettings(2, 1, rtol=1e-2)
        for ends in (
            solve(H, settings, start=steepest(H, 4, 3), seed=seed),
            extreme_eigenpairs(H, generator(seed), settings, steepest(H, 2, 1)),
        ):
            found = torch.cat([ends.largest.values, ends.smallest.values])
            expected = torch.cat([true.flip(0)[:2], true[:1]])
            wrong[ends.method] += bool(((found - expected).abs() > 1.5 * settings.rtol * expected.abs()).any())
    assert wrong["davidson"] <= 1 < wrong["lanczos"]


@pytest.mark.parametrize("said", ["nothing", "the ends exchanged", "a hundred times too much"])
def test_over_many_seeds_a_misleading_approximation_costs_products_and_hides_no_end(said):
    H = scene_like(n=100)
    true, diagonal = eigenvalues(H), H.matrix.diagonal()
    wrong = {
        "nothing": 0 * diagonal,
        "the ends exchanged": diagonal.flip(0),
        "a hundred times too much": 100 * diagonal,
    }
    for seed in range(3):
        ends = solve(H, EigenSettings(rtol=1e-3), Diagonal(wrong[said]), torch.eye(100).double()[:, [50, 33]], seed)
        for pairs, end in ((ends.largest, true[-1]), (ends.smallest, true[0])):
            assert float(pairs.values[0]) == pytest.approx(float(end), rel=1e-2)
            assert abs(float(pairs.values[0] - end)) <= float(pairs.residuals[0])
        # led the wrong way at every step it gets to 1e-3 within its thousand products at the upper end alone
        assert ends.largest.reason == "tolerance"
        assert ends.smallest.reason == ("matvec budget" if said == "the ends exchanged" else "tolerance")


@pytest.mark.parametrize("start", ["the axes that look like the ends", "inner eigenvectors"])
def test_an_end_that_only_a_coupling_makes_is_found_beside_pairs_that_are_exact_at_once(start):
    n = 200
    matrix = torch.diag(torch.linspace(-0.1, 0.1, n, dtype=torch.float64))
    matrix[0, 0], matrix[n - 1, n - 1], matrix[50, 50], matrix[60, 60] = -0.5, 0.5, 0.0, 0.0
    matrix[50, 60] = matrix[60, 50] = 0.6
    given = torch.eye(n, dtype=torch.float64)[:, [n - 1, 0] if start != "inner eigenvectors" else [100, 101]]
    for seed in range(20):
        ends = solve(DenseOperator(matrix), EigenSettings(rtol=1e-2), start=given, seed=seed)
        assert float(ends.largest.values[0]) == pytest.approx(0.6, rel=1e-2)
        assert float(ends.smallest.values[0]) == pytest.approx(-0.6, rel=1e-2)


def test_restarts_keep_the_memory():
    H = operator("indefinite")
    settings = EigenSettings(2, 1, rtol=1e-8, basis=24, max_matvecs=4000)
    space = Davidson(H, generator(), settings, Diagonal(H.matrix.diagonal()), None)
    assert space.basis.shape == space.images.shape and space.basis.shape[0] <= 12 + 6
    ends = solve(H, settings)
    assert ends.largest.reason == ends.smallest.reason == "tolerance" and ends.matvecs > 5 * 24


def test_a_memory_without_room_for_the_products_is_a_recurrences():
    H = operator("indefinite")
    for basis, method in ((23, "lanczos"), (24, "davidson")):
        ends = solve(H, EigenSettings(2, 1, rtol=1e-2, basis=basis, max_matvecs=4000))
        assert ends.method == method and ends.largest.reason == "tolerance"


def test_noise_ends_the_run_where_more_work_would_not_help():
    H = operator("indefinite")
    ends = solve(Noisy(H.matrix, 1e-6), EigenSettings(rtol=1e-9))
    exact = solve(H, EigenSettings(rtol=1e-6))
    assert ends.matvecs <= exact.matvecs + 10
    for pairs in (ends.largest, ends.smallest):
        assert pairs.reason == "noise floor" and 0.2e-6 < float(pairs.residuals[0]) < 5e-6


def test_a_budget_is_kept_and_said():
    H = CountingOperator(operator("indefinite"))
    diagonal = Diagonal(operator("indefinite").matrix.diagonal())
    start = torch.eye(N, dtype=torch.float64)[:, :30]
    for most in (7, 20):
        H.matvecs = 0
        settings = EigenSettings(rtol=1e-10, max_matvecs=most)
        ends = extreme_eigenpairs(H, generator(), settings, start, None, diagonal)
        assert H.matvecs == ends.matvecs <= most and ends.largest.reason == "matvec budget"
        assert ends.beyond == float("inf")
    late = solve(operator("indefinite"), EigenSettings(rtol=1e-10, max_seconds=0.0))
    assert late.smallest.reason == "time budget"


def test_small_operators_repeated_starts_and_a_whole_space_are_solved_exactly():
    one = solve(DenseOperator(torch.tensor([[-3.0]])), EigenSettings(1, 0))
    assert one.largest.values.tolist() == [-3.0] and one.largest.residuals.tolist() == [0.0] and one.beyond == 0
    two = solve(DenseOperator(torch.tensor([[0.0, 2.0], [2.0, 0.0]]).double()), EigenSettings())
    assert two.largest.values.tolist() == pytest.approx([2.0]) and two.smallest.values.tolist() == pytest.approx([-2.0])
    H = operator("multiple")
    again = torch.ones(N, 3, dtype=torch.float64)
    ends = solve(H, EigenSettings(3, 2, rtol=1e-8), start=again)
    assert ends.largest.values.tolist() == pytest.approx([2.0] * 3) and ends.smallest.values.tolist() == pytest.approx(
        [-1.0] * 2
    )


def test_the_same_seed_gives_the_same_pairs_bit_for_bit_and_progress_counts():
    seen = []
    H, settings = operator("clustered"), SETTINGS["with restarts"]
    runs = [solve(H, settings, seed=3, progress=lambda *state: seen.append(state)) for _ in range(2)]
    assert torch.equal(runs[0].largest.vectors, runs[1].largest.vectors)
    assert torch.equal(runs[0].smallest.values, runs[1].smallest.values)
    assert seen[-1][0] <= runs[1].matvecs and seen[0][1] == 4000 and "largest" in seen[-1][2]


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="finite products"):
        solve(Broken(torch.eye(5)), EigenSettings())
    with pytest.raises(ValueError, match="start vectors that are not zero"):
        solve(operator("zero"), EigenSettings(), start=torch.zeros(N, 2))
