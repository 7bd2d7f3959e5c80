"""Front-to-back compositing of splats in plain torch: the specification of the kernels.

Works in any float type and differentiates any number of times, at the price of time and memory.  Per pixel p, splats in
order of depth, d = p - mean:

    alpha = min(alpha_max, opacity exp(-(a dx^2 + 2 b dx dy + c dy^2) / 2)), 0 where that is below alpha_min
    w     = alpha T,  T <- T - w;  the pixel stops before T would fall below transmittance_min
    colour = sum w colour_i + T background,  alpha of the pixel = 1 - T,  expected depth = sum w z_i

The order, the alpha_min cut and the stop are constants under differentiation: they are piecewise constant.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from splat.model.settings import RenderSettings
from splat.projection.reference import Splats

TILE = 16


def rasterize_reference(
    splats: Splats,
    background: Float[Tensor, "3"],
    width: int,
    height: int,
    settings: RenderSettings = RenderSettings(),
    tile: int = TILE,
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Colour, accumulated alpha and expected depth of one view, tile by tile.

    Splats of the same depth are composited in the order of their index.  tile: pixels along a tile's edge; larger ones take
    less time for few splats, and more memory for many.
    """
    order = torch.argsort(splats.depths, stable=True)
    order = order[splats.drawn[order]]
    reach = _reach(splats, settings)[order]
    centres = splats.means.detach()[order]
    rows = []
    for top in range(0, height, tile):
        row = []
        for left in range(0, width, tile):
            xs, ys = (
                torch.arange(first, min(first + tile, size), dtype=centres.dtype, device=centres.device) + 0.5
                for first, size in ((left, width), (top, height))
            )
            low, high = torch.stack([xs[0], ys[0]]), torch.stack([xs[-1], ys[-1]])
            touched = ((centres + reach >= low) & (centres - reach <= high)).all(dim=1)
            row.append(_composite(splats, order[touched], background, xs, ys, settings))
        rows.append(torch.cat(row, dim=2))
    image = torch.cat(rows, dim=1)
    return image[:3], image[3], image[4]


def _reach(splats: Splats, settings: RenderSettings) -> Float[Tensor, "n 2"]:
    """Half-extent in x and y of each splat's alpha_min contour (infinite without one), a little more than exact."""
    a, b, c = splats.conics.detach().unbind(-1)
    level = (
        2 * torch.log(splats.opacities.detach() / settings.alpha_min)
        if settings.alpha_min
        else torch.full_like(a, torch.inf)
    )
    level = level * 1.001 + 1e-3
    return torch.stack([c, a], dim=-1).mul(level[:, None]).div((a * c - b * b)[:, None]).clamp_min(0).sqrt() + 1e-3


def _alphas(splats: Splats, index: Tensor, xs: Tensor, ys: Tensor, settings: RenderSettings) -> Float[Tensor, "m h w"]:
    dx = xs - splats.means[index, 0, None]
    dy = ys - splats.means[index, 1, None]
    a, b, c = splats.conics[index].unbind(-1)
    squared = (a[:, None] * dx * dx)[:, None, :] + (c[:, None] * dy * dy)[:, :, None]
    squared = squared + 2 * (b[:, None] * dx)[:, None, :] * dy[:, :, None]
    alpha = splats.opacities[index, None, None] * torch.exp(-squared / 2)
    capped = alpha.clamp_max(settings.alpha_max)
    if settings.gradient_through_cap:
        capped = capped.detach() * (alpha / torch.where(alpha > 0, alpha, 1).detach())  # alpha may underflow
    active = alpha >= settings.alpha_min
    if settings.contour_sigma is not None:
        active = active & (squared <= settings.contour_sigma**2)
    return torch.where(active, capped, torch.zeros_like(capped))


def _composite(
    splats: Splats, index: Tensor, background: Tensor, xs: Tensor, ys: Tensor, settings: RenderSettings
) -> Tensor:
    """One tile, (5, h, w): colour, alpha, depth."""
    alpha = _alphas(splats, index, xs, ys, settings)
    before, after = _transmittances(alpha)
    # the first splat that would pass the floor ends it
    running = (after >= settings.floor(after.dtype)).cumprod(0).bool()
    alpha = torch.where(running, alpha, torch.zeros_like(alpha))
    before, after = _transmittances(alpha)
    weight = alpha * before
    last = after[-1] if len(index) else background.new_ones(len(ys), len(xs))
    colour = torch.einsum("mhw,mc->chw", weight, splats.colours[index]) + last * background[:, None, None]
    depth = torch.einsum("mhw,m->hw", weight, splats.depths[index])
    return torch.cat([colour, (1 - last)[None], depth[None]])


def _transmittances(alpha: Float[Tensor, "m h w"]) -> tuple[Tensor, Tensor]:
    """The transmittance before and after each splat; in logarithms, so that its derivatives never divide by 0."""
    log_after = torch.log1p(-alpha).cumsum(0)
    after = log_after.exp()
    return torch.cat([torch.ones_like(after[:1]), after])[: len(alpha)], after
