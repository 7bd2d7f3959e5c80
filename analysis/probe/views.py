"""Pictures of the training views for the report: photograph and render, as JPEG in the record's folder."""

from collections.abc import Collection
from pathlib import Path

import numpy as np
from PIL import Image

from analysis.records.records import PHOTOGRAPH, RENDER
from splat.curvature.objective import SceneObjective
from splat.render.render import render
from splat.scenes.write import bytes_of

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
            reduced = Image.fromarray(bytes_of(picture))
            reduced.thumbnail((WIDEST, WIDEST))
            reduced.save(folder / name.format(index), quality=QUALITY)
