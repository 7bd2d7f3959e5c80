"""1,000 seeds a case: the 95% intervals of the traces hold the truth in 93 to 97% of them."""

from math import sqrt

import numpy as np
import pytest
import torch

from landscape.operators.operator import DenseOperator
from landscape.traces.trace import TraceSettings, estimate_traces
from tests.landscape.spectra import generator
from tests.oracles import symmetric_matrix

N, SEEDS = 40, 1000
_i = np.arange(1, N + 1)
SPECTRA = {
    "1/i": 1 / _i,
    "1/i^2": 1 / _i**2,
    "clustered": np.where(_i <= 5, 1 - 1e-5 * _i, np.where(_i > N - 4, -0.3, 0.3 * _i / N)),
    "indefinite": np.linspace(-1, 1.5, N) ** 3,
    "rank-deficient": np.where(_i <= 10, _i, 0),
    "one dominant": np.where(_i == 1, 1, 1e-3 * _i / N),
}


class Copies:
    """Independent runs at once: SEEDS copies of one matrix on the diagonal, a block each, read by one full probe."""

    def __init__(self, matrix):
        self.matrix, self.dtype = matrix, matrix.dtype
        n = len(matrix)
        self.dim = SEEDS * n
        self.blocks = {str(i): slice(i * n, (i + 1) * n) for i in range(SEEDS)}

    def apply(self, V):
        return (self.matrix @ V.view(SEEDS, len(self.matrix), -1)).view(V.shape)


def matrix(name):
    return torch.from_numpy(symmetric_matrix(SPECTRA[name], seed=3))


def cover(estimates, truth):
    return sum(e.low <= truth <= e.high for e in estimates) / SEEDS


@pytest.mark.parametrize(
    ("name", "distribution", "probes"),
    [(name, "gaussian", 8) for name in SPECTRA]
    + [(name, "rademacher", 10) for name in ("1/i", "1/i^2", "indefinite", "one dominant")]
    + [("one dominant", "gaussian", 40)],
)
def test_fixed_intervals_cover_at_the_nominal_rate(name, distribution, probes):
    H = matrix(name)
    settings = TraceSettings.fixed(probes, distribution, "full")
    estimates = estimate_traces(Copies(H), generator(1), settings)
    assert 0.93 <= cover(estimates.values(), float(H.trace())) <= 0.97


@pytest.mark.parametrize(
    ("name", "distribution", "settings"),
    [("1/i", "gaussian", {"rtol": 0.3}), ("one dominant", "rademacher", {"rtol": 0.0, "atol": 0.8})],
)
def test_adaptive_intervals_cover_at_the_nominal_rate(name, distribution, settings):
    H = matrix(name)
    asked = TraceSettings(distribution, max_probes=200, batch=32, method="hutchinson", **settings)
    estimates = [estimate_traces(DenseOperator(H), generator(s), asked)["all"] for s in range(SEEDS)]
    assert len({e.probes for e in estimates}) > 2
    assert all(e.reason == "tolerance" for e in estimates)
    assert 0.93 <= cover(estimates, float(H.trace())) <= 0.97


@pytest.mark.parametrize("settings", [TraceSettings.fixed(16, method="auto"), TraceSettings(rtol=0.1, batch=32)])
def test_intervals_of_the_default_cover_where_probes_become_a_sketch(settings):
    """Four standard errors of the cover of fewer seeds; the published error of XTrace covers 88%."""
    H, seeds = matrix("1/i^2"), 250
    estimates = [estimate_traces(DenseOperator(H), generator(s), settings)["all"] for s in range(seeds)]
    assert sum(e.method == "xtrace" for e in estimates) > 0.9 * seeds
    assert abs(sum(e.low <= H.trace() <= e.high for e in estimates) / seeds - 0.95) < 4 * sqrt(0.05 * 0.95 / seeds)
