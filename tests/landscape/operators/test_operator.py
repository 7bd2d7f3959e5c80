import numpy as np
import pytest
import torch

from landscape.eigen.power import power_iteration
from landscape.operators.operator import (
    CountingOperator,
    DenseOperator,
    ProjectedOperator,
    RestrictedOperator,
    ScaledOperator,
    SumOperator,
    SymmetricOperator,
)
from landscape.slices.finite_probe import finite_probe
from landscape.spectrum.density import spectral_density
from landscape.traces.diagonal import estimate_diagonal
from landscape.traces.trace import TraceSettings, estimate_traces
from tests.oracles import symmetric_matrix
from tests.refusals import misused

N = 7
BLOCKS = {"a": slice(0, 3), "b": slice(3, N)}
A = torch.from_numpy(symmetric_matrix(np.linspace(-1, 2, N), seed=0))
B = torch.from_numpy(symmetric_matrix(np.linspace(0, 1, N), seed=1))
V = torch.randn(N, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
NULL = torch.nn.functional.normalize(torch.arange(1.0, N + 1, dtype=torch.float64), dim=0)[:, None]


def project(V):
    return V - NULL @ (NULL.T @ V)


SCALE = torch.logspace(-2, 1, N, dtype=torch.float64)
COMPOSED = {
    "dense": (DenseOperator(A, BLOCKS), A),
    "sum": (SumOperator([DenseOperator(A), DenseOperator(B)]), A + B),
    "scaled": (ScaledOperator(DenseOperator(A), SCALE), SCALE[:, None] * A * SCALE),
    "projected": (
        ProjectedOperator(DenseOperator(A), project),
        (torch.eye(N) - NULL @ NULL.T) @ A @ (torch.eye(N) - NULL @ NULL.T),
    ),
    "counting": (CountingOperator(DenseOperator(A)), A),
}


@pytest.mark.parametrize("name", COMPOSED)
def test_a_composed_operator_is_the_matrix_that_it_says(name):
    operator, matrix = COMPOSED[name]
    assert isinstance(operator, SymmetricOperator)
    # either side is up to three sums of N terms, one after the other, each rounded by N eps / 2 of the norms
    size = (matrix.norm() + A.norm() + 2 * B.norm()) * V.norm()
    assert (operator.apply(V) - matrix @ V).norm() <= 3 * N * torch.finfo(V.dtype).eps * size


def test_a_restricted_operator_is_the_diagonal_block():
    restricted = RestrictedOperator(DenseOperator(A, BLOCKS), "b")
    assert restricted.dim == 4 and dict(restricted.blocks) == {"b": slice(0, 4)}
    assert torch.allclose(restricted.apply(V[:4]), A[3:, 3:] @ V[:4], rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", COMPOSED)
def test_no_operator_changes_its_argument(name):
    before = V.clone()
    COMPOSED[name][0].apply(V)
    assert torch.equal(V, before)


def test_counting_counts_vectors():
    operator = CountingOperator(DenseOperator(A))
    operator.apply(V)
    operator.apply(V[:, :1])
    assert operator.matvecs == 5


@pytest.mark.parametrize("name", COMPOSED)
def test_a_flat_vector_is_refused_with_the_remedy(name):
    misused(r"expected V of shape \(n, k\) with n = 7, got \(7,\); use V\[:, None\]", COMPOSED[name][0].apply, V[:, 0])


def test_a_vector_of_another_length_is_refused():
    misused(r"with n = 7, got \(6, 2\)", DenseOperator(A).apply, torch.ones(6, 2))


def test_dense_refuses_what_is_not_a_symmetric_finite_matrix():
    misused("square", DenseOperator, A[:3])
    misused(r"use \(A \+ A.T\) / 2", DenseOperator, A + torch.triu(torch.ones(N, N)))
    misused("finite", DenseOperator, A / 0)


def test_blocks_must_be_disjoint_ranges_of_rows():
    misused("disjoint", DenseOperator, A, {"a": slice(0, 4), "b": slice(3, N)})
    misused("disjoint", DenseOperator, A, {"a": slice(0, N + 1)})
    misused(r"slice\(start, stop\)", DenseOperator, A, {"a": slice(0, N, 2)})


def test_an_unknown_block_is_refused_with_the_known_ones():
    misused("a block out of a, b, got 'c'", RestrictedOperator, DenseOperator(A, BLOCKS), "c")


def test_a_sum_needs_terms_that_fit():
    misused("at least one", SumOperator, [])
    misused("7 rows", SumOperator, [DenseOperator(A), DenseOperator(A[:3, :3])])


def test_scales_must_fit_and_be_finite():
    misused("7 finite scales", ScaledOperator, DenseOperator(A), SCALE[:3])
    misused("7 finite scales", ScaledOperator, DenseOperator(A), SCALE / 0)


class Wrong(DenseOperator):
    """Products that are wrong in one way."""

    def __init__(self, change, dim=60):
        super().__init__(torch.diag(torch.linspace(-1.0, 2.0, dim, dtype=torch.float64)))
        self.change = change

    def apply(self, V):
        return self.change(super().apply(V))


ESTIMATORS = {
    "hutchinson": lambda H, g: estimate_traces(H, g, TraceSettings.fixed(24)),
    "hutch++": lambda H, g: estimate_traces(H, g, TraceSettings.fixed(24, method="hutch++")),
    "xtrace": lambda H, g: estimate_traces(H, g, TraceSettings.fixed(24, method="xtrace")),
    "diagonal": lambda H, g: estimate_diagonal(H, g),
    "density": lambda H, g: spectral_density(H, g, matvecs=24),
    "power": lambda H, g: power_iteration(H, g),
    "finite probe": lambda H, g: finite_probe(torch.sum, torch.zeros(60).double(), torch.ones(60).double(), H),
}
MISTAKES = {
    "a row for all": (lambda W: W[:1], r"expected products H V of the shape \(60, .*got \(1, .*in all"),
    "no columns": (lambda W: W[:, 0], r"expected products H V of the shape \(60, .*got \(60,\) and.*in all"),
    "another dtype": (lambda W: W.float(), "dtype torch.float64 of V, got .* and torch.float32 in all"),
    "infinite": (lambda W: W / 0, "expected finite products H V, got NaN or infinity in all"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_every_estimator_refuses_products_of_another_shape_or_not_finite(estimator, mistake):
    change, expected = MISTAKES[mistake]
    misused(expected, ESTIMATORS[estimator], Wrong(change), torch.Generator().manual_seed(0))
