"""Ends of the spectrum by approximate products: the stated error holds the error of the products."""

import torch

from landscape import EigenSettings, renderer_eigenpairs
from tests.landscape.foreign import Bumps


def test_the_ends_of_float32_lie_within_their_errors():
    exact = torch.linalg.eigvalsh(Bumps().exact().apply(torch.eye(24, dtype=torch.float64)))
    for seed in range(3):
        H, generator = Bumps(torch.float32).hessian(), torch.Generator().manual_seed(seed)
        ends = renderer_eigenpairs(H, generator, EigenSettings(rtol=1e-6))
        for pairs, value in ((ends.largest, exact[-1]), (ends.smallest, exact[0])):
            assert abs(float(pairs.values) - float(value)) <= float(pairs.residuals)
            assert pairs.reason == "noise floor"  # a millionth is below what these products tell
        assert float(ends.largest.residuals) < 0.02 * float(exact[-1])


def test_in_float64_the_tolerance_is_reached():
    ends = renderer_eigenpairs(Bumps().hessian(), torch.Generator().manual_seed(0), EigenSettings(smallest=0))
    exact = torch.linalg.eigvalsh(Bumps().exact().apply(torch.eye(24, dtype=torch.float64)))
    assert ends.largest.reason == "tolerance" and len(ends.smallest) == 0
    assert abs(float(ends.largest.values) / float(exact[-1]) - 1) < 1e-3
