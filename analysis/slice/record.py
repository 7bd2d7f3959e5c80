"""Record (`analysis.records.records.SliceRecord`) and arrays of a slice."""

from dataclasses import dataclass
from math import inf, sqrt

import numpy as np
from jaxtyping import Float, Float64
from msgspec import convert
from torch import Tensor

from analysis.records import schema
from analysis.records.provenance import Provenance
from analysis.records.records import SliceRecord, counts_of, objective_of
from analysis.slice.directions import Direction
from landscape import FiniteProbe, Slice
from landscape.results import sampling_error
from splat.curvature.objective import SceneObjective


@dataclass(frozen=True, eq=False)
class Found:
    """A slice and its directions, also as columns.  probe: the finite steps of a line.

    population: the training's views, where fewer are measured; by_view: then the curvatures in each of these.
    """

    slice: Slice
    probe: FiniteProbe | None
    directions: list[Direction]
    vectors: Float[Tensor, "n d"]
    loss_scale: float
    matvecs: int
    population: int | None = None
    by_view: Float64[Tensor, "m d"] | None = None


def left_out_of_slice(views: int, population: int | None) -> list[str]:
    if population is None:
        return []
    return [
        f"the loss is that of {views} of {population} training views: what the others would change stands beside the "
        "directions' curvatures, as a standard error, as if the views had been drawn at random; for the loss along them it is "
        "not known"
    ]


def slice_record(found: Found, objective: SceneObjective, notes: list[str], made: Provenance) -> SliceRecord:
    """All numbers that are no arrays, without timing."""
    grid, probe = found.slice, found.probe
    assert grid.slope is not None and grid.curvature is not None
    numbers = (each.tolist() for each in (grid.slope, grid.curvature.diagonal()))
    directions = [
        schema.Direction(
            name=direction.name,
            kind=direction.kind,
            slope=slope,
            curvature=curvature,
            residual=direction.residual,
            unit=sqrt(2 * found.loss_scale / abs(curvature)) if curvature else inf,
            scale=direction.scale,
        )
        for direction, slope, curvature in zip(found.directions, *numbers, strict=True)
    ]
    if found.population is not None and found.by_view is not None:
        for direction, curvatures in zip(directions, found.by_view.T, strict=True):
            direction.views_error = sampling_error(curvatures, found.population)
    about = {"directions": directions, "loss_scale": found.loss_scale, **grid.record()}
    evaluations = grid.evaluations + (0 if probe is None else probe.evaluations)
    return SliceRecord(
        objective=objective_of(objective, grid.center_loss, float(objective.gradient.double().norm())),
        slice=convert(about, schema.Slice),
        finite_probe=None if probe is None else convert(probe.record(), schema.FiniteProbe),
        counts=counts_of(
            objective.counts, found.population, products=found.matvecs, renders=evaluations * objective.counts.views
        ),
        notes=notes + left_out_of_slice(objective.counts.views, found.population),
        provenance=made,
        timing={},
    )


def slice_arrays(found: Found) -> dict[str, dict[str, np.ndarray]]:
    """The arrays, by file (`analysis.records.records.ARRAYS`)."""
    return {"slice": found.slice.arrays(), "directions": {"vectors": found.vectors.cpu().numpy()}}
