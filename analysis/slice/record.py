"""What a slice found as the `data` and `arrays` of a record, `RUN/slice-.../slice.json`.

Keys (as in `analysis.records.records`; * marks those that must be there):

format*           name*, version*
objective*        as for a probe
slice*            as for a probe, with one direction or two, and
    directions*       also kind ("eigenvectors", "random", "gradient" or "line"); slope and curvature: of the loss along the
                      direction as given; residual: of an eigenvector, else null; length: of the direction, in parameter units;
                      scale: what a step of 1 is; unit is in steps too
    cosine            of the angle between the two directions, before the second was put at a right angle; null with one
finite_probe      null with two directions, else `landscape.FiniteProbe.record()`: second differences of renders at increasing
                  steps along the direction (curvatures) beside its infinitesimal curvature
counts*, timing*, notes, provenance*    as for a probe

Arrays:

slice             x, y, loss, model, crossed, evaluated as for a probe; without y, all are [nx]
directions        vectors [parameters, d], of the Gaussians in sight or, for a line, of all
"""

from dataclasses import dataclass
from math import inf, sqrt
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from analysis.probe.record import counts, objective_of
from analysis.slice.directions import Direction
from landscape import FiniteProbe, Slice
from splat.curvature.objective import SceneObjective


@dataclass(frozen=True, eq=False)
class Found:
    """A slice and its directions, also as columns.  probe: the finite steps of a line; cosine: see the glossary."""

    slice: Slice
    probe: FiniteProbe | None
    directions: list[Direction]
    vectors: Float[Tensor, "n d"]
    cosine: float | None
    loss_scale: float
    matvecs: int


def slice_data(found: Found, objective: SceneObjective) -> dict[str, Any]:
    """All scalars save timing, notes and provenance."""
    grid, probe = found.slice, found.probe
    assert grid.slope is not None and grid.curvature is not None
    lengths = torch.linalg.vector_norm(found.vectors.double(), dim=0)
    numbers = [each.tolist() for each in (grid.slope, grid.curvature.diagonal(), lengths)]
    evaluations = grid.evaluations + (0 if probe is None else probe.evaluations)
    return {
        "objective": {
            **objective_of(objective),
            "operator": "hessian",
            "value": grid.center_loss,
            "gradient_norm": float(objective.gradient.double().norm()),
        },
        "slice": {
            "directions": [
                _direction(direction, slope, curvature, length, found.loss_scale)
                for direction, slope, curvature, length in zip(found.directions, *numbers, strict=True)
            ],
            "loss_scale": found.loss_scale,
            "cosine": found.cosine,
            **grid.record(),
        },
        "finite_probe": None if probe is None else probe.record(),
        "counts": {
            **counts(objective.counts),
            "products": found.matvecs,
            "renders": evaluations * objective.counts.views,
        },
    }


def _direction(
    direction: Direction, slope: float, curvature: float, length: float, loss_scale: float
) -> dict[str, Any]:
    return {
        "name": direction.name,
        "kind": direction.kind,
        "slope": slope,
        "curvature": curvature,
        "residual": direction.residual,
        "unit": sqrt(2 * loss_scale / abs(curvature)) if curvature else inf,
        "length": length,
        "scale": direction.scale,
    }


def slice_arrays(found: Found) -> dict[str, dict[str, np.ndarray]]:
    """The arrays, by file."""
    grid = found.slice
    optional = {"model": grid.model, "crossed": grid.discontinuous, "evaluated": grid.evaluated}
    axes = {name: axis.numpy() for name, axis in zip("xy", grid.coordinates, strict=False)}
    known = {name: array.numpy() for name, array in optional.items() if array is not None}
    return {
        "slice": {**axes, "loss": grid.loss.numpy(), **known},
        "directions": {"vectors": found.vectors.cpu().numpy()},
    }
