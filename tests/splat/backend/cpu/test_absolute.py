"""Absolute values of many small matrices, against an eigendecomposition in double precision."""

import numpy as np
import pytest
import torch

from splat.backend.cpu.absolute import absolute_values
from tests.oracles import absolute_matrix


@pytest.mark.parametrize(("dtype", "error"), [(torch.float64, 2e-14), (torch.float32, 1e-5)])
@pytest.mark.parametrize("n", [1, 37])
def test_absolute_values_are_those_of_the_eigenvalues(n, dtype, error):
    A = torch.randn(n, 11, 11, dtype=dtype, generator=torch.Generator().manual_seed(0))
    A = A + A.mT
    special = [torch.zeros(11, 11), torch.ones(11, 11), torch.diag(torch.arange(11.0) - 5), 1e-15 * A[0]]
    A = torch.cat([A, torch.stack(special).to(A)])  # zeros, of rank 1, diagonal, small
    before = A.clone()
    found = absolute_values(A)
    assert torch.equal(A, before) and found.shape == A.shape
    for one, other in zip(found.numpy(), A.double().numpy(), strict=True):
        truth = absolute_matrix(other)
        assert np.linalg.norm(one - truth) <= error * np.linalg.norm(truth)
