"""Renders under each preset against the tool's published equations, written out in NumPy for scenes made by hand."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.harmonics import Y00
from splat.render.render import render
from splat.training.origin.presets import PRESETS

WIDTH, HEIGHT, FX, FY = 24, 18, 30.0, 32.0
# graphdeco: forward.cu, auxiliary.h; gsplat: _constants.py, Projection, Rasterize; nerfstudio: splatfacto.py by gsplat 1.x;
# Brush: rasterize.rs, helpers.rs.  (alpha cap, near plane, whether the camera's principal point is used)
PUBLISHED = {
    "graphdeco": (0.99, 0.2, False),
    "gsplat": (0.999, 0.01, True),
    "gsplat-raw": (0.999, 0.01, True),
    "gsplat-1.6": (0.99, 0.01, True),
    "nerfstudio": (0.999, 0.01, True),
    "brush": (0.999, 0.2, True),
    "lichtfeld": (0.99, 0.2, True),
}
BLUR, LEAST, STOP = 0.3, 1 / 255, 1e-4
BACKGROUND = np.array([0.2, 0.4, 0.1])


def scene() -> dict[str, np.ndarray]:
    """Opaque and faint Gaussians, one between the two near planes, one behind all, a thin one, and eight behind each other."""
    stack = [(0.05 * i, -0.04 * i, 3.0 + 0.1 * i) for i in range(8)]
    means = np.array([(0.1, 0.05, 2.0), (-0.4, 0.3, 2.5), (0.01, 0.0, 0.1), (0.0, 0.0, -1.0), (0.5, -0.3, 2.2), *stack])
    n = len(means)
    random = np.random.default_rng(0)
    scales = np.exp(random.normal(-2.2, 0.4, (n, 3)))
    scales[2], scales[4] = 0.004, (0.3, 0.002, 0.05)
    opacity = np.array([0.9999, 0.3, 0.5, 0.9, 0.8, *[0.95] * 8])
    return {
        "means": means,
        "scales": scales,
        "quats": random.normal(size=(n, 4)),
        "opacity": opacity,
        "rgb": random.uniform(0.1, 0.9, (n, 3)),
    }


def published(s: dict[str, np.ndarray], cap: float, near: float, cx: float, cy: float) -> np.ndarray:
    """C = sum_i c_i a_i prod_(j < i) (1 - a_j), a = min(cap, o exp(-d S^-1 d / 2)), S = J Q Q^T J^T + 0.3, front to back."""
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    image, light, stopped = np.zeros((3, HEIGHT, WIDTH)), np.ones((HEIGHT, WIDTH)), np.zeros((HEIGHT, WIDTH), bool)
    for i in np.argsort(s["means"][:, 2], kind="stable"):
        x, y, z = s["means"][i]
        if z <= near:
            continue
        turn = Rotation.from_quat(np.roll(s["quats"][i], -1)).as_matrix()  # which has the real part last
        J = np.array([[FX / z, 0, -FX * x / z**2], [0, FY / z, -FY * y / z**2]])
        half = J @ turn @ np.diag(s["scales"][i])
        inverse = np.linalg.inv(half @ half.T + BLUR * np.eye(2))
        dx, dy = column - (FX * x / z + cx), row - (FY * y / z + cy)
        power = -0.5 * (inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2)
        alpha = np.minimum(cap, s["opacity"][i] * np.exp(power))
        alpha = np.where(alpha < LEAST, 0, alpha)
        stopped |= light * (1 - alpha) < STOP
        alpha = np.where(stopped, 0, alpha)
        image += s["rgb"][i][:, None, None] * alpha * light
        light = light * (1 - alpha)
    return image + BACKGROUND[:, None, None] * light


@pytest.mark.parametrize("name", PUBLISHED)
def test_renders_follow_each_tools_published_equations(name):
    s, (cap, near, own) = scene(), PUBLISHED[name]
    preset = PRESETS[name]
    assert preset.centred is not own
    cx, cy = (WIDTH / 2 + 1.3, HEIGHT / 2 - 0.7) if own else (WIDTH / 2, HEIGHT / 2)
    camera = Camera(torch.eye(3), torch.zeros(3), FX, FY, cx, cy, WIDTH, HEIGHT)
    made = {
        "means": s["means"],
        "log_scales": np.log(s["scales"]),
        "quats": s["quats"],
        "opacity_logits": np.log(s["opacity"] / (1 - s["opacity"])),
        "sh": (s["rgb"][:, None] - 0.5) / Y00,
    }
    gaussians = Gaussians.pack({key: torch.from_numpy(value) for key, value in made.items()})
    found = render(gaussians, camera, torch.from_numpy(BACKGROUND), preset.render).image.numpy()
    expected = published(s, cap, near, cx, cy)
    assert np.abs(found - expected).max() < 1e-6
    for other in ((0.95, near, cx, cy), (cap, 0.05 if near == 0.2 else 0.2, cx, cy), (cap, near, cx + 0.5, cy)):
        assert np.abs(found - published(s, *other)).max() > 1e-3  # the scene would show it
