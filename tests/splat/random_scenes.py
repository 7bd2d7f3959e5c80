"""Random cameras and Gaussians."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import Antialias, RenderSettings


def random_camera(width: int = 48, height: int = 40, seed: int = 0, focal: float = 50.0) -> Camera:
    """A turned camera near the origin that looks at (0, 0, 4) roughly; its principal point is off the centre."""
    generator = np.random.default_rng(seed)
    rotation = torch.tensor(Rotation.from_rotvec(generator.normal(size=3) * 0.1).as_matrix())
    centre = torch.tensor(generator.normal(size=3) * 0.2)
    return Camera(rotation, centre, focal, 0.9 * focal, 0.53 * width, 0.46 * height, width, height)


def random_gaussians(
    n: int,
    sh_degree: int = 0,
    seed: int = 0,
    *,
    logit: float = 0.0,
    spread: float = 1.0,
    dtype: torch.dtype = torch.float32,
) -> Gaussians:
    """Gaussians round (0, 0, 4) in float64, their parameters rounded to dtype.  logit: the mean of opacity_logits."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    attributes = {
        "means": normal(n, 3) * spread + torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64),
        "log_scales": 0.5 * normal(n, 3) - 2,
        "quats": normal(n, 4),
        "opacity_logits": 2 * normal(n) + logit,
        "sh": 0.3 * normal(n, (sh_degree + 1) ** 2, 3),
    }
    return Gaussians.pack(attributes).to(dtype).to(torch.float64)


ANTIALIASED: dict[Antialias, RenderSettings] = {
    "mip": RenderSettings(antialias="mip"),
    "mip-plain": RenderSettings(antialias="mip-plain", blur=0.1),
    "mip-splatting": RenderSettings(antialias="mip-splatting", blur=0.1),
}
MODES: dict[Antialias, RenderSettings] = {"none": RenderSettings(), **ANTIALIASED}


def filtered(gaussians: Gaussians, antialias: Antialias) -> Gaussians:
    """The Gaussians with a 3-D filter about as wide as they are, where the mode has one."""
    if antialias != "mip-splatting":
        return gaussians
    generator = torch.Generator().manual_seed(9)
    return gaussians.with_filter(0.15 * torch.rand(len(gaussians), generator=generator).double())


def random_like(shape: tuple[int, ...] | torch.Size, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
