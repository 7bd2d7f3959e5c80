"""What a probe left out because the scene does not need it: how much of it, and the seconds that this saved.

Each saving is measured, not guessed: a product H v of one view is timed as it was made and as it would have been, in turns,
and the difference counts once for every product and view.  What was never begun (samples of a trace whose error was small
enough, points of the slice that are predicted well) counts with the mean time of those that were made.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from math import nan

import numpy as np
import torch

from analysis.console.timing import interleaved
from analysis.probe.measurement import Findings
from splat.backend.device import by_triton
from splat.curvature.linearize import LinearizedView
from splat.curvature.objective import SceneObjective
from splat.model.gaussians import Gaussians
from splat.raster.cpu.binning import reached_lists
from splat.render.forward import rasterize_view

REPETITIONS = 3
NOT_CONCERNED = "products_of_views_not_concerned"


@dataclass(frozen=True)
class Skip:
    """count: of what was left out, over all views; seconds: saved in the whole probe, None where that was not measured."""

    count: int
    seconds: float | None

    def record(self) -> dict[str, int | float | None]:
        return {"count": self.count, "seconds_saved": self.seconds}


def product_skips(
    objective: SceneObjective, gaussians: Gaussians, products: int, spared: int, repetitions: int = REPETITIONS
) -> dict[str, Skip]:
    """What every product of the exact Hessian leaves out.

    gaussians: those of the checkpoint; products: H v made; spared: products of single views that `SceneHessian` left out.
    repetitions: of each timing; with 0, and on the GPU, nothing is timed.  There, products also leave out the tiles in which
    their vectors move nothing, which is not counted.
    """
    active, stored = objective.active, objective.counts.sh_degree
    counts = {
        "gaussians_out_of_sight": len(gaussians) - len(active),
        "sh_bands_not_in_use": (stored + 1) ** 2 - (active.sh_degree + 1) ** 2,
        "entries_behind_opaque_fronts": objective.total(sum(view.entries_behind for view in objective.linearized)),
        "tiles_of_zero_cotangent": objective.total(sum(view.dark_tiles for view in objective.linearized)),
    }
    spared = objective.total(spared)
    if not repetitions or by_triton(active.flat):
        return {name: Skip(count, None) for name, count in (*counts.items(), (NOT_CONCERNED, spared))}
    variants: dict[str, Callable[[], LinearizedView]] = {
        "gaussians_out_of_sight": lambda: objective.linearize(0, gaussians.select(_all(gaussians), active.sh_degree)),
        "sh_bands_not_in_use": lambda: objective.linearize(0, active.select(_all(active), stored)),
        "entries_behind_opaque_fronts": lambda: _with_every_entry(objective),
        "tiles_of_zero_cotangent": lambda: _with_every_tile(objective),
    }
    views = {"": objective.linearize(0), **{name: make() for name, make in variants.items() if counts[name]}}
    calls = {name: partial(view.hvp, _vector(view)) for name, view in views.items()}
    times = {name: time.minimum for name, time in interleaved(calls, repetitions).items()}
    made = products * objective.counts.views
    skips = {
        name: Skip(count, max(times[name] - times[""], 0.0) * made if count else 0.0) for name, count in counts.items()
    }
    return {**skips, NOT_CONCERNED: Skip(spared, spared * times[""])}


def estimator_skips(findings: Findings, seconds: Mapping[str, float]) -> dict[str, Skip]:
    """What estimators that had finished left undone.  findings: of `measurement`; seconds: of its stages."""
    probes = [trace.probes for trace in findings.traces.values()]
    undone = sum(max(probes) - count for count in probes)
    skips = {"samples_of_finished_traces": Skip(undone, _prorated(undone, sum(probes), seconds["traces"]))}
    if findings.plane is not None:
        made = findings.plane.slice.evaluations
        undone = findings.plane.slice.loss.numel() - int(findings.plane.slice.evaluated.sum())
        skips["points_of_the_slice_predicted"] = Skip(undone, _prorated(undone, made, seconds["slice"]))
    return skips


def _prorated(undone: int, made: int, seconds: float) -> float:
    return undone * seconds / made if made else nan


def _vector(view: LinearizedView) -> torch.Tensor:
    flat = view.gaussians.flat
    return torch.ones(flat.numel(), 1, dtype=flat.dtype)


def _all(gaussians: Gaussians) -> torch.Tensor:
    return torch.arange(len(gaussians))


def _with_every_entry(objective: SceneObjective) -> LinearizedView:
    """The first view with its tile lists as they were before any entry was dropped."""
    view = objective.linearize(0)
    raster = rasterize_view(objective.active, objective.views[0].camera, objective.background, objective.settings)
    per_tile = np.diff(raster.lists.start)
    view._raster.lists, view._raster._slot_start = reached_lists(raster.lists, per_tile, len(objective.active))
    return view


def _with_every_tile(objective: SceneObjective) -> LinearizedView:
    """The first view with a cotangent that is nowhere 0, if next to it."""
    view = objective.linearize(0)
    cotangent = view._adjoint.cotangent
    cotangent[cotangent == 0] = np.finfo(cotangent.dtype).tiny
    return view
