from math import sqrt

import numpy as np
import pytest
import torch

from landscape.operators.operator import CountingOperator, DenseOperator
from landscape.traces.choice import outside_sketch
from landscape.traces.trace import TraceSettings, estimate_traces
from tests.landscape.spectra import generator
from tests.oracles import symmetric_matrix

N = 100
_i = np.arange(N)
SPECTRA = {
    "power law": (1.0 + _i) ** -1.5,
    "rank 5": np.where(_i < 5, 1.0 + _i, 0),
    "flat": 1 + _i / N,
    "indefinite": np.where(_i % 3 > 0, 1.0, -0.3) / (1 + _i) ** 0.5,
}
MATRICES = {name: torch.from_numpy(symmetric_matrix(values, seed=4)) for name, values in SPECTRA.items()}


def runs(matrix, settings, seeds):
    operator = DenseOperator(matrix)
    return [estimate_traces(operator, generator(seed), settings)["all"] for seed in range(seeds)]


def error(estimates, matrix):
    return sqrt(sum((e.value - float(matrix.trace())) ** 2 for e in estimates) / len(estimates))


@pytest.mark.parametrize("name", SPECTRA)
def test_the_part_outside_a_sketch_follows_from_the_products(name):
    H, seeds = MATRICES[name], 200
    Z = torch.stack([torch.randn(N, 8, dtype=torch.float64, generator=generator(seed)) for seed in range(seeds)]).sign()
    Y = H @ Z
    rests, truth = torch.zeros(2, seeds, dtype=torch.float64)
    for i in range(8):
        Q = torch.linalg.qr(Y[:, :, [j for j in range(8) if j != i]]).Q
        rests += (Y[:, :, i : i + 1] - Q @ (Q.mT @ Y[:, :, i : i + 1])).square().sum(dim=(1, 2)) / 8
        truth += (H - Q @ (Q.mT @ H)).square().sum(dim=(1, 2)) / 8
    found = torch.tensor([outside_sketch(y) for y in Y], dtype=torch.float64)
    # the Gram matrix squares the round-off
    assert ((found - rests).abs() <= torch.maximum(1e-6 * rests, 1e-13 * Y.square().sum(dim=(1, 2)))).all()
    room = 4 * float((found - truth).std()) / sqrt(seeds) + 1e-13 * float(H.square().sum())
    assert abs(float((found - truth).mean())) <= room


@pytest.mark.parametrize(
    ("name", "methods"),
    [("power law", {"xtrace"}), ("rank 5", {"xtrace"}), ("flat", {"hutchinson"}), ("indefinite", {"hutchinson"})],
)
def test_the_probes_become_a_sketch_where_it_pays_and_no_product_is_lost(name, methods):
    operator = CountingOperator(DenseOperator(MATRICES[name]))
    estimates = [
        estimate_traces(operator, generator(seed), TraceSettings(rtol=0.05, max_probes=90))["all"] for seed in range(10)
    ]
    assert {e.method for e in estimates} == methods
    assert operator.matvecs == sum(e.matvecs for e in estimates)
    if name == "rank 5":  # 8 probes, and the 5 directions that they span
        assert {e.matvecs for e in estimates} == {13} and error(estimates, MATRICES[name]) < 1e-12


@pytest.mark.parametrize("name", SPECTRA)
def test_the_default_needs_what_the_better_method_needs(name):
    H, seeds = MATRICES[name], 60
    ours = error(runs(H, TraceSettings.fixed(24, method="auto"), seeds), H)
    better = min(error(runs(H, TraceSettings.fixed(24, method=m), seeds), H) for m in ("hutchinson", "xtrace"))
    # the errors of both from 60 seeds are good to 1 / sqrt(120), if they are normal; at rank 5 both are round-off
    assert ours < better * (1 + 4 * sqrt(2) / sqrt(2 * seeds)) + 1e-12


def test_a_matrix_that_costs_less_than_its_estimate_is_multiplied_out():
    H = MATRICES["flat"][:30, :30] - 1.4 * torch.eye(30)  # a trace near zero
    for settings, products in ((TraceSettings(rtol=0.01), 38), (TraceSettings.fixed(30, method="auto"), 30)):
        (estimate,) = runs(H, settings, 1)
        assert (estimate.reason, estimate.matvecs) == ("exact", products)
        assert estimate.value == pytest.approx(float(H.trace()), abs=1e-13)


def test_a_sketch_keeps_to_the_memory():
    room = 4 * 9 * N * 8 / 2**30  # for nine test vectors
    (few,) = runs(MATRICES["power law"], TraceSettings(rtol=1e-3, memory=room), 1)
    assert (few.method, few.probes, few.matvecs, few.reason) == ("xtrace", 9, 18, "matvec budget")
    (none,) = runs(MATRICES["power law"], TraceSettings(rtol=1e-3, max_probes=60, memory=room * 7 / 9), 1)
    assert (none.method, none.probes) == ("hutchinson", 60)


def test_the_same_seed_gives_the_same_numbers_in_batches_of_any_size():
    one, same, other = (runs(MATRICES["power law"], TraceSettings(rtol=0.03, batch=batch), 1)[0] for batch in (4, 4, 3))
    assert one.value == same.value and torch.equal(one.samples, same.samples)
    assert other.value == pytest.approx(one.value, abs=1e-12) and other.matvecs == one.matvecs


def test_full_probes_stay_with_hutchinson():
    blocks = {"a": slice(0, 50), "b": slice(50, N)}
    full = estimate_traces(DenseOperator(MATRICES["rank 5"], blocks), generator(), TraceSettings(reading="full"))
    assert {e.method for e in full.values()} == {"hutchinson"}


def test_products_that_are_not_finite_are_an_error_that_names_the_block():
    class Broken(DenseOperator):
        def apply(self, V):
            return super().apply(V) / 0

    with pytest.raises(ValueError, match=r"expected finite products H V.*in all"):
        estimate_traces(Broken(MATRICES["flat"]), generator())
