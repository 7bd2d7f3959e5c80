"""Figure: the recorded slice as a surface over its two directions, with its contours on the floor.  Dots: renders."""

import warnings
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator
from mpl_toolkits.mplot3d import Axes3D

from analysis.records.quantities import quantity
from analysis.records.records import ProbeRecord, Record
from figures.plane import NOT_CONFIRMED, plane, same_scale
from figures.slice2d import FAINT
from figures.style import BLACK, FIELD_MAP, new_figure, style
from landscape.errors import InputError

LEVELS = 10


def draw(record: Record) -> Figure:
    """The slice of one record as a surface.  Raises InputError where none was recorded, or too few points are renders."""
    field = plane(record)
    if field.unresolved:
        raise InputError(f"expected a plane that is known between its axes; {field.unresolved}")
    low, high = float(field.change.min()), float(field.change.max())
    top = high if high > low else low + 1.0
    colours = ScalarMappable(Normalize(low, top), FIELD_MAP)
    x, y = np.meshgrid(field.x.scaled, field.y.scaled, indexing="ij")
    height = field.change.filled(np.nan)
    dots = field.dots & np.isfinite(height)
    wide, deep = (float(np.ptp(d.steps)) for d in (field.x, field.y))
    alike = same_scale(wide, deep)
    wide, deep = (wide, deep) if alike else (1.0, 1.0)
    with style():
        figure = new_figure(2.6)
        axes: Axes3D = figure.add_subplot(projection="3d", computed_zorder=False)  # pyright: ignore[reportAssignmentType]
        lines: dict[str, Any] = {"levels": MaxNLocator(LEVELS).tick_values(low, top), "linestyles": "solid"}
        axes.contour(x, y, height, zdir="z", offset=low, colors="0.7", linewidths=0.4, zorder=0, **lines)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Z contains NaN")  # it has no surface there, as it should
            axes.plot_surface(x, y, height, rcount=len(x), ccount=len(y[0]), cmap=FIELD_MAP, vmin=low, vmax=top,
                              linewidth=0, antialiased=False)  # fmt: skip
        axes.contour(x, y, height, colors=BLACK, linewidths=0.3, **lines)
        axes.plot(x[dots], y[dots], height[dots], **FAINT)
        axes.set(xlim=field.x.scaled[[0, -1]], ylim=field.y.scaled[[0, -1]], zlim=(low, top))
        axes.set_xlabel(field.x.short_label, labelpad=-6)
        axes.set_ylabel(field.y.short_label, labelpad=-6)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(4))
        axes.zaxis.set_major_locator(NullLocator())  # the bar of the colours says heights
        axes.tick_params(labelsize=6, pad=-3)
        axes.set_proj_type("ortho")
        axes.view_init(elev=50, azim=-58)  # so steep that no wall hides the centre
        axes.set_box_aspect((wide, deep, max(wide, deep) / 2), zoom=0.75)  # pyright: ignore[reportArgumentType]
        figure.colorbar(colours, ax=axes, label=field.label, shrink=0.75, pad=0.08, aspect=20)
        curvatures = ", ".join(f"{d.name} {quantity(d.curvature)}" for d in (field.x, field.y))
        flat = "" if high > low else "\nthe loss is the same at every point"
        scales = "" if alike else "\nthe steps differ in scale"
        title = f"Curvature along {curvatures}{_doubt(record)}{flat}\nsteps: {field.x.scale}{scales}"
        figure.suptitle(title, fontsize=7)
    return figure


def _doubt(record: Record) -> str:
    """A line where the record is of a probe whose renders do not confirm the largest curvature."""
    doubted = isinstance(record.data, ProbeRecord) and record.data.eigenvalues.max.doubted
    return f"\nlargest curvature {NOT_CONFIRMED}" * doubted
