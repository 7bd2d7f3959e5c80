from math import sqrt

import numpy as np
import pytest
import torch

from landscape.operators.operator import CountingOperator, DenseOperator
from landscape.traces.diagonal import estimate_diagonal
from tests.landscape.spectra import Broken, generator
from tests.oracles import symmetric_matrix
from tests.refusals import misused

N = 40
INDEFINITE = torch.from_numpy(symmetric_matrix(np.linspace(-0.5, 1, N), seed=0))


def test_every_entry_is_within_its_errors_and_they_are_those_of_theory():
    probes = 4000
    operator = CountingOperator(DenseOperator(INDEFINITE))
    estimate = estimate_diagonal(operator, generator(), probes, batch=100)
    # four standard errors of the largest of 40: 5
    assert ((estimate.values - INDEFINITE.diagonal()).abs() < 5 * estimate.standard_errors).all()
    theory = (INDEFINITE.square().sum(dim=1) - INDEFINITE.diagonal().square()) / probes
    # a variance from m samples of kurtosis below 3 is within 5 sqrt(2 / m)
    assert ((estimate.standard_errors.square() / theory - 1).abs() < 5 * sqrt(2 / probes)).all()
    assert estimate.matvecs == operator.matvecs == probes


def test_a_diagonal_matrix_is_exact():
    diagonal = torch.linspace(-1, 2, N, dtype=torch.float64)
    estimate = estimate_diagonal(DenseOperator(torch.diag(diagonal)), generator(), 4)
    assert torch.allclose(estimate.values, diagonal, rtol=0, atol=1e-15)
    assert float(estimate.standard_errors.max()) < 1e-15


def test_bad_input_is_refused():
    misused("at least 3 probes, got 2", estimate_diagonal, DenseOperator(INDEFINITE), generator(), 2)

    misused("expected finite products H V", estimate_diagonal, Broken(INDEFINITE), generator())


@pytest.mark.parametrize("size", [2.0**531, 2.0**-664])
def test_products_whose_squares_leave_the_range_of_floats_are_refused_with_a_sentence(size):
    with pytest.raises(ValueError, match=r"largest entry from 1e-140 to 1e\+140, got .*; scale H"):
        estimate_diagonal(DenseOperator(size * INDEFINITE), generator(), 24)
    assert not estimate_diagonal(DenseOperator(0 * INDEFINITE), generator(), 24).values.any()
