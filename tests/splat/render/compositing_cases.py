"""Views to composite, and everything the kernels compute of them in the float64 specification.

A case's splats are rounded to float32, so that kernels of both precisions and the specification start from the same
numbers.  Pixels in which float32 may decide otherwise than float64 (`undecided`) get no weight in any derivative and are
left out of the image: their share is counted and bounded.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from splat.model.settings import RenderSettings
from splat.projection.reference import Splats, project
from splat.render.backend import Adjoint, Raster, Tangent, coefficients_of, plain_gradient
from splat.render.cpu.raster import CpuRaster
from splat.render.reference import rasterize_reference
from tests.splat.random_scenes import random_camera, random_gaussians, random_like
from tests.splat.tiny import SMOOTH

BLOCKS = {"means": slice(0, 2), "conics": slice(2, 5), "opacities": slice(5, 6), "colours": slice(6, 9)}
DIRECTIONS = 4
BACKGROUND = torch.tensor([0.25, 0.5, 0.875], dtype=torch.float64)
# log2 alpha is a sum of terms up to 2^6 in size wherever it is near a threshold; their rounding errors in float32 stay
# below 2^6 2^-24 each.
UNDECIDED = 2.0**-15


@dataclass(frozen=True)
class Case:
    n: int
    size: tuple[int, int] = (75, 53)
    logit: float = 0.0
    settings: RenderSettings = RenderSettings()
    layers: int | None = None
    spread: float = 1.0
    focal: float = 40.0


CASES = {
    "typical": Case(200),
    "opaque": Case(400, logit=4.0, spread=0.6),
    "walled": Case(300, size=(37, 24), logit=6.0, spread=0.4, focal=150.0),
    "capped": Case(60, logit=6.0, settings=RenderSettings(transmittance_min=1e-7)),
    "smooth": Case(60, settings=SMOOTH),
    "three sigma": Case(100, logit=2.0, settings=RenderSettings(contour_sigma=3.0)),
    "through the cap": Case(100, logit=4.0, settings=RenderSettings(gradient_through_cap=True)),
    "equal depths": Case(100, logit=1.0, layers=3),
    "one": Case(1),
    "one row": Case(40, size=(40, 1)),
    "one column": Case(40, size=(1, 40)),
    "less than a tile": Case(40, size=(7, 9)),
}


# few enough entries for a machine without a GPU: in one tile of 16 x 16 pixels all that the cases above have
TINY = {
    "tiny walled": Case(14, size=(4, 3), logit=9.0, spread=0.02, focal=200.0),
    "tiny capped": Case(
        5, size=(9, 12), logit=9.0, spread=0.1, focal=120.0, settings=RenderSettings(transmittance_min=1e-9)
    ),
    "tiny smooth": Case(5, size=(10, 10), focal=20.0, settings=SMOOTH),
    "tiny three sigma": Case(6, size=(12, 8), logit=2.0, focal=20.0, settings=RenderSettings(contour_sigma=3.0)),
    "tiny through the cap": Case(
        5, size=(9, 12), logit=9.0, spread=0.1, focal=120.0, settings=RenderSettings(gradient_through_cap=True)
    ),
    "tiny equal depths": Case(6, size=(20, 9), logit=1.0, layers=2, focal=20.0),
}


@dataclass(frozen=True)
class Truth:
    """What the specification says of a case; G: cotangent (4, h, w), dG and U: K tangents of it and of the splats."""

    case: Case
    splats: Tensor
    depths: Tensor
    drawn: Tensor
    decided: Tensor
    planes: Tensor
    G: Tensor
    dG: Tensor
    U: Tensor
    gradient: Tensor
    jvp: Tensor
    curvature: Tensor

    def raster(self, dtype: torch.dtype) -> CpuRaster:
        """The same view by the kernels."""
        return CpuRaster(
            self.splats, self.depths.to(dtype), self.drawn, BACKGROUND, *self.case.size, self.case.settings
        )


def plain_jvp(raster: Raster, U: Tensor) -> Tangent:
    """J u of plain tangents (n, k, 9)."""
    return raster.jvp(torch.stack([coefficients_of(raster.splats, u.contiguous()) for u in U.unbind(1)], dim=1))


def plain_product(raster: Raster, tangent: Tangent, adjoint: Adjoint, dG: Tensor) -> Tensor:
    """The tangent of the plain gradient, (n, k, 9)."""
    product = tangent.backward_tangent(adjoint, dG)
    return torch.stack([plain_gradient(raster.splats, each.contiguous()) for each in product.unbind(1)], dim=1)


def composite(splats: Tensor, depths: Tensor, drawn: Tensor, case: Case) -> Tensor:
    """The specification's colour and alpha planes (4, h, w) of splats (n, 9)."""
    means, conics, opacities, colours = splats.split((2, 3, 1, 3), dim=1)
    parts = Splats(means, conics, opacities[:, 0], colours, depths, drawn)
    image, alpha, _ = rasterize_reference(parts, BACKGROUND, *case.size, case.settings)
    return torch.cat([image, alpha[None]])


@cache
def truth(name: str) -> Truth:
    case = (CASES | TINY)[name]
    width, height = case.size
    camera = random_camera(width, height, focal=case.focal)
    projected = project(random_gaussians(case.n, logit=case.logit, spread=case.spread), camera, case.settings)
    parts = (projected.means, projected.conics, projected.opacities[:, None], projected.colours)
    splats, depths = torch.cat(parts, dim=1).float().double(), projected.depths.float().double()
    if case.layers:
        depths = 1.0 + torch.arange(case.n, dtype=torch.float64) % case.layers
    drawn = projected.drawn
    decided = ~undecided(splats, depths, drawn, case)
    U = random_like((case.n, DIRECTIONS, 9), 1) * direction_scale(splats)[:, None]
    G, dG = random_like((4, height, width), 2) * decided, random_like((DIRECTIONS, 4, height, width), 3) * decided
    G, dG, U = G.float().double(), dG.float().double(), U.float().double()

    Y, W = splats.clone().requires_grad_(), G.clone().requires_grad_()
    planes = composite(Y, depths, drawn, case)
    (gradient,) = torch.autograd.grad(planes, Y, W, create_graph=True)
    jvps, curvatures = [], []
    for k in range(DIRECTIONS):
        second, jvp = torch.autograd.grad((gradient * U[:, k]).sum(), (Y, W), retain_graph=True)
        (first,) = torch.autograd.grad(planes, Y, dG[k], retain_graph=True)
        jvps.append(jvp)
        curvatures.append(second + first)
    return Truth(
        case, splats, depths, drawn, decided, planes.detach(), G, dG, U, gradient.detach(), torch.stack(jvps),
        torch.stack(curvatures, dim=1),
    )  # fmt: skip


def direction_scale(splats: Tensor) -> Tensor:
    """The size of a sensible step of every number of a splat: (n, 9)."""
    scale = torch.full_like(splats, 0.3)
    scale[:, 2:5] = 0.3 * splats[:, [2, 4]].mean(dim=1, keepdim=True)
    scale[:, 5] = 0.3 * splats[:, 5]
    return scale


def undecided(splats: Tensor, depths: Tensor, drawn: Tensor, case: Case) -> Tensor:
    """Pixels (h, w) in which some threshold is nearer than round-off in float32 can tell."""
    settings, (width, height) = case.settings, case.size
    order = torch.argsort(depths, stable=True)
    order = order[drawn[order]]
    mx, my, a, b, c, opacity = splats[order, :6].T[:, :, None, None]
    dx = torch.arange(width, dtype=torch.float64) + 0.5 - mx
    dy = torch.arange(height, dtype=torch.float64)[:, None] + 0.5 - my
    squared = a * dx * dx + 2 * b * dx * dy + c * dy * dy
    level = torch.log2(opacity) - squared / (2 * np.log(2))
    near = torch.zeros(height, width, dtype=torch.bool)
    active = torch.ones_like(level, dtype=torch.bool)
    if settings.alpha_min:
        active &= level >= np.log2(settings.alpha_min)
        near |= ((level - np.log2(settings.alpha_min)).abs() < UNDECIDED).any(dim=0)
    if settings.contour_sigma is not None:
        active &= squared <= settings.contour_sigma**2
        near |= ((squared - settings.contour_sigma**2).abs() < UNDECIDED).any(dim=0)
    near |= (active & ((level - np.log2(settings.alpha_max)).abs() < UNDECIDED)).any(dim=0)
    alpha = torch.where(active, torch.exp2(level).clamp_max(settings.alpha_max), 0.0)
    after = torch.log2(1 - alpha).cumsum(0)
    if settings.transmittance_min:  # round-off of T grows with the number of factors and with 1 / (1 - alpha) <= 100
        near |= ((after - np.log2(settings.transmittance_min)).abs() < 100 * UNDECIDED).any(dim=0)
    return near
