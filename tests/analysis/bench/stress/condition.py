"""The plain torch specification in float64, by autograd, exact and with every intermediate number perturbed.

`Condition` measures the effect of perturbations on a quantity Q.  Every number that one stage passes to the next (parameters,
splats, the three terms of the exponent and alpha in every pixel, pixels, the blurs of SSIM) is multiplied by 1 + d s, s random
signs; autograd passes the adjoints through the same factors:

    K(Q) = sqrt(mean |Q(d) - Q|^2) / d sqrt(DRAWS / chi^2)        over DRAWS draws of signs, d = STEP

chi^2: the 1% quantile with DRAWS degrees of freedom, for the sampling error of the mean where few signs dominate it, as for
needles.  The order of the splats is fixed; no pixel is near a threshold (`analysis.bench.stress`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import sqrt

import torch
from scipy.stats import chi2
from torch import Tensor

from analysis.bench.stress import BACKGROUND, Case
from splat.losses.reference import C1, C2, LossSettings, blur
from splat.model.gaussians import Gaussians
from splat.projection.reference import Splats, project
from splat.render.reference import rasterize_reference
from tests.splat.photometric import pixel_loss

STEP, DRAWS = 1e-9, 6
SAMPLING = sqrt(DRAWS / chi2.ppf(0.01, DRAWS))
Rounded = Callable[[Tensor], Tensor]


def exactly(x: Tensor) -> Tensor:
    return x


def roundings(seed: int) -> Rounded:
    """x -> x (1 + STEP s), s random signs: a relative error of known size in every number."""
    generator = torch.Generator().manual_seed(seed)

    def rounded(x: Tensor) -> Tensor:
        signs = torch.randint(0, 2, x.shape, generator=generator, dtype=x.dtype) * 2 - 1
        return x * (1 + STEP * signs)

    return rounded


def specified_loss(image: Tensor, target: Tensor, loss: LossSettings, rounded: Rounded) -> Tensor:
    """`photometric_loss`, with `rounded` applied to the blurs and their arguments."""
    value = loss.pixel_weight * pixel_loss(image, target, loss.pixel, loss.eps)
    if not loss.ssim_weight:
        return value
    fields = blur(rounded(torch.cat([image, target, image * image, target * target, image * target])))
    mu_x, mu_y, xx, yy, xy = rounded(fields).chunk(5)
    luminance = (2 * mu_x * mu_y + C1) / (mu_x * mu_x + mu_y * mu_y + C1)
    structure = (2 * (xy - mu_x * mu_y) + C2) / (xx - mu_x * mu_x + yy - mu_y * mu_y + C2)
    return value + loss.ssim_weight * (1 - (luminance * structure).mean())


@dataclass(frozen=True, eq=False)
class Specified:
    """The specification's values at a point: image (3, h, w), gradient (p,), H U (p, k), Gauss-Newton times U[:, 0]."""

    image: Tensor
    gradient: Tensor
    products: Tensor
    gauss_newton: Tensor


def composited(splats: Splats, case: Case, rounded: Rounded) -> Tensor:
    """The image of `reference.rasterize_reference`, in one tile, with `rounded` applied in every pixel."""
    order = torch.argsort(splats.depths, stable=True)
    order = order[splats.drawn[order]]
    x, y = torch.arange(case.camera.width) + 0.5, torch.arange(case.camera.height) + 0.5
    mean, conic = splats.means[order], splats.conics[order, :, None, None]
    dx, dy = (x - mean[:, :1])[:, None, :], (y - mean[:, 1:])[:, :, None]
    terms = rounded(
        torch.stack([conic[:, 0] * dx * dx + 0 * dy, 2 * conic[:, 1] * dx * dy, conic[:, 2] * dy * dy + 0 * dx])
    )
    alpha = rounded(splats.opacities[order, None, None] * torch.exp(-terms.sum(dim=0) / 2))
    drawn = alpha >= case.settings.alpha_min
    alpha = torch.where(drawn, alpha.clamp_max(case.settings.alpha_max), torch.zeros_like(alpha))
    running = (1 - alpha).cumprod(0) >= case.settings.transmittance_min
    alpha = torch.where(running.cumprod(0).bool(), alpha, torch.zeros_like(alpha))
    after = torch.log1p(-alpha).cumsum(0).exp()
    before = torch.cat([torch.ones_like(after[:1]), after])
    colour = torch.einsum("mhw,mc->chw", alpha * before[:-1], splats.colours[order])
    return colour + before[-1] * BACKGROUND[:, None, None]


def specified(case: Case, point: Gaussians, loss: LossSettings, U: Tensor, rounded: Rounded | None = None) -> Specified:
    """The specification's values and derivatives; perturbed by `rounded` where given."""
    camera, target, flat = case.camera, case.target.double(), point.flat.clone().requires_grad_()
    if rounded is None:
        rounded, size = exactly, (camera.width, camera.height)
        splats = project(point.with_flat(flat), camera, case.settings)
        image = rasterize_reference(splats, BACKGROUND, *size, case.settings, tile=max(size))[0]
    else:
        splats = project(point.with_flat(rounded(flat)), camera, case.settings)
        parts = {name: rounded(getattr(splats, name)) for name in ("means", "conics", "opacities", "colours")}
        exact = project(point, camera, case.settings)  # for the order and the set of drawn splats
        image = rounded(composited(replace(exact, **parts), case, rounded))
    (gradient,) = torch.autograd.grad(specified_loss(image, target, loss, rounded), flat, create_graph=True)
    (products,) = torch.autograd.grad(gradient, flat, U.T, is_grads_batched=True, retain_graph=True)
    weight = torch.zeros_like(image, requires_grad=True)
    (vjp,) = torch.autograd.grad(image, flat, weight, create_graph=True)
    (jvp,) = torch.autograd.grad(vjp, weight, U[:, 0], retain_graph=True)
    pixels = image.detach().requires_grad_()
    (slope,) = torch.autograd.grad(specified_loss(pixels, target, loss, rounded), pixels, create_graph=True)
    (cotangent,) = torch.autograd.grad(slope, pixels, jvp)
    (gauss_newton,) = torch.autograd.grad(image, flat, cotangent)
    return Specified(image.detach(), gradient.detach(), products.T, gauss_newton)


@dataclass(frozen=True, eq=False)
class Condition:
    """(Q(d) - Q) / d of every quantity, for each draw of signs."""

    draws: list[Specified]

    @classmethod
    def of(cls, case: Case, point: Gaussians, loss: LossSettings, U: Tensor, seed: int) -> "Condition":
        exact = vars(specified(case, point, loss, U, exactly))
        moved = [vars(specified(case, point, loss, U, roundings(seed + draw))) for draw in range(DRAWS)]
        changes = [{name: (one[name] - value) / STEP for name, value in exact.items()} for one in moved]
        return cls([Specified(**change) for change in changes])

    def __call__(self, quantity: str, rows: object = slice(None)) -> float:
        """K of these rows of a quantity."""
        squares = [vars(draw)[quantity][rows].norm() ** 2 for draw in self.draws]
        return SAMPLING * float(torch.stack(squares).mean().sqrt())


def cancellation(case: Case, point: Gaussians) -> float:
    """C: largest cancellation over the splats in blocks that are summed from moments of the offsets d = (x, y).

    sum w (Q d)^2 is computed from sum w x^2, ..., whose terms are as large as (|Q| |d|)^2, while |Q d|^2 <= |Q| d.Q d: a
    factor of |Q| |d|^2 / d.Q d, at the edge of the splat (level d.Q d = 2 ln(o / alpha_min)) and within the image.
    """
    splats = project(point, case.camera, case.settings)
    a, b, c = splats.conics[splats.drawn].T
    level = 2 * torch.log(
        splats.opacities[splats.drawn] / max(case.settings.alpha_min, torch.finfo(torch.float32).tiny)
    )
    extents = (
        level.clamp_min(0) / (a * c - b * b)[None].clamp_min(torch.finfo(a.dtype).tiny) * torch.stack([c, a])
    ).sqrt()
    x, y = extents[0].clamp_max(case.camera.width), extents[1].clamp_max(case.camera.height)
    terms = a * x * x + 2 * b.abs() * x * y + c * y * y
    return float((terms / level.clamp_min(1)).max().clamp_min(1))
