"""Pictures of the training views for the report: photograph and render, as JPEG in the record's folder."""

from collections.abc import Collection
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from analysis.records.records import PHOTOGRAPH, RENDER
from splat.curvature.objective import SceneObjective
from splat.render.render import render

MOST = 12  # views, spread evenly over all of them
WIDEST, QUALITY = 800, 88  # pixels; of JPEG


def write_views(folder: Path, objective: SceneObjective, named: Collection[str] = ()) -> None:
    """Write the pictures of at most MOST of this process's views, and of those that are named."""
    count = len(objective.views)
    spread = {round(i) for i in np.linspace(0, count - 1, min(MOST, count))}
    for index in sorted(spread | {i for i, view in enumerate(objective.views) if view.name in named}):
        view = objective.views[index]
        image = render(objective.active, view.camera, objective.background, objective.settings).image
        for name, picture in ((PHOTOGRAPH, view.image), (RENDER, image)):
            _write(picture, folder / name.format(index))


def _write(picture: Float[Tensor, "3 h w"], path: Path) -> None:
    pixels = (picture.detach().cpu().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    image = Image.fromarray(pixels)
    image.thumbnail((WIDEST, WIDEST))
    image.save(path, quality=QUALITY)
