"""The fields of a map in files that other programs open: PLYs of Gaussians, and a table."""

import numpy as np
import pandas as pd
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from analysis.records.quantities import GREY, Shade
from splat.curvature.fields import Values
from splat.curvature.objective import SceneObjective
from splat.model.files.splat_ply import splat_ply
from splat.model.gaussians import Gaussians
from splat.model.harmonics import Y00
from splat.projection.antialias import baked

TOP = 100


def fields_ply(gaussians: Gaussians, seen: Bool[Tensor, " n"], values: Values) -> bytes:
    """All Gaussians with their fields, nan out of sight."""
    extra = {}
    for name, column in values.items():
        extra[name] = np.full(len(gaussians), np.nan, np.float32)
        extra[name][seen.numpy()] = column.numpy()
    return splat_ply(gaussians, extra)


def coloured_ply(gaussians: Gaussians, seen: Bool[Tensor, " n"], shade: Shade, values: Float64[Tensor, " m"]) -> bytes:
    """All Gaussians, each in the colour of its value, the same from everywhere."""
    rgb = torch.full((len(gaussians), 3), GREY / 255)
    rgb[seen] = torch.from_numpy(shade.colours_of(values.numpy()))
    attributes = gaussians.attributes | {"sh": ((rgb - 0.5) / Y00)[:, None].to(gaussians.flat)}
    return splat_ply(baked(Gaussians.pack(attributes).with_filter(gaussians.filter_widths)))


def top_table(objective: SceneObjective, values: Values, by: str) -> pd.DataFrame:
    """The Gaussians with the largest |field|, or the smallest `order_gap`: every number, place, size and opacity of each.

    gaussian: its number among all of the checkpoint.  sigma_0 to 2: standard deviations, world units, the largest first.
    """
    column = values[by].abs()
    order = torch.where(column.isnan(), -torch.inf, -column if by == "order_gap" else column)
    chosen = order.argsort(descending=True, stable=True)[:TOP]
    active = objective.active
    sigmas = active.log_scales[chosen].double().exp().sort(dim=1, descending=True).values
    table = {"gaussian": objective.mask.nonzero()[:, 0][chosen].numpy()}
    table |= {name: found[chosen].numpy() for name, found in values.items()}
    table |= dict(zip("xyz", active.means[chosen].double().numpy().T))
    table |= {f"sigma_{i}": sigma for i, sigma in enumerate(sigmas.numpy().T)}
    return pd.DataFrame(table | {"opacity": active.opacity_logits[chosen].double().sigmoid().numpy()})
