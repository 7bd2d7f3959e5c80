"""The maps of one training view: photograph, render, error and fields, in bytes.

A field is composited as a colour is, by how far each Gaussian's value is along its scale: of a pixel the mean over the splats
by their weights alpha T, without those that have no value.  Errors are |render - photograph|, the mean over the channels.
"""

from collections.abc import Mapping
from math import inf, log10
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from torch import Tensor

from analysis.records.quantities import Shade, share_in_bytes
from splat.curvature.objective import SceneObjective
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.render.render import render, render_layers
from splat.scenes.write import bytes_of

LEAST = 0.02  # weight of a pixel's splats with a value, below which it has none
WORST = 0.99  # of the errors: the end of their scale


def rendered(objective: SceneObjective, index: int, gaussians: Gaussians | None = None) -> Float[Tensor, "3 h w"]:
    """A training view as the checkpoint has it, or other Gaussians, within [0, 1]."""
    camera = objective.views[index].camera
    return render(gaussians or objective.active, camera, objective.background, objective.settings).image.clamp(0, 1)


def error_shade(objective: SceneObjective) -> Shade:
    """Shade from 0 to a high percentile of the errors of a view in the middle."""
    index = len(objective.views) // 2
    error = (rendered(objective, index) - objective.views[index].image).abs().mean(dim=0)
    high = float(np.quantile(error.numpy(), WORST)) or 1.0
    return Shade(name="error", words="error", unit="|render − photograph|, 0 to 1", scale="linear", low=0.0, high=high)


def view_maps(
    objective: SceneObjective, index: int, shares: Mapping[str, Float64[Tensor, " n"]], error_scale: Shade
) -> tuple[dict[str, UInt8[np.ndarray, "..."]], float]:
    """photograph, render (h, w, 3), error and the fields (h, w) by name; and the PSNR of the render, dB."""
    view, image = objective.views[index], rendered(objective, index)
    difference = image - view.image.to(image)
    squared = float(difference.double().square().mean())
    found = {name: bytes_of(part) for name, part in (("photograph", view.image), ("render", image))}
    found["error"] = error_scale.bytes(difference.abs().mean(dim=0).numpy())
    fields = composited(objective, view.camera, torch.stack([*shares.values()], dim=1))
    found |= {name: share_in_bytes(field) for name, field in zip(shares, fields, strict=True)}
    return found, -10 * log10(squared) if squared else inf


def composited(
    objective: SceneObjective, camera: Camera, shares: Float64[Tensor, "n k"]
) -> Float64[np.ndarray, "k h w"]:
    """The means of the Gaussians' numbers by their weights in every pixel; nan where those that have one weigh nothing."""
    known, which = shares.isfinite().unique(dim=1, return_inverse=True)
    columns = torch.cat([shares.nan_to_num(), known.double()], dim=1).to(objective.active.flat)
    layers = torch.nn.functional.pad(columns, (0, -columns.shape[1] % 3)).split(3, dim=1)
    planes = [render_layers(objective.active, camera, each, objective.settings)[0] for each in layers]
    sums = torch.cat(planes).double().numpy()
    totals, weights = sums[: len(which)], sums[len(which) :][which]
    return np.where(weights > LEAST, totals / np.maximum(weights, LEAST), np.nan)


def write_maps(path: Path, maps: Mapping[str, np.ndarray]) -> None:
    """Write maps without compression, which would shrink photographs by a quarter and take a tenth of a second each."""
    arrays: dict[str, np.ndarray] = dict(maps)
    np.savez(path, **arrays)  # pyright: ignore[reportArgumentType]
