"""How a view sees each Gaussian, against weights that are composited pixel by pixel in plain torch."""

import pytest
import torch
from torch import Tensor

from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.reference import project
from splat.render.sight import sight
from tests.splat.random_scenes import random_camera, random_gaussians
from tests.splat.tiny import SMOOTH


def weights(gaussians: Gaussians, camera: Camera, settings: RenderSettings) -> tuple[Tensor, list[int]]:
    """(n, h, w) alpha T of every Gaussian in every pixel, and the Gaussians in the order in which they are drawn."""
    splats = project(gaussians, camera, settings)
    y, x = torch.meshgrid(*(torch.arange(size).double() + 0.5 for size in (camera.height, camera.width)), indexing="ij")
    order = [i for i in splats.depths.argsort(stable=True).tolist() if splats.drawn[i]]
    found = torch.zeros(len(gaussians), camera.height, camera.width, dtype=torch.float64)
    T, running = torch.ones_like(found[0]), torch.ones_like(found[0], dtype=torch.bool)
    for i in order:
        dx, dy = x - splats.means[i, 0], y - splats.means[i, 1]
        a, b, c = splats.conics[i]
        alpha = splats.opacities[i] * torch.exp(-(a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2)
        alpha = torch.where(alpha >= settings.alpha_min, alpha.clamp_max(settings.alpha_max), 0)
        running &= T * (1 - alpha) >= settings.floor(torch.float64)
        found[i] = torch.where(running, alpha * T, 0)
        T = torch.where(running, T * (1 - alpha), T)
    return found, order


@pytest.mark.parametrize(("logit", "spread"), [(0.0, 1.0), (5.0, 0.5)], ids=["thin", "pixels that stop"])
@pytest.mark.parametrize("size", [(48, 40), (21, 13), (1, 7)], ids=str)
def test_sight_is_that_of_pixels_composited_one_by_one(size, logit, spread):
    gaussians = random_gaussians(60, seed=2, logit=logit, spread=spread)
    camera, settings = random_camera(*size), RenderSettings()
    found, (w, order) = sight(gaussians, camera, settings), weights(gaussians, camera, settings)
    assert torch.allclose(found.weight, w.sum(dim=(1, 2)), rtol=1e-10, atol=1e-12)
    assert torch.equal(found.pixels, (w > 0).sum(dim=(1, 2)))
    for place, i in enumerate(order):
        sharing = [j for j in order[:place] if ((w[i] > 0) & (w[j] > 0)).any()]
        assert found.front[i] == (sharing[-1] if sharing else -1)
    has = found.front >= 0
    z = found.depths
    assert torch.equal(found.gap[has], (camera.fx * (z - z[found.front]) / z)[has]) and found.gap[~has].isinf().all()
    kappa = torch.linalg.cond(_covariances(gaussians, camera, settings))
    assert torch.allclose(found.condition[found.seen], kappa[found.seen], rtol=1e-8)
    assert (found.condition[~found.seen] == 1).all()


def _covariances(gaussians: Gaussians, camera: Camera, settings: RenderSettings) -> Tensor:
    a, b, c = project(gaussians, camera, settings).conics.unbind(dim=1)
    return torch.linalg.inv(torch.stack([torch.stack([a, b], 1), torch.stack([b, c], 1)], 2))


def test_the_order_changes_where_the_gap_says():
    camera = Camera(torch.eye(3).double(), torch.zeros(3).double(), 30.0, 30.0, 16.0, 16.0, 32, 32)
    layers = _layers([4.0, 4.1, 6.0])
    gap = sight(layers, camera, SMOOTH).gap
    assert gap[1].item() == pytest.approx(30 * 0.1 / 4.1) and gap[2].item() == pytest.approx(30 * 1.9 / 6)
    for share, swapped in ((0.999, False), (1.001, True)):
        moved = _layers([4.0, 4.1 - share * gap[1].item() * 4.1 / 30, 6.0])
        assert (sight(moved, camera, SMOOTH).front[0] == 1) == swapped


def _layers(depths: list[float]) -> Gaussians:
    n = len(depths)
    means = torch.zeros(n, 3, dtype=torch.float64)
    means[:, 2] = torch.tensor(depths)
    sh = torch.zeros(n, 1, 3, dtype=torch.float64)
    quats = torch.eye(4, dtype=torch.float64)[:1].repeat(n, 1)
    scales, logits = torch.full((n, 3), -0.5, dtype=torch.float64), torch.zeros(n, dtype=torch.float64)
    return Gaussians.pack({"means": means, "log_scales": scales, "quats": quats, "opacity_logits": logits, "sh": sh})
