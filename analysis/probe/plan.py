"""Expected duration of a probe, from the time that a render of all views takes here."""

from statistics import median
from time import monotonic

from analysis.probe.settings import ProbeSettings
from splat.curvature.objective import SceneObjective

MOST_AT_ONCE = 4  # start vectors of Lanczos runs that advance together
TIMED = 3  # renders; the median counts
MEASURES = 33.0  # products with MOST_AT_ONCE vectors that --measures takes as long as
PRODUCT, BEFORE = 4.5, 50  # in renders: a product with MOST_AT_ONCE vectors; all that comes before the first stage
PICTURES, QUICK_PICTURES = 3.0, 0.5  # seconds to draw them, which hardly depend on the scene
POINTS = 150  # of a slice's plane: with the others' boxes usually as long as so many renders


def seconds_of_render(objective: SceneObjective) -> float:
    """Seconds of a render of all views with all threads; the first of a process may include compilation."""
    taken = []
    for _ in range(TIMED):
        start = monotonic()
        objective.loss(objective.active.flat)
        taken.append(monotonic() - start)
    return median(taken)


def expected_seconds(settings: ProbeSettings, render: float, further: float = 0.0) -> float:
    """Expected seconds of all stages, by their usual work on real scenes of several kinds.

    render: seconds of a render of all views; further: products with MOST_AT_ONCE vectors that the caller makes afterwards.
    """
    products, renders = further, BEFORE
    products += 0.45 * settings.trace_samples if settings.trace_samples else 11  # traces
    products += 28  # both ends of the spectrum
    renders += 50  # along these
    renders += 0.75 * min(POINTS, settings.slice_points**2) if settings.slice_plane else 1.5 * settings.slice_points
    products += 0.3 * settings.density_matvecs
    products, renders = (products, renders) if settings.depth is None else (products + 3, renders + 35)
    return (PRODUCT * products + renders) * render + (PICTURES if settings.slice_plane else QUICK_PICTURES)
