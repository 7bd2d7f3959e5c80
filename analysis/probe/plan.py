"""Expected durations of a probe's stages, from the time that a product H V and a render take here."""

from collections.abc import Callable, Mapping
from statistics import median
from time import monotonic
from types import MappingProxyType

import torch

from analysis.console.stages import Work
from analysis.probe.settings import ProbeSettings
from landscape.operators.operator import finished
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective

MOST_AT_ONCE = 4  # start vectors of Lanczos runs that advance together
TIMED = 3  # calls; the median counts
PRODUCT, BEFORE = 4.5, 50  # in renders: a product with MOST_AT_ONCE vectors; all that comes before the first stage
PICTURES, QUICK_PICTURES = 3.0, 0.5  # seconds to draw them, which hardly depend on the scene
Expected = Mapping[str, tuple[int, float, float]]
"""Of each stage: units of its progress (0: they take unlike times), products of MOST_AT_ONCE vectors, renders of all views."""
NOTHING: Expected = MappingProxyType({})
# as measured on real scenes of several kinds
TYPICAL: Expected = {
    "traces": (25, 11, 0),
    "eigenvalues": (60, 28, 0),
    "renders": (0, 0, 70),
    "slice": (320, 0, 240),
    "depth": (0, 3, 60),
    "block shares": (0, 4, 0),
}


def seconds_of_product(hessian: SceneHessian) -> float:
    """Seconds of a product with MOST_AT_ONCE vectors."""
    V = torch.ones_like(hessian.objective.active.flat)[:, None].expand(-1, MOST_AT_ONCE).contiguous()
    return _seconds_of(lambda: finished(hessian.apply(V)))


def seconds_of_render(objective: SceneObjective) -> float:
    """Seconds of a render of all views with all threads; the first of a process may include compilation."""
    return _seconds_of(lambda: objective.loss(objective.active.flat))


def _seconds_of(call: Callable[[], object]) -> float:
    taken = []
    for _ in range(TIMED):
        start = monotonic()
        call()
        taken.append(monotonic() - start)
    return median(taken)


def plan_of(settings: ProbeSettings, product: float, render: float, after: Expected = NOTHING) -> Mapping[str, Work]:
    """Expected work of every stage, from the seconds of a product and of a render; after: stages of the caller."""
    work = dict(TYPICAL)
    if settings.trace_samples:
        work["traces"] = (settings.trace_samples, 0.45 * settings.trace_samples, 0)
    units, _, renders = work["slice"]
    points = min(units, settings.slice_points**2) if settings.slice_plane else 2 * settings.slice_points
    work["slice"] = (points, 0, renders * points / units)
    if count := settings.density_matvecs:
        work["density"] = (count, 0.3 * count, 0)
    if settings.power_apart:
        work["power iteration"] = (0, settings.power.max_matvecs, 0)
    if settings.probe_steps:
        count = 2 * len(settings.probe_steps) + settings.noise_points + 1
        work["finite probe"] = (count, 0, count)
    if settings.depth is None:
        del work["depth"]
    if settings.block_ssim_window:
        work["block shares"] = (0, 24, 0)  # exact blocks take longest
    found = {
        name: Work(products * product + renders * render, units)
        for name, (units, products, renders) in (work | dict(after)).items()
    }
    return found | {"pictures": Work(PICTURES if settings.slice_plane else QUICK_PICTURES)}


def expected_seconds(settings: ProbeSettings, render: float, after: Expected = NOTHING) -> float:
    """Expected seconds of all stages, from those of a render of all views alone."""
    stages = plan_of(settings, PRODUCT * render, render, after).values()
    return sum(work.seconds for work in stages) + BEFORE * render
