import numpy as np
import pytest
import torch

from splat.curvature.traces import controlled
from tests.landscape.spectra import generator


@pytest.mark.parametrize("trace", [0.0, 2.0**24, 2.0**30])
def test_the_slope_of_a_sample_is_fitted_to_all_others(trace):
    x, y = torch.randn(2, 9, dtype=torch.float64, generator=generator())
    found = controlled(x + trace, y + trace, 0.3 + trace) - trace  # a large trace hides no slope
    for i in range(9):
        rest = torch.arange(9) != i
        slope = np.polyfit(y[rest].numpy(), x[rest].numpy(), 1)[0]
        assert float(found[i]) == pytest.approx(float(x[i] - slope * (y[i] - 0.3)), abs=1e-12 + 1e-15 * trace)


@pytest.mark.parametrize("step", [0.3, 0.7, 1e3 / 3])
@pytest.mark.parametrize("count", [8, 10, 12, 13, 32])
def test_a_sample_stays_as_it_is_where_the_other_controls_are_equal(count, step):
    """As random signs give them where the known part is sparse."""
    y = torch.full((count,), 0.37, dtype=torch.float64)
    y[2] += step
    x = torch.randn(count, dtype=torch.float64, generator=generator())
    assert float(controlled(x, y, 0.4)[2]) == float(x[2])


@pytest.mark.parametrize("size", [2.0**531, 2.0**-664])
def test_a_control_of_any_size_helps_as_much(size):
    x, y = torch.randn(2, 9, dtype=torch.float64, generator=generator())
    one, other = controlled(x, y, 0.3), controlled(x, y * size, 0.3 * size)
    assert torch.allclose(other, one, rtol=1e-12, atol=0)
