"""Figure: where the curvature in position of somebody else's renderer is: every position along the scene's longest axis and
each of the two others, in the colour of the largest eigenvalue of its own block of Gauss-Newton (sampled)."""

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from analysis.records.quantities import quantity
from analysis.records.records import ProbeRecord, Record
from figures.style import FIELD_MAP, new_figure, style


def draw(record: Record[ProbeRecord]) -> Figure:
    """Two panels; the steepest last, above the others."""
    found = record.arrays["places"]
    curvature, order = found["curvature"], np.argsort(found["curvature"])
    centred = found["positions"] - np.median(found["positions"], axis=0)
    along = (centred @ np.linalg.svd(centred.T @ centred)[2].T)[order]
    low, high = np.quantile(along, (0.01, 0.99), axis=0)
    edge = np.maximum(0.1 * (high - low), 1e-3)
    top = float(curvature.max())
    colours = np.where(curvature > 0, curvature, np.nan)[order]
    scale = LogNorm(max(float(np.quantile(curvature, 0.05)), 1e-6 * top), top)
    with style():
        figure = new_figure(3.6)
        panels = figure.subplots(2, 1, sharex=True)
        for axes, other in zip(panels, (1, 2)):
            x, y = along[:, 0], along[:, other]
            dots = axes.scatter(x, y, c=colours, s=3, cmap=FIELD_MAP, norm=scale, plotnonfinite=True)
            for limits, axis in ((axes.set_xlim, 0), (axes.set_ylim, other)):
                limits(low[axis] - edge[axis], high[axis] + edge[axis])
            axes.set_ylabel(f"axis {other + 1}")
        panels[-1].set_xlabel("longest axis")
        figure.colorbar(dots, ax=panels, label="largest curvature of a position")
        figure.suptitle(f"The steepest position has {quantity(top)}", x=0.02, ha="left", fontsize=7.5)
    return figure
