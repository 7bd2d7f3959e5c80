"""Random cameras and Gaussians, the tolerances of the kernels, and how errors are measured.

IMAGE and DERIVATIVE are the relative errors promised for the kernels against the float64 specification.
"""

from collections.abc import Mapping

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import Antialias, RenderSettings

IMAGE = {torch.float32: 1e-6, torch.float64: 1e-12}
DERIVATIVE = {torch.float32: 1e-5, torch.float64: 1e-12}
DTYPES = (torch.float32, torch.float64)
NUMPY = {torch.float32: np.float32, torch.float64: np.float64}


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


def relative_error(got: Tensor | np.ndarray, expected: Tensor | np.ndarray) -> float:
    """|got - expected| / |expected| in the 2-norm; infinite where got is not finite or of another shape."""
    got, expected = torch.as_tensor(got).detach().double(), torch.as_tensor(expected).detach().double()
    if got.shape != expected.shape or not torch.isfinite(got).all():
        return float("inf")
    difference, size = float((got - expected).norm()), float(expected.norm())
    return difference / size if size else difference


def errors_by_block(got: Tensor, expected: Tensor, blocks: Mapping[str, slice]) -> dict[str, float]:
    """The relative error of every attribute's rows."""
    return {name: relative_error(got[rows], expected[rows]) for name, rows in blocks.items()}
