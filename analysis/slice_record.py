"""What a slice found as the `data` and `arrays` of a record, `RUN/slice-.../slice.json`.

Keys (as in `analysis.records`; * marks those that must be there):

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
"""

from collections.abc import Sequence
from math import inf, sqrt
from typing import Any

import numpy as np

from analysis.probe_record import counts, loss_name
from analysis.slice_directions import Direction, cosine
from landscape import FiniteProbe, Slice
from splat.curvature import SceneObjective
from splat.losses import LossSettings


def slice_data(
    found: Slice,
    probe: FiniteProbe | None,
    directions: Sequence[Direction],
    lengths: Sequence[float],
    loss_scale: float,
    objective: SceneObjective,
    loss: LossSettings,
    matvecs: int,
) -> dict[str, Any]:
    """All scalars save timing, notes and provenance."""
    assert found.slope is not None and found.curvature is not None
    evaluations = found.evaluations + (0 if probe is None else probe.evaluations)
    return {
        "objective": {
            "loss": loss_name(loss),
            "operator": "hessian",
            "value": found.center_loss,
            "gradient_norm": float(objective.gradient.double().norm()),
        },
        "slice": {
            "directions": [
                {
                    "name": direction.name,
                    "kind": direction.kind,
                    "slope": float(slope),
                    "curvature": float(curvature),
                    "residual": direction.residual,
                    "unit": sqrt(2 * loss_scale / abs(float(curvature))) if curvature else inf,
                    "length": length,
                    "scale": direction.scale,
                }
                for direction, slope, curvature, length in zip(
                    directions, found.slope, found.curvature.diagonal(), lengths, strict=True
                )
            ],
            "loss_scale": loss_scale,
            "cosine": cosine(directions),
            **found.record(),
        },
        "finite_probe": None if probe is None else probe.record(),
        "counts": {
            **counts(objective.counts),
            "products": matvecs,
            "renders": evaluations * objective.counts.views,
        },
    }


def slice_arrays(found: Slice) -> dict[str, dict[str, np.ndarray]]:
    """The arrays, by file."""
    optional = {"model": found.model, "crossed": found.crossed, "evaluated": found.evaluated}
    axes = {name: axis.numpy() for name, axis in zip("xy", found.coordinates, strict=False)}
    known = {name: array.numpy() for name, array in optional.items() if array is not None}
    return {"slice": {**axes, "loss": found.loss.numpy(), **known}}
