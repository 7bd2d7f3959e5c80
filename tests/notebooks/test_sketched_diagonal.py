from math import sqrt

import numpy as np
import pytest
import torch

from landscape.linalg import gram
from landscape.operators.operator import CountingOperator, DenseOperator
from landscape.traces.diagonal import estimate_diagonal
from notebooks.accuracy.sketched_diagonal import _Small, chosen_diagonal, sketched_samples
from tests.landscape.spectra import Buffered, generator
from tests.oracles import symmetric_matrix

N = 80
_i = np.arange(N)
POWER = torch.from_numpy(symmetric_matrix(np.where(_i % 4 > 0, 1.0, -0.5) / (1.0 + _i) ** 1.5, seed=5))
LOW = torch.from_numpy(symmetric_matrix(np.where(_i < 6, 1.0 + _i, 0), seed=6))
FLAT = torch.from_numpy(symmetric_matrix(1 + _i / N, seed=7))
ROUND_OFF = N * torch.finfo(torch.float64).eps


def sketch(matrix, count, seed=0):
    Z = torch.randn(len(matrix), count, dtype=torch.float64, generator=generator(seed)).sign()
    Y = matrix @ Z
    Q = torch.linalg.qr(Y).Q
    return Z, Y, Q, matrix @ Q


def test_each_sample_is_the_one_of_its_definition():
    Z, Y, Q, HQ = sketch(POWER, 6)
    small = _Small.of(gram(Q, Y), gram(Q, Z), gram(Q, HQ))
    found = small.samples(Z, Q, HQ)
    for i in range(6):
        others = [j for j in range(6) if j != i]
        basis = torch.linalg.qr(Y[:, others]).Q
        P = basis @ basis.T
        rest = torch.eye(N) - P
        expected = (P @ POWER + POWER @ P - P @ POWER @ P).diagonal() + Z[:, i] * (rest @ POWER @ rest @ Z[:, i])
        assert torch.allclose(found[:, i], expected, rtol=0, atol=1e-12)
        # and without it, the others are those that never saw it
        inner, smaller = small.without(i)
        alone = sketch_of(Z[:, others], Y[:, others])
        found_without = smaller.samples(Z[:, others], Q @ inner, HQ @ inner)
        assert torch.allclose(found_without, alone, rtol=0, atol=1e-12)


def sketch_of(Z, Y):
    Q = torch.linalg.qr(Y).Q
    HQ = POWER @ Q
    return _Small.of(gram(Q, Y), gram(Q, Z), gram(Q, HQ)).samples(Z, Q, HQ)


def test_entries_are_right_on_average_and_their_errors_are_those_found():
    seeds, truth = 80, POWER.diagonal()
    runs = [chosen_diagonal(DenseOperator(POWER), generator(seed), 32) for seed in range(seeds)]
    values = torch.stack([run.values for run in runs])
    # four standard errors of the largest of 80: 5
    assert ((values.mean(dim=0) - truth).abs() < 5 * values.std(dim=0) / sqrt(seeds)).all()
    squares = (values - truth).square().sum(dim=1)
    stated = torch.stack([run.standard_errors.square().sum() for run in runs])
    room = 4 * float((squares - stated).std()) / sqrt(seeds)
    assert abs(float((squares - stated).mean())) < room
    # the spread of samples that share a sketch, taken as independent, says too little
    plain = []
    for seed in range(seeds):
        Z, Y, Q, HQ = sketch(POWER, 16, seed)
        plain.append(_Small.of(gram(Q, Y), gram(Q, Z), gram(Q, HQ)).samples(Z, Q, HQ).var(dim=1).sum() / 16)
    assert float(squares.mean() - torch.stack(plain).mean()) > room


def test_where_few_eigenvalues_dominate_a_sketch_has_a_fifth_of_the_error():
    operator, truth = CountingOperator(DenseOperator(POWER)), POWER.diagonal()
    found = chosen_diagonal(operator, generator(), 32)
    signs = estimate_diagonal(DenseOperator(POWER), generator(), 32)
    assert (found.method, signs.method) == ("sketch", "signs")
    assert operator.matvecs == found.matvecs == 32
    assert float((found.values - truth).norm()) < float((signs.values - truth).norm()) / 5


def test_a_low_rank_is_exact_after_as_many_products_more_as_its_rank():
    operator = CountingOperator(DenseOperator(LOW))
    found = chosen_diagonal(operator, generator(), 32)
    assert operator.matvecs == found.matvecs == 16 + 6
    bound = ROUND_OFF * float(LOW.norm())
    assert float((found.values - LOW.diagonal()).abs().max()) < bound and float(found.standard_errors.max()) < bound


def test_a_flat_spectrum_and_few_probes_stay_with_signs():
    for operator, probes in ((DenseOperator(FLAT), 32), (DenseOperator(POWER), 7)):
        auto, signs = (of(operator, generator(), probes) for of in (chosen_diagonal, estimate_diagonal))
        assert auto.method == "signs" and auto.matvecs == probes
        assert torch.allclose(auto.values, signs.values, rtol=0, atol=1e-12)


@pytest.mark.parametrize("matrix", [POWER, FLAT], ids=["a sketch", "signs"])
def test_the_same_seed_gives_the_same_numbers_in_batches_of_any_size(matrix):
    one, same, other = (chosen_diagonal(DenseOperator(matrix), generator(), 32, batch).values for batch in (4, 4, 7))
    assert torch.equal(one, same) and torch.allclose(one, other, rtol=0, atol=1e-12)


def test_single_precision_products_give_the_diagonal_to_single_precision():
    found = chosen_diagonal(DenseOperator(LOW.float()), generator(), 32)
    error = float((found.values - LOW.diagonal()).abs().max())
    assert found.method == "sketch" and error < N * torch.finfo(torch.float32).eps * float(LOW.norm())


def test_products_that_are_not_finite_are_refused():
    class Late(DenseOperator):
        calls = 0

        def apply(self, V):
            self.calls += 1
            return super().apply(V) / (self.calls <= 4)

    with pytest.raises(ValueError, match="expected finite products H V"):
        chosen_diagonal(Late(POWER), generator(), 32)  # the sketch's own products, after four of four probes


def test_the_samples_have_the_mean_and_no_less_than_their_spread():
    Z, Y, Q, HQ = sketch(POWER, 12)
    plain = _Small.of(gram(Q, Y), gram(Q, Z), gram(Q, HQ)).samples(Z, Q, HQ)
    samples = sketched_samples(Z, Y, Q, HQ)
    assert torch.allclose(samples.mean(dim=1), plain.mean(dim=1), rtol=0, atol=1e-12)
    ratios = samples.std(dim=1) / plain.std(dim=1)
    assert float(ratios.min()) >= 1 - 1e-12 and torch.allclose(ratios, ratios[0].expand(N), rtol=1e-9)


def test_an_operator_may_give_the_same_memory_at_every_call():
    matrix = torch.from_numpy(symmetric_matrix(1 / np.arange(1, 121.0) ** 1.5, seed=1))
    plain, buffered = (chosen_diagonal(H, generator(), 32) for H in (DenseOperator(matrix), Buffered(matrix)))
    assert plain.method == buffered.method == "sketch"
    assert torch.allclose(plain.values, buffered.values, rtol=1e-9)
