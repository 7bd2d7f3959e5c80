"""Order fragility, open curvature and field sharpness, of toys whose answer is known."""

from math import erf, exp, log

import numpy as np
import pytest
import torch
from torch import Tensor

from splat.curvature.fields import complement
from splat.curvature.objective import SceneObjective
from splat.curvature.scores.field_sharpness import PARTS, field_sharpness, pixel_lengths, smooth_field, step
from splat.curvature.scores.information import PRIOR
from splat.curvature.scores.new_poses import open_curvature, order_fragility
from splat.curvature.scores.poses import Poses
from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from splat.render.render import render, render_layers
from tests.splat.tiny import SMOOTH, tiny_gaussians, tiny_views

DOUBLE = torch.float64
SQUARED = LossSettings("l2", ssim_weight=0.0)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def poses(count: int = 2) -> Poses:
    cameras = [view.camera for view in tiny_views(DOUBLE)[:count]]
    return Poses(cameras, torch.tensor([0.2, 0.3, 0.1], dtype=DOUBLE), SMOOTH)


def objective(gaussians: Gaussians) -> SceneObjective:
    return SceneObjective(gaussians, tiny_views(DOUBLE), SQUARED, None, SMOOTH)


def test_order_fragility_of_two_splats_is_their_overlap_times_the_chance_of_a_swap():
    both = tiny_gaussians(2, dtype=DOUBLE)
    both.means.copy_(torch.tensor([[0.0, 0.0, 3.0], [0.05, 0.02, 3.1]]))
    at, s = poses(1), 0.03
    alphas = [render(both.select(torch.tensor([i])), at.cameras[0], settings=SMOOTH).alpha for i in (0, 1)]
    white = torch.ones(2, 3, dtype=DOUBLE)
    colours = []
    for i in (0, 1):
        one = both.select(torch.tensor([i]))
        layers = render_layers(one, at.cameras[0], white[:1], SMOOTH)[0]
        colours.append(render(one, at.cameras[0], settings=SMOOTH).image / layers)
    chance = (1 - erf(log(3.1 / 3.0) / (2 * s))) / 2  # s (xi - xi') is normal with the deviation s sqrt 2
    exact = chance * float((alphas[0] * alphas[1] * (colours[0] - colours[1])).abs().mean())
    found = order_fragility(both, at, seeded(), s, draws=400)
    assert 0 < found.error < 0.1 * exact
    assert found.value == pytest.approx(exact, abs=3 * found.error)
    apart = both.with_flat(both.flat.clone())
    apart.log_scales.fill_(-3.0)
    apart.means[1, :2] = torch.tensor([1.0, 0.5])
    assert order_fragility(apart, at, seeded(), s).value < 1e-6 * exact


def test_a_field_has_unit_variance_and_forgets_over_its_length():
    points = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.2, 0.0]], dtype=DOUBLE)
    draws = torch.stack([smooth_field(points, 0.1, 4, seeded(i)) for i in range(1500)]).permute(1, 0, 2).flatten(1)
    apart = torch.cdist(points, points)
    assert np.allclose(draws @ draws.T / draws.shape[1], (-(apart**2) / 0.02).exp(), atol=0.05)


def test_sharpness_under_fields_of_colour_is_that_of_a_quadratic_loss():
    """E over phi of the mean of (sum_i w_i d phi_i)^2, with w_i the weights of the Gaussians in each pixel."""
    gaussians, length, d = tiny_gaussians(dtype=DOUBLE), 0.3, 0.01
    gaussians.sh.clamp_(min=-1.0)  # no colour is cut at 0
    scene, exact = objective(gaussians), 0.0
    correlation = (-(torch.cdist(scene.active.means, scene.active.means) ** 2) / (2 * length**2)).exp()
    for view in scene.views:
        one = torch.eye(len(scene.active), dtype=DOUBLE)[:, :, None].expand(-1, -1, 3)
        w = torch.stack([render_layers(scene.active, view.camera, layer, SMOOTH)[0][0] for layer in one])
        exact += d**2 * float(torch.einsum("ihw,ij,jhw->hw", w, correlation, w).mean()) / len(scene.views)
    sizes = dict.fromkeys(PARTS, 0.0) | {"colour": d}
    found = field_sharpness(gaussians, scene, poses(), length, seeded(), sizes, draws=100).loss
    assert 0 < found.error < 0.1 * exact
    assert found.value == pytest.approx(exact, abs=3 * found.error)


def test_a_field_moves_by_pixels_radians_and_shares():
    gaussians, at = tiny_gaussians(dtype=DOUBLE), poses(1)
    gaussians = gaussians.aligned_to(gaussians)
    one = {name: torch.zeros(12, 11, dtype=DOUBLE) for name in PARTS}
    for start, name in zip((0, 3, 4, 7, 8), PARTS, strict=True):
        one[name][:, start] = 1.0
    pixel, sizes = pixel_lengths(gaussians, at.cameras), dict.fromkeys(PARTS, 0.1)
    moved = {name: step(gaussians, phi, pixel, sizes) for name, phi in one.items()}
    axis = gaussians.with_flat(gaussians.flat.clone())
    axis.means.copy_(at.cameras[0].centre + torch.tensor([0.0, 0.0, 3.0]))
    pushed = step(axis, one["displacement"], pixel_lengths(axis, at.cameras), sizes)
    places = [render(each, at.cameras[0], settings=SMOOTH).splats.means for each in (axis, pushed)]
    assert torch.allclose(places[1] - places[0], torch.tensor([0.1, 0.0], dtype=DOUBLE))
    assert torch.allclose(moved["scale"].log_scales - gaussians.log_scales, torch.tensor(0.1, dtype=DOUBLE))
    turn = 2 * (moved["turn"].quats * gaussians.quats).sum(dim=1).acos()
    assert torch.allclose(turn, torch.tensor(0.1, dtype=DOUBLE))
    w, x, y, z = gaussians.quats.unbind(dim=1)  # about the world's first axis: (cos, sin, 0, 0) times q
    c, s = np.cos(0.05), np.sin(0.05)
    turned = torch.stack([c * w - s * x, c * x + s * w, c * y - s * z, c * z + s * y], dim=1)
    assert torch.allclose(moved["turn"].quats, turned)
    thick = [-(1 - each.opacity_logits.sigmoid()).log() for each in (gaussians, moved["thickness"])]
    assert torch.allclose(thick[1] / thick[0], torch.tensor(exp(0.1), dtype=DOUBLE))
    shown = render(gaussians, at.cameras[0], settings=SMOOTH), render(moved["colour"], at.cameras[0], settings=SMOOTH)
    red = (shown[1].image - shown[0].image)[0] / shown[0].alpha
    assert float(red.max()) == pytest.approx(0.1, rel=0.05)


def test_open_curvature_is_the_trace_of_the_dense_jacobians():
    gaussians, every = tiny_gaussians(4, dtype=DOUBLE), poses(3)
    gaussians = gaussians.aligned_to(gaussians)

    def blocks(camera) -> tuple[Tensor, Tensor]:
        """J^T J in blocks of the ten of the geometry, and the diagonal of the colours, by differences."""
        h = 1e-5 * torch.eye(gaussians.flat.numel(), dtype=DOUBLE)
        at = Poses([camera], every.background, SMOOTH)
        ends = [torch.stack([at.images(gaussians.with_flat(x))[0] for x in gaussians.flat + way]) for way in (h, -h)]
        J = ((ends[0] - ends[1]) / 2e-5).flatten(1).T
        parts = [J[:, rows].view(len(J), 4, -1) for rows in gaussians.blocks.values()]
        geometry = torch.einsum("kni,nij->knj", torch.cat(parts[:4], dim=2), complement(gaussians.quats))
        return torch.einsum("kni,knj->nij", geometry, geometry), parts[4].square().sum(dim=0)

    found = [blocks(camera) for camera in every.cameras]
    G, colours = (torch.stack(part[:2]).sum(dim=0) for part in zip(*found, strict=True))
    B, colours = G.clone(), colours + PRIOR * colours.mean()
    for columns in (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 10)):
        B.diagonal(dim1=1, dim2=2)[:, columns] += PRIOR * G.diagonal(dim1=1, dim2=2)[:, columns].mean()
    pixels = every.cameras[0].width * every.cameras[0].height
    U = [float((torch.linalg.inv(B) * C.mT).sum() + (c / colours).sum()) / pixels for C, c in found]
    train, new = (Poses(part, every.background, SMOOTH) for part in (every.cameras[:2], every.cameras[2:]))
    found, ratio = open_curvature(gaussians, train, new)
    assert found.value == pytest.approx(U[2], rel=1e-5)
    assert ratio == pytest.approx(U[2] / np.mean(U[:2]), rel=1e-5)
