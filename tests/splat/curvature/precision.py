"""Round-off of single precision: one view's derivatives in float32 against float64, at the same stored parameters.

Rounding also changes decisions: which of two splats at nearly one depth is in front, which pixels a splat's contour holds,
where a pixel stops, which sign a residual has.  To see rounding alone, decisions are held equal: alpha_min and
transmittance_min are NOTHING, so that either way of deciding gives the same to round-off; Gaussians whose order or colour
clamp differs between the two are taken out and counted; the target keeps a distance of CLEAR from the image.  `as trained` is
the same comparison with the training's thresholds and target, flips of decisions included.

Whitened coordinates (`splat/projection/whitening.py`) keep needles as precise as round splats: what is left is the round-off of
the passes over the pixels, the same for both.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import nan
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from analysis.bench.workloads import Workload
from splat.curvature.linearize import LinearizedView
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.formulas import lens_of
from splat.render.backend import backend_of
from splat.render.cpu.binning import depth_order
from splat.render.forward import rasterize_view
from splat.scenes.view import View

VECTORS = 2
NOTHING = 1e-8  # an alpha, or a transmittance, beneath the round-off of float32
CLEAR = 2e-5  # of pictures in 0..1: some ten times the image's error in float32


@dataclass(frozen=True)
class PrecisionLine:
    """One quantity of one view.  error: |float32 - float64| over the scale named; nan where that is 0 but for round-off."""

    decisions: str
    view: str
    quantity: str
    error: float
    scale: str
    left_out: int


def precision(workload: Workload) -> Iterator[PrecisionLine]:
    """Errors of image, gradient, H v and own-block traces, view by view, with decisions held and as trained."""
    finer = replace(workload.settings, alpha_min=NOTHING, transmittance_min=NOTHING)
    for view in workload.views:
        agreed = same_decisions(workload.gaussians, view, finer)
        kept, out = workload.gaussians.select(agreed), int((~agreed).sum())
        yield from _compare("held equal", kept, _cleared(view, kept, workload, finer), workload, finer, out)
        yield from _compare("as trained", workload.gaussians, view, workload, workload.settings, 0)


def same_decisions(gaussians: Gaussians, view: View, settings: RenderSettings) -> Bool[Tensor, " n"]:
    """The Gaussians with the same place in the order of depth, drawn, and with the same colour clamps in either precision."""
    found = []
    for dtype in (torch.float32, torch.float64):
        there = backend_of(gaussians.flat).project(gaussians.to(dtype), lens_of(view.camera, settings))
        splats, depths, drawn = (tensor.cpu().numpy() for tensor in there)
        order = depth_order(depths, drawn)
        place = np.full(len(drawn), -1)
        place[order] = np.arange(len(order))
        found.append(np.concatenate([place[:, None], drawn[:, None], splats[:, 6:] > 0], axis=1))
    return torch.from_numpy((found[0] == found[1]).all(axis=1))


def _cleared(view: View, gaussians: Gaussians, workload: Workload, settings: RenderSettings) -> View:
    """The view with its picture moved away from the image where a residual's sign is in doubt."""
    raster = rasterize_view(gaussians.to(torch.float64), view.camera, workload.background.double(), settings)
    image = raster.crop(raster.planes[:3]).cpu()
    residual = image - view.image.double()
    side = torch.where(residual < 0, -1.0, 1.0)
    return replace(view, image=(image - side * residual.abs().clamp_min(CLEAR)).float())


def _compare(
    decisions: str, gaussians: Gaussians, view: View, workload: Workload, settings: RenderSettings, left_out: int
) -> Iterator[PrecisionLine]:
    double = gaussians.to(torch.float64)
    double.quats.div_(double.quats.norm(dim=1, keepdim=True))
    single = double.to(torch.float32)
    U = torch.randn(len(single.flat), VECTORS, generator=torch.Generator().manual_seed(0)).to(single.flat)
    rough = _derivatives(single, view, workload, settings, U)
    exact = _derivatives(single.to(torch.float64), view, workload, settings, U.double())
    for name in ("image", "gradient"):
        yield PrecisionLine(decisions, view.name, name, relative(rough[name], exact[name]), "norm", left_out)
    for k in range(VECTORS):
        error = relative(rough["H v"][:, k], exact["H v"][:, k])
        yield PrecisionLine(decisions, view.name, f"H v, vector {k}", error, "norm", left_out)
    total = sum(absolute for _, absolute in exact["traces"].values())
    for name, (trace, _) in rough["traces"].items():
        truth, absolute = exact["traces"][name]
        flat = absolute <= torch.finfo(torch.float64).eps * total  # rotations of round Gaussians: there is no scale
        error = nan if flat else abs(trace - truth) / absolute
        yield PrecisionLine(decisions, view.name, f"trace of {name}", error, "sum of |diagonal|", left_out)


def _derivatives(
    gaussians: Gaussians, view: View, workload: Workload, settings: RenderSettings, U: Tensor
) -> dict[str, Any]:
    flat = gaussians.flat
    loss = backend_of(flat).view_loss(view.image, workload.loss, flat)
    held = LinearizedView(gaussians, view.camera, loss, workload.background.to(flat), settings)
    diagonals = held.block_diagonal(approximate=True).diagonals
    traces = {name: (float(part.sum()), float(part.abs().sum())) for name, part in diagonals.items()}
    return {"image": held.image, "gradient": held.gradient, "H v": held.hvp(U), "traces": traces}


def relative(rough: Tensor, exact: Tensor) -> float:
    """|rough - exact| / |exact| in the 2-norm."""
    return float((rough.double() - exact).norm() / exact.norm())
