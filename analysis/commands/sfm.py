"""`landscape sfm`: a scene from a folder of photographs, with a progress bar for every stage."""

import shlex
from pathlib import Path

from rich.console import Console

from analysis.commands.options import SfmOptions
from analysis.console.plain import say
from analysis.console.stages import Stages
from splat.scenes.sfm.sfm import Mapped, scene_from_photos

NAMED = 5  # photographs without a place that are named


def run_sfm(options: SfmOptions) -> int:
    """Make the scene and say what came of it; returns the exit code."""
    out = options.out or options.photos.resolve().with_name(f"{options.photos.resolve().name}-scene")
    with Stages(Console(stderr=True)) as stages:
        mapped = scene_from_photos(options.photos, out, stages.stage)
    _report(mapped, out)
    return 0


def _report(mapped: Mapped, out: Path) -> None:
    total = mapped.placed + len(mapped.left_out)
    say(
        f"{out}: {mapped.placed} of {total} photographs placed, {mapped.points} points, "
        f"mean reprojection error {mapped.error:.2f} px"
    )
    if mapped.left_out:
        rest = len(mapped.left_out) - NAMED
        names = ", ".join(mapped.left_out[:NAMED]) + (f" and {rest} more" if rest > 0 else "")
        say(f"left out: {names}; they overlap too little with the others")
    if len(mapped.models) > 1:
        sizes = ", ".join(map(str, mapped.models))
        say(
            f"the photographs fell apart into {len(mapped.models)} models, of {sizes}; the largest was kept: to join them, "
            "add photographs between them"
        )
    say(f"next: landscape train {shlex.quote(str(out))}")
