"""The stage `depth` of a probe: positions along the rays against positions across them (`analysis.measures.depth`)."""

from dataclasses import dataclass, replace
from time import monotonic
from typing import Any

from analysis.console.budget import Share
from analysis.measures.depth import DRAWS, KINDS, DepthRises, DepthSplit, depth_rises, depth_split
from landscape import TraceSettings
from landscape.results import finite_or_none
from splat.curvature.objective import SceneObjective


@dataclass(frozen=True, eq=False)
class DepthFindings:
    """rises: None where time was short."""

    split: DepthSplit
    rises: DepthRises | None

    def record(self) -> dict[str, Any]:
        """The section `depth` of a record (`analysis.records.records`)."""
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
    render: float,
    share: Share,
) -> DepthFindings:
    """render: seconds, of all views.  steps: px, of the rises."""
    end = monotonic() + share.seconds
    split = depth_split(objective, share.generator, replace(traces, max_seconds=share.seconds / 2), share.report)
    if (2 * len(KINDS) * DRAWS * len(steps) + 1) * render > end - monotonic():
        share.notes.append(
            "finite steps along the rays were left out: their renders would have taken more than their time"
        )
        return DepthFindings(split, None)
    return DepthFindings(split, depth_rises(objective, share.generator, steps, progress=share.report))


def _rows(rises: DepthRises) -> list[dict[str, Any]]:
    rows = []
    for i, (pixels, ratio, error) in enumerate(zip(rises.steps, *(x.tolist() for x in rises.ratios), strict=True)):
        row = {"pixels": pixels, "ratio": finite_or_none(ratio), "ratio_error": finite_or_none(error)}
        for kind, name in enumerate(KINDS):
            for suffix, table in (("", rises.values), ("_error", rises.errors), ("_crossed", rises.crossed)):
                row[f"{name}{suffix}"] = finite_or_none(float(table[i, kind]))
        rows.append(row)
    return rows
