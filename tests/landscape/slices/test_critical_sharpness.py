"""Critical sharpness of losses whose answer is known."""

import numpy as np
import pytest
import torch

from landscape import critical_sharpness

DOUBLE = torch.float64


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_critical_sharpness_of_a_quadratic_loss_is_its_curvature_along_the_update():
    A = torch.randn(6, 6, generator=seeded(), dtype=DOUBLE)
    A, start = A @ A.T, torch.randn(6, generator=seeded(1), dtype=DOUBLE)
    for size in (1e-3, 0.3, 30.0):  # of the update beside the critical one
        update = size * (A @ start)
        slope = float((A @ start) @ update)
        found = critical_sharpness(lambda x: float(x @ A @ x) / 2, start, update, slope)
        exact = float(update @ A @ update) / slope
        assert (
            found.value == pytest.approx(exact, rel=1e-9, abs=1.01 * found.error) and found.error <= 0.01 * exact * 1.1
        )
    quartic = critical_sharpness(lambda x: float((x**4).sum()), torch.ones(1, dtype=DOUBLE), torch.ones(1), 4.0)
    assert quartic.value == pytest.approx(1.0, abs=0.02)  # it is 1 again at -1
    jump = critical_sharpness(lambda x: float(x) + 2 * float(x < 0.4), torch.ones(1), torch.ones(1), 1.0)
    assert jump.value == pytest.approx(2 / 0.6, abs=jump.error) and jump.error < 0.02 * jump.value
    assert np.isnan(critical_sharpness(lambda x: float(x.sum()), start, -start.abs(), -1.0)).all()
