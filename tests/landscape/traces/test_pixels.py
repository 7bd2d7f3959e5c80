"""Gauss-Newton by random vectors in the pixels: unbiased, its intervals cover, against the dense one of bumps on a line."""

import pytest
import torch
from torch import Tensor

from landscape import gauss_newton_blocks, gauss_newton_traces
from landscape.operators.renderer import RendererHessian
from tests.landscape.foreign import Bumps
from tests.landscape.spectra import generator
from tests.refusals import refused


def squares(image: Tensor, view: float) -> Tensor:
    """A sum over pixels: l'' is diagonal, with other weights in every pixel."""
    return (torch.linspace(0.5, 2, 40).to(image) * (image - view) ** 2).sum()


LOSSES = {"diagonal": squares, "coupled": Bumps.loss}


def bridge(kind: str) -> tuple[RendererHessian, Tensor]:
    bumps = Bumps()
    H = RendererHessian(bumps.render, bumps.named, LOSSES[kind], bumps.views)
    return H, H.gauss_newton.apply(torch.eye(24, dtype=torch.float64))


@pytest.mark.parametrize("kind", LOSSES)
def test_the_intervals_of_traces_cover(kind):
    """20 seeds of four blocks: 95% less three standard errors, were the blocks of a seed fully correlated."""
    H, dense = bridge(kind)
    covered = 0
    for seed in range(20):
        for name, found in gauss_newton_traces(H, generator(seed), samples=8).items():
            covered += found.low <= float(dense.diagonal()[H.blocks[name]].sum()) <= found.high
    assert covered / 80 >= 0.8


@pytest.mark.parametrize("kind", LOSSES)
def test_diagonal_and_blocks_are_unbiased_with_their_errors(kind):
    H, dense = bridge(kind)
    found = gauss_newton_blocks(H, generator(), torch.arange(24)[:, None], samples=60)
    assert (((found.values.flatten() - dense.diagonal()) / found.standard_errors.flatten()).abs() < 4.5).all()
    groups = torch.arange(24).reshape(4, 6).T  # place, depth, width and height of each bump
    blocks = gauss_newton_blocks(H, generator(1), groups, samples=60)
    exact = dense[groups[:, :, None], groups[:, None, :]]
    assert blocks.values.shape == (6, 4, 4)
    assert (((blocks.values - exact) / blocks.standard_errors).abs() < 4.5).all()
    assert 0.6 < float(((blocks.values - exact) / blocks.standard_errors).square().mean()) ** 0.5 < 1.4


def test_a_diagonal_curvature_takes_one_backward_pass_and_a_coupled_one_two():
    counts = {}
    for kind in LOSSES:
        H, _ = bridge(kind)
        calls, vjp = [], H.parameters.vjp
        H.parameters.vjp = lambda *a, vjp=vjp, calls=calls, **k: calls.append(1) or vjp(*a, **k)
        gauss_newton_traces(H, generator(), samples=8)
        counts[kind] = len(calls)
    assert counts == {"diagonal": 8 * 3, "coupled": 2 * 8 * 3}


def test_groups_of_samples_give_the_numbers_of_one():
    H, dense = bridge("coupled")
    small = gauss_newton_traces(H, generator(), samples=64, memory=1e-9)
    for name, found in small.items():
        exact = float(dense.diagonal()[H.blocks[name]].sum())
        assert abs(found.value - exact) < 4 * found.standard_error and found.probes == len(found.samples) == 64


def test_too_few_samples_and_groups_out_of_range_are_refused():
    H, _ = bridge("diagonal")
    refused("at least 8 samples, got 7", gauss_newton_traces, H, generator(), samples=7)
    refused("at least 3 samples, got 2", gauss_newton_blocks, H, generator(), torch.tensor([[0]]), samples=2)
    refused(r"numbers of rows in 0..23", gauss_newton_blocks, H, generator(), torch.tensor([[0, 24]]))
