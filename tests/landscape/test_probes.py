import pytest
import torch

from landscape.probes import draw_probes, spawn
from tests.landscape.spectra import generator


@pytest.mark.parametrize("distribution", ["rademacher", "gaussian"])
def test_the_first_probes_are_the_same_however_many_are_drawn_at_a_time(distribution):
    together = draw_probes(11, 5, generator(), torch.float64, distribution)
    source = generator()
    apart = [draw_probes(11, count, source, torch.float64, distribution) for count in (2, 3)]
    assert torch.equal(together, torch.cat(apart, dim=1))


@pytest.mark.parametrize("distribution", ["rademacher", "gaussian"])
def test_probes_have_identity_covariance(distribution):
    count = 20_000
    Z = draw_probes(4, count, generator(), torch.float64, distribution)
    # entries of the sample covariance: standard deviation at most sqrt(2 / count)
    assert (Z @ Z.T / count - torch.eye(4)).abs().max() < 4 * (2 / count) ** 0.5


def test_rademacher_entries_are_signs():
    assert set(draw_probes(50, 2, generator(), torch.float32, "rademacher").unique().tolist()) == {-1.0, 1.0}


def test_split_generators_are_reproducible_and_differ():
    a, b = (spawn(source) for source in [generator()] * 2)
    c = spawn(generator())
    draws = [draw_probes(8, 1, source, torch.float64) for source in (a, b, c)]
    assert torch.equal(draws[0], draws[2]) and not torch.equal(draws[0], draws[1])
