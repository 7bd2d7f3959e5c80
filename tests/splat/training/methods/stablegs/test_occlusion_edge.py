"""The dominant occlusion edge: known edges, a second derivation, and maps without any."""

from math import cos, pi, radians, sin

import kornia.filters
import numpy as np
import pytest
import torch
from torch import Tensor

from splat.training.methods.stablegs.viewpoint_probe import _sobel, dominant_edge


def grid(height: int = 60, width: int = 80) -> tuple[Tensor, Tensor]:
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    return x - width / 2, y - height / 2


def angle_between(normal: Tensor, degrees: float) -> float:
    """Radians between two directions without a sign."""
    difference = torch.atan2(normal[1], normal[0]).item() - radians(degrees)
    return abs((difference + pi / 2) % pi - pi / 2)


@pytest.mark.parametrize("degrees", [0, 20, 45, 75, 90, 110, 135, 160])
def test_the_normal_of_a_depth_step_is_across_it(degrees: float) -> None:
    x, y = grid()
    softness = 3.0
    across = (x * cos(radians(degrees)) + y * sin(radians(degrees))) / (softness * 2**0.5)
    depth = 3 + torch.erf(across)
    normal = dominant_edge(depth, torch.ones_like(depth))
    # Sobel turns a wave of k px^-1 by k^2 sin(4 angle) / 48; here the mean k^2 is 1 / (2 softness^2).  Twice that: the
    # strongest edges are not the whole profile
    assert angle_between(normal, degrees) < 2 / (96 * softness**2)
    assert normal.norm().item() == pytest.approx(1, rel=1e-12) and normal[0] >= 0


def test_the_normal_is_the_first_eigenvector_of_the_structure_tensor() -> None:
    depth = 5 + torch.rand(40, 50, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    depth[:, 20:] += 3
    gradient = kornia.filters.spatial_gradient(depth[None, None])[0, 0, :, 1:-1, 1:-1].reshape(2, -1).numpy()
    strongest = gradient[:, np.argsort(-np.hypot(*gradient))[: int(np.ceil(0.05 * gradient.shape[1]))]]
    _, vectors = np.linalg.eigh(strongest @ strongest.T)
    normal = dominant_edge(depth, torch.ones_like(depth))
    assert abs(normal.numpy() @ vectors[:, 1]) == pytest.approx(1, rel=1e-12)


@pytest.mark.parametrize(("dtype", "round_off"), [(torch.float32, 1e-5), (torch.float64, 1e-14)])
def test_the_gradient_is_the_convolution_with_sobels_kernels_to_round_off(dtype: torch.dtype, round_off: float) -> None:
    depth = 5 + torch.rand(17, 23, generator=torch.Generator().manual_seed(2), dtype=dtype)
    kernel = torch.tensor([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]], dtype=dtype) / 8
    convolved = torch.nn.functional.conv2d(depth[None, None], torch.stack([kernel, kernel.T])[:, None])[0]
    assert float((_sobel(depth) - convolved).abs().max()) < round_off


def test_many_weak_edges_do_not_outvote_a_strong_one() -> None:
    _, y = grid(64, 64)
    depth = 5 + 0.5 * torch.sin(0.6 * y)  # weak, everywhere left of the gap: most of the squared gradient
    depth[:, 32:] = 5
    depth[:, 48:] = 7
    alpha = torch.ones_like(depth)
    alpha[:, 32] = 0  # nothing is seen across the gap
    normal = dominant_edge(depth * alpha, alpha)
    assert normal.tolist() == pytest.approx([1, 0], abs=1e-12)


def test_the_mean_depth_counts_and_not_how_much_covers_it() -> None:
    x, y = grid()
    alpha = 0.7 + 0.2 * torch.sin(0.9 * y)
    mean = 4 + torch.erf(x / 3)
    expected, given = dominant_edge(mean, torch.ones_like(mean)), dominant_edge(mean * alpha, alpha)
    assert given.tolist() == pytest.approx(expected.tolist(), abs=1e-12)


def test_the_outline_against_nothing_and_faint_pixels_are_no_edges() -> None:
    x, y = grid()
    disc = x * x + y * y < 20**2
    alpha = torch.where(disc, 1.0, 0.01 * torch.rand(x.shape, generator=torch.Generator().manual_seed(0)).double())
    noise = torch.rand(x.shape, generator=torch.Generator().manual_seed(2)).double()
    depth = torch.where(disc, 4.0, 10 * noise * alpha)
    assert not dominant_edge(depth, alpha).any()
    inside = torch.where(disc & (y > 0), 5.0, depth)
    normal = dominant_edge(inside, alpha)
    assert normal.tolist() == pytest.approx([0, 1], abs=1e-12)


@pytest.mark.parametrize("size", [(40, 50), (2, 50), (1, 1)])
@pytest.mark.parametrize("covered", [0.0, 1.0])
def test_a_map_without_edges_has_no_axis(size: tuple[int, int], covered: float) -> None:
    alpha = torch.full(size, covered)
    normal = dominant_edge(7.3 * alpha, alpha)
    assert normal.tolist() == [0, 0]


def test_round_off_is_no_edge() -> None:
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(300, 30, 40, generator=generator) / 300
    depth, alpha = torch.zeros(30, 40), torch.zeros(30, 40)
    for weight in 2 * weights:
        depth, alpha = depth + weight * 7.3, alpha + weight
    assert (depth / alpha).unique().numel() > 1
    assert not dominant_edge(depth, alpha).any()


def test_the_axis_is_a_constant_to_the_derivative() -> None:
    x, _ = grid()
    depth = (3 + torch.erf(x)).requires_grad_()
    assert not dominant_edge(depth, torch.ones_like(depth)).requires_grad
