"""The stage `depth` of a probe: positions along the rays against positions across them (`splat.depth`)."""

from dataclasses import dataclass, replace
from math import isfinite
from time import monotonic
from typing import Any

import torch

from landscape import TraceSettings
from landscape.results import Progress, finite_or_none
from splat.curvature import SceneObjective
from splat.depth import DRAWS, KINDS, DepthRises, DepthSplit, depth_rises, depth_split


@dataclass(frozen=True, eq=False)
class DepthFindings:
    """rises: None where time was short."""

    split: DepthSplit
    rises: DepthRises | None

    def record(self) -> dict[str, Any]:
        """The section `depth` of a record (`analysis.records`)."""
        split = self.split
        return {
            "gradient_ratio": finite_or_none(split.gradient_ratio),
            "gradient_median": finite_or_none(split.median_ratio),
            "pairs": len(split.components),
            "curvature": {"depth": split.depth.record(), "lateral": split.lateral.record()},
            "curvature_ratio": split.curvature_ratio.record(),
            "rises": [] if self.rises is None else _rows(self.rises),
        }


def measure_depth(
    objective: SceneObjective,
    traces: TraceSettings,
    steps: tuple[float, ...],
    seconds: float,
    render: float,
    generator: torch.Generator,
    report: Progress,
    notes: list[str],
) -> DepthFindings:
    """Within so many seconds, with so many for a render of all views.  steps: px, of the rises."""
    end = monotonic() + seconds
    split = depth_split(objective, generator, replace(traces, max_seconds=seconds / 2), report)
    if (4 * DRAWS * len(steps) + 1) * render > end - monotonic():
        notes.append("finite steps along the rays were left out: their renders would have taken more than their time")
        return DepthFindings(split, None)
    return DepthFindings(split, depth_rises(objective, generator, steps, progress=report))


def _rows(rises: DepthRises) -> list[dict[str, Any]]:
    ratios, errors = rises.ratios
    rows = []
    for i, pixels in enumerate(rises.steps):
        row = {"pixels": pixels, "ratio": _number(ratios[i]), "ratio_error": _number(errors[i])}
        for kind, name in enumerate(KINDS):
            row |= {name: _number(rises.values[i, kind]), f"{name}_error": _number(rises.errors[i, kind])}
            row |= {f"{name}_crossed": _number(rises.crossed[i, kind])}
        rows.append(row)
    return rows


def _number(value: torch.Tensor) -> float | None:
    return float(value) if isfinite(value) else None
