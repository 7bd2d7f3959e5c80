from dataclasses import replace
from functools import cache
from math import log, nan, sqrt

import pytest
import torch

from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.operators.operator import CountingOperator, DenseOperator
from tests.landscape.spectra import SPECTRA, Broken, N, Noisy, eigenvalues, generator, operator
from tests.refusals import misused

SETTINGS = {
    "one pair": EigenSettings(rtol=1e-3),
    "with restarts": EigenSettings(2, 2, rtol=1e-6, basis=16),
    "blocks": EigenSettings(3, 1, rtol=1e-5, basis=24, block=3),
    "whole basis": EigenSettings(2, 3, rtol=1e-8, basis=1000),
}


@cache
def solved(name, case, dtype):
    H = operator(name, dtype)
    return H, extreme_eigenpairs(H, generator(), SETTINGS[case])


class Diagonal:
    """An operator of more rows than a matrix may have."""

    def __init__(self, values):
        self.values, self.dim, self.dtype, self.blocks = (
            values,
            len(values),
            values.dtype,
            {"all": slice(0, len(values))},
        )

    def apply(self, V):
        return self.values[:, None] * V


def both(ends):
    return (ends.largest, ends.smallest)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("case", SETTINGS)
@pytest.mark.parametrize("name", SPECTRA)
def test_residuals_are_of_orthonormal_vectors_and_reach_a_true_eigenvalue_and_ends_are_ends(name, case, dtype):
    H, ends = solved(name, case, dtype)
    true, unit = eigenvalues(H), torch.finfo(dtype).eps
    # the residual itself is measured with a rounded product
    rounding = 4 * unit * float(true.abs().max())
    for pairs in both(ends):
        nearest = (pairs.values[:, None] - true).abs().min(dim=1).values
        assert (nearest <= pairs.residuals + rounding).all()
        V = pairs.vectors.double()
        residuals = (H.matrix.double() @ V - pairs.values * V).norm(dim=0)
        assert ((residuals - pairs.residuals).abs() <= 10 * unit * float(H.matrix.norm())).all()
        assert (V.T @ V - torch.eye(len(pairs))).abs().max() < N * unit
        assert (V.amax(dim=0) == V.abs().amax(dim=0)).all()  # the sign is that of the largest entry
        if pairs.reason == "tolerance":
            assert (pairs.residuals <= SETTINGS[case].rtol * pairs.values.abs()).all()
    # in a cluster closer than the tolerance the outermost eigenvalue may lie outside the residual, not the tolerance
    for pairs, outside in ((ends.largest, true[-1]), (ends.smallest, true[0])):
        asked = max(float(pairs.residuals[0]), SETTINGS[case].rtol * abs(float(pairs.values[0])))
        assert abs(pairs.values[0] - outside) <= asked + rounding


@pytest.mark.parametrize("case", SETTINGS)
def test_every_ritz_value_is_within_its_residual_and_ends_are_among_them(case):
    H, ends = solved(next(iter(SPECTRA)), case, torch.float64)
    true = eigenvalues(H)
    assert ends.ritz is not None
    values, residuals = ends.ritz
    rounding = 100 * torch.finfo(torch.float64).eps * float(true.abs().max())
    assert ((values[:, None] - true).abs().min(dim=1).values <= residuals + rounding).all()
    assert abs(values[-1] - ends.largest.values[0]) <= rounding and abs(values[0] - ends.smallest.values[0]) <= rounding


@pytest.mark.parametrize("name", ["power law", "indefinite", "both tails", "clustered", "negative", "multiple"])
def test_to_a_tight_tolerance_the_pairs_are_the_outermost_ones_in_order(name):
    H = operator(name)
    true = eigenvalues(H)
    ends = extreme_eigenpairs(H, generator(), EigenSettings(3, 3, rtol=1e-10, basis=40, max_matvecs=5000))
    assert torch.allclose(ends.largest.values, true.flip(0)[:3], rtol=0, atol=1e-9)
    assert torch.allclose(ends.smallest.values, true[:3], rtol=0, atol=1e-9)


def test_restarts_are_exercised_and_the_memory_is_kept():
    seen = []

    class Watched(DenseOperator):
        def apply(self, V):
            seen.append(V.shape[1])
            return super().apply(V)

    H = Watched(operator("indefinite").matrix)
    ends = extreme_eigenpairs(H, generator(), EigenSettings(rtol=1e-8, basis=12))
    assert ends.largest.reason == ends.smallest.reason == "tolerance"
    assert ends.matvecs == sum(seen) >= 5 * 12


def test_one_end_alone_may_be_asked_for():
    true = eigenvalues(operator("both tails"))
    ends = extreme_eigenpairs(operator("both tails"), generator(), EigenSettings(0, 2, rtol=1e-8))
    assert len(ends.largest) == 0 and ends.largest.reason == "not asked for"
    assert torch.allclose(ends.smallest.values, true[:2], rtol=0, atol=1e-8)


def test_eigenvectors_errors_are_bounded_by_residual_over_gap():
    H = operator("both tails")
    _, vectors = torch.linalg.eigh(H.matrix)
    pairs = extreme_eigenpairs(H, generator(), EigenSettings(rtol=1e-3)).largest
    sine = (pairs.vectors[:, 0] - vectors[:, -1] * (vectors[:, -1] @ pairs.vectors[:, 0])).norm()
    # the gap is to an approximate neighbour, which is a little off: its own error counts
    assert 0 < float(sine) <= 1.1 * float(pairs.vector_errors[0])


def test_float32_stops_at_its_noise_floor_and_says_so():
    H = operator("indefinite", torch.float32)
    ends = extreme_eigenpairs(H, generator(), EigenSettings(rtol=1e-12, max_matvecs=2000))
    for pairs in both(ends):
        assert pairs.reason == "noise floor"
        assert float(pairs.residuals[0]) < 20 * torch.finfo(torch.float32).eps * abs(float(pairs.values[0]))
    assert ends.matvecs < 2 * N


def test_the_noise_of_a_product_ends_the_run_where_work_would_not_help():
    ends = extreme_eigenpairs(Noisy(operator("indefinite").matrix, 1e-6), generator(), EigenSettings(rtol=1e-9))
    # to 1e-6 it takes as many steps without the noise; here one vector more measures it, and both pairs their residuals
    exact = extreme_eigenpairs(operator("indefinite"), generator(), EigenSettings(rtol=1e-6))
    assert ends.matvecs <= exact.matvecs + 3
    for pairs in both(ends):
        assert pairs.reason == "noise floor"
        assert 0.2e-6 < float(pairs.residuals[0]) < 5e-6
    # the product's own and the recurrence's, in the mean square of both ends
    assert ends.noise == pytest.approx(2**0.5 * 1e-6, rel=4 / (2 * N) ** 0.5)


def test_noise_along_the_end_vectors_alone_is_measured_at_once():
    """In proportion to the product: small on the random start, large where the run is going."""
    source, n = generator(1), 20_000

    class Noisy(Diagonal):
        def apply(self, V):
            exact = super().apply(V)
            return exact + 1e-4 * exact.norm(dim=0) / n**0.5 * torch.randn(V.shape, generator=source, dtype=V.dtype)

    steps = []
    settings = EigenSettings(1, 0, rtol=1e-5)
    ends = extreme_eigenpairs(
        Noisy(1 / torch.arange(1, n + 1).double()), generator(1), settings, progress=lambda *state: steps.append(state)
    )
    assert ends.largest.reason == "noise floor" and 1e-4 < ends.noise < 2e-4
    # the steps, the noise of a vector on the way, one product for all pairs and one of the pair's own
    assert ends.matvecs == len(steps) + 3


@pytest.mark.parametrize("rtol", [1e-3, 1e-12])
def test_no_product_beyond_the_steps_is_spent_where_noise_does_not_matter(rtol):
    H, steps = CountingOperator(operator("indefinite")), []
    ends = extreme_eigenpairs(
        H, generator(), EigenSettings(2, 2, rtol=rtol, basis=N), progress=lambda *state: steps.append(state)
    )
    assert {pairs.reason for pairs in both(ends)} == {"tolerance"}
    unseen = 3  # steps before there are as many Ritz values as pairs
    assert H.matvecs == ends.matvecs == unseen + len(steps)


@pytest.mark.parametrize("basis", [64, 12])
def test_the_noise_of_a_product_follows_from_the_asymmetry_of_components(basis):
    source, noise, steps = generator(1), 1e-6, []

    class Noisy(DenseOperator):
        def apply(self, V):
            return super().apply(V) + noise / N**0.5 * torch.randn(V.shape, generator=source, dtype=V.dtype)

    H = Noisy(operator("indefinite").matrix)
    ends = extreme_eigenpairs(H, generator(), EigenSettings(basis=basis), None, lambda *s: steps.append(s))
    assert ends.matvecs == 1 + len(steps)  # after the first there is no pair yet
    pairs = ends.matvecs * (ends.matvecs - 1) / 2 if basis == 64 else ends.matvecs * basis * 0.6
    assert ends.noise == pytest.approx(noise, rel=4 / (2 * pairs) ** 0.5)
    for found in both(ends):
        assert found.reason == "tolerance" and float(found.residuals[0]) > 4 * ends.noise


def test_of_long_float32_vectors_one_product_measures_the_residuals():
    n, steps = 100_000, []
    diagonal = torch.where(torch.arange(n) % 3 > 0, 1.0, -0.1) / torch.arange(1, n + 1) ** 0.7
    ends = extreme_eigenpairs(Diagonal(diagonal), generator(), progress=lambda *state: steps.append(state))
    assert ends.matvecs == 1 + len(steps) + 2  # and one for the noise on the way, as the lower end's goal is near it
    for pairs, end in ((ends.largest, diagonal.max()), (ends.smallest, diagonal.min())):
        v = pairs.vectors[:, 0].double()
        residual = float((diagonal.double() * v - pairs.values[0] * v).norm())
        # each pair's estimate has the noise of both
        assert pairs.reason == "tolerance" and residual <= float(pairs.residuals[0]) + 2 * ends.noise
        assert abs(float(pairs.values[0]) - float(end)) <= residual


def test_a_budget_is_kept_and_said():
    H = CountingOperator(operator("indefinite"))
    ends = extreme_eigenpairs(H, generator(), EigenSettings(rtol=1e-10, max_matvecs=20))
    assert H.matvecs == ends.matvecs <= 20
    assert ends.largest.reason == "matvec budget"


def test_one_end_may_be_converged_where_the_other_is_not():
    ends = extreme_eigenpairs(operator("power law"), generator(), EigenSettings(rtol=1e-6, max_matvecs=25))
    assert (ends.largest.reason, ends.smallest.reason) == ("tolerance", "matvec budget")


def test_a_warm_start_needs_fewer_products():
    H = operator("indefinite")
    cold = extreme_eigenpairs(H, generator(), EigenSettings(rtol=1e-6))
    nearby = DenseOperator(H.matrix + 1e-4 * operator("both tails").matrix)
    start = torch.cat([cold.largest.vectors, cold.smallest.vectors], dim=1)
    warm = extreme_eigenpairs(nearby, generator(), EigenSettings(rtol=1e-6), start=start)
    again = extreme_eigenpairs(nearby, generator(), EigenSettings(rtol=1e-6))
    assert warm.matvecs < again.matvecs
    assert torch.allclose(warm.largest.values, again.largest.values, rtol=1e-6, atol=0)


def test_a_shorter_random_part_of_a_good_start_needs_fewer_products():
    H = operator("indefinite")
    found = extreme_eigenpairs(H, generator(), EigenSettings(rtol=1e-6))
    start = torch.cat([found.largest.vectors, found.smallest.vectors], dim=1)
    runs = [extreme_eigenpairs(H, generator(), EigenSettings(noise=noise), start) for noise in (1.0, 1e-1, 1e-3)]
    assert runs[0].matvecs > runs[1].matvecs > runs[2].matvecs
    misused("noise > 0", EigenSettings, noise=0.0)


@pytest.mark.parametrize("spectrum", ["gaps", "cluster", "dense"])
def test_over_many_seeds_the_reported_ends_are_the_ends(spectrum):
    """At the default tolerance, which a dense end may be missed by a little more than."""
    n = 60
    diagonal = torch.linspace(-0.2, 0.3, n, dtype=torch.float64)
    if spectrum == "gaps":
        diagonal[-2:] = torch.tensor([1.0, 1.01])
    if spectrum == "cluster":
        diagonal[-6:] = 1 + 0.002 * torch.arange(6)
    H, top, bottom = DenseOperator(torch.diag(diagonal)), float(diagonal.max()), float(diagonal.min())
    for seed in range(15):
        ends = extreme_eigenpairs(H, generator(seed))
        for pairs, end in ((ends.largest, top), (ends.smallest, bottom)):
            assert pairs.reason == "tolerance"
            assert abs(float(pairs.values[0]) - end) <= max(float(pairs.residuals[0]), 2e-3 * abs(end))


def test_a_warm_start_at_inner_eigenvectors_still_finds_the_ends():
    H = operator("indefinite")
    true, vectors = torch.linalg.eigh(H.matrix)
    ends = extreme_eigenpairs(H, generator(), EigenSettings(rtol=1e-6), start=vectors[:, [50, 60]])
    assert float(ends.largest.values) == pytest.approx(float(true[-1]), rel=1e-6)
    assert float(ends.smallest.values) == pytest.approx(float(true[0]), rel=1e-6)


@pytest.mark.parametrize("warm", [False, True], ids=["random", "inner vectors"])
def test_no_eigenvalue_lies_beyond_the_stated_bound(warm):
    H = operator("negative")
    true, vectors = torch.linalg.eigh(H.matrix)
    start = vectors[:, len(true) // 2][:, None] if warm else None  # the start of all that says least of both ends
    for seed in range(20):
        ends = extreme_eigenpairs(H, generator(seed), EigenSettings(rtol=1e-12, max_matvecs=25), start=start)
        missed = max(float(true[-1] - ends.largest.values[0]), float(ends.smallest.values[0] - true[0]))
        assert 0 < missed <= ends.beyond < 0.5  # the spectrum is 1 wide


def test_the_bound_of_a_start_that_is_mostly_given_is_the_wider_one():
    H = operator("negative")
    settings = EigenSettings(rtol=1e-12, max_matvecs=25)
    cold, warm = (extreme_eigenpairs(H, generator(), settings, start) for start in (None, torch.eye(H.dim)[:, :1]))
    n, m = H.dim, warm.matvecs - 2  # of which the two last measure the residuals
    share = (log(2 * 1.648 * sqrt(n) / (0.01 / 2)) / (2 * m - 1)) ** 2
    width = float(warm.largest.values[0] - warm.smallest.values[0])
    assert warm.beyond == pytest.approx(share / (1 - 2 * share) * width, rel=1e-3)
    assert warm.beyond > cold.beyond


def test_the_same_seed_gives_the_same_pairs_bit_for_bit():
    runs = [extreme_eigenpairs(operator("clustered"), generator(3), SETTINGS["blocks"]) for _ in range(2)]
    assert torch.equal(runs[0].largest.vectors, runs[1].largest.vectors)
    assert torch.equal(runs[0].smallest.values, runs[1].smallest.values)


def test_operators_of_one_and_two_rows_are_solved_exactly():
    one = extreme_eigenpairs(DenseOperator(torch.tensor([[-3.0]])), generator(), EigenSettings(1, 0))
    assert one.largest.values.tolist() == [-3.0] and one.largest.residuals.tolist() == [0.0]
    two = extreme_eigenpairs(DenseOperator(torch.tensor([[0.0, 2.0], [2.0, 0.0]]).double()), generator())
    assert two.largest.values.tolist() == pytest.approx([2.0]) and two.smallest.values.tolist() == pytest.approx([-2.0])


@pytest.mark.parametrize("power", [-665, 665])
def test_pairs_scale_with_the_operator(power):
    matrix, settings = operator("indefinite").matrix, EigenSettings(2, 1, rtol=1e-3, basis=12)
    plain, scaled = (extreme_eigenpairs(DenseOperator(2.0**e * matrix), generator(), settings) for e in (0, power))
    for here, there in ((plain.largest, scaled.largest), (plain.smallest, scaled.smallest)):
        assert here.reason == there.reason == "tolerance"
        assert torch.allclose(2.0**-power * there.values, here.values, rtol=1e-9, atol=0)
        assert torch.allclose(2.0**-power * there.residuals, here.residuals, rtol=1e-2, atol=0)


def test_progress_counts_matvecs_up_to_the_budget():
    seen = []
    ends = extreme_eigenpairs(operator("indefinite"), generator(), progress=lambda *state: seen.append(state))
    assert [done for done, _, _ in seen] == sorted({done for done, _, _ in seen})
    assert seen[-1][0] <= ends.matvecs and seen[0][1] == 1000 and "largest" in seen[-1][2]


def test_products_that_are_not_finite_are_an_error():
    misused("finite products", extreme_eigenpairs, Broken(torch.eye(5)), generator())


def test_bad_requests_are_refused():
    misused("not both 0", EigenSettings, 0, 0)
    misused("a basis of at least 5 vectors", EigenSettings, basis=4)
    misused("max_matvecs >= 7", EigenSettings, max_matvecs=6)
    misused("at most 2 eigenpairs", extreme_eigenpairs, DenseOperator(torch.eye(2)), generator(), EigenSettings(2, 1))
    misused("start vectors that are not zero", extreme_eigenpairs, operator("zero"), generator(), start=torch.zeros(N))
    for name in ("rtol", "atol", "noise"):
        misused(f"{name}.* got .*nan", replace, EigenSettings(), **{name: nan})


@pytest.mark.parametrize("block", [1, 2])
@pytest.mark.parametrize(("largest", "smallest"), [(5, 0), (3, 0), (4, 1), (0, 5), (2, 2)])
@pytest.mark.parametrize("rank", [1, 2, 6])
def test_pairs_of_a_null_space_are_not_taken_from_the_other_end(rank, largest, smallest, block):
    """The recurrence ends with the null space's first vector: the others come from random vectors, one by one."""
    values = torch.zeros(60, dtype=torch.float64)
    values[:rank] = -torch.arange(1, rank + 1)
    Q = torch.linalg.qr(torch.randn(60, 60, generator=torch.Generator().manual_seed(1), dtype=torch.float64)).Q
    H = DenseOperator((Q * values @ Q.T + (Q * values @ Q.T).T) / 2)
    ends = extreme_eigenpairs(H, torch.Generator().manual_seed(0), EigenSettings(largest, smallest, block=block))
    ordered = values.sort().values
    assert torch.allclose(ends.largest.values, ordered.flip(0)[:largest], atol=1e-12)
    assert torch.allclose(ends.smallest.values, ordered[:smallest], atol=1e-12)


def test_one_value_is_not_settled_by_the_first_product():
    values = torch.ones(100_000)
    values[7] = 4.0
    ends = extreme_eigenpairs(Diagonal(values), torch.Generator().manual_seed(0), EigenSettings(1, 0, rtol=1e-2))
    assert float(ends.largest.values[0]) == pytest.approx(4.0, rel=1e-3)


def test_further_pairs_continue_those_wanted_at_either_end():
    values = torch.linspace(-3, 5, 40, dtype=torch.float64) ** 3
    operator, generator = DenseOperator(torch.diag(values)), torch.Generator().manual_seed(0)
    found = extreme_eigenpairs(operator, generator, EigenSettings(2, 1, rtol=1e-8, further=3))
    assert found.further is not None
    top, bottom = found.further
    assert top.values[:2] == pytest.approx(values.flip(0)[2:4], rel=1e-6)
    assert bottom.values[:2] == pytest.approx(values[1:3], rel=1e-6)
    assert torch.equal(top.vectors.abs().argmax(dim=0)[:2], torch.tensor([37, 36]))
    assert (top.vector_errors[:2] < 1e-3).all() and len(top) == len(bottom) == 3
