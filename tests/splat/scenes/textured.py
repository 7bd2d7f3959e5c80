"""Pictures of two textured planes that meet, z = |x| / 2, computed ray by ray: what features can be found and matched in."""

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, map_coordinates

from splat.model.camera import Camera, look_at
from splat.scenes.view import View

WIDTH, HEIGHT, FOCAL = 112, 84, 100.0
DISTANCE = 3.0
TEXELS = 75  # per unit: about two a pixel


def texture() -> np.ndarray:
    """Noise of two grains, in three colours, values in [0, 1]."""
    random = np.random.default_rng(5)
    size = 4 * TEXELS
    grains = [gaussian_filter(random.normal(size=(3, size, size)), (0, s, s), mode="wrap") * s for s in (3.0, 9.0)]
    return 1 / (1 + np.exp(-8 * sum(grains)))


def cameras(n: int, off_centre: tuple[float, float] = (0, 0)) -> list[Camera]:
    """On an arc before the edge, at changing heights, looking at its middle; off_centre: of the principal point, px."""
    target = torch.tensor([0.0, 0.0, 0.25], dtype=torch.float64)
    down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    result = []
    for i, angle in enumerate(np.deg2rad(np.linspace(-20, 20, n))):
        offset = torch.tensor([np.sin(angle), 0.15 * (-1) ** i, -np.cos(angle)], dtype=torch.float64)
        centre = target + DISTANCE * offset
        rotation = look_at(centre, target, down)
        cx, cy = WIDTH / 2 + off_centre[0], HEIGHT / 2 + off_centre[1]
        result.append(Camera(rotation, centre, FOCAL, FOCAL, cx, cy, WIDTH, HEIGHT))
    return result


def picture(camera: Camera, colours: np.ndarray) -> np.ndarray:
    """(h, w, 3); the surface's colour at (x, y) is that of the texture there."""
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones_like(row)], axis=-1)
    rays, (x, y, z) = local @ camera.rotation.numpy(), camera.centre.numpy()
    nearest = np.full(row.shape, np.inf)
    for side in (-0.5, 0.5):  # z = side x, where side x >= 0
        along = (side * x - z) / (rays[..., 2] - side * rays[..., 0])
        met = (along > 0) & (side * (x + along * rays[..., 0]) >= 0)
        nearest = np.where(met & (along < nearest), along, nearest)
    places = np.stack([y + nearest * rays[..., 1], x + nearest * rays[..., 0]]) * TEXELS
    return np.stack([map_coordinates(layer, places, order=1, mode="grid-wrap") for layer in colours], axis=-1)


def views(n: int, off_centre: tuple[float, float] = (0, 0)) -> list[View]:
    colours, posed = texture(), cameras(n, off_centre)
    images = [torch.from_numpy(picture(camera, colours)).permute(2, 0, 1).float() for camera in posed]
    return [View(f"place/{i}", camera, image) for i, (camera, image) in enumerate(zip(posed, images))]
