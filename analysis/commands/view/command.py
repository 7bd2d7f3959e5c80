"""`landscape view`: serve the viewer, or write a page that needs no server."""

from importlib import import_module
from pathlib import Path
from threading import Event
from typing import Any

import torch
from rich.console import Console
from torch import Tensor

from analysis.commands.map.command import ENDS, PROBE, measured_fields
from analysis.commands.options import ViewOptions
from analysis.commands.view.page import offline_page
from analysis.commands.view.viewer import APPEARANCE, Viewer
from analysis.console.plain import say
from analysis.console.stages import Stages
from analysis.measures.steepest import heaviest_view
from analysis.probe.command import opened, scene_objective
from analysis.slice.directions import RISE, UNITS, recorded_probe
from landscape import curvature_reach
from landscape.errors import InputError, did_you_mean
from splat.curvature.fields import FIELDS
from splat.curvature.objective import SceneObjective
from splat.training.checkpoint import write_atomically

STEEPEST = "e₁"


def run_view(options: ViewOptions) -> int:
    """Show the checkpoint until Ctrl-C, or write a page; returns the exit code."""
    viser, known = _viser(), (APPEARANCE, *FIELDS, *ENDS)
    if options.shown not in known:
        raise InputError(
            f"expected --field {', '.join(known)}, got {options.shown!r}{did_you_mean(options.shown, known)}"
        )
    console = Console(stderr=True)
    stages = Stages(console)
    with stages.stage("load"):
        folder = options.checkpoint.parent
        checkpoint, scene = opened(options.checkpoint, options.scene, options.foreign, folder / "view")
        objective = scene_objective(checkpoint, scene)
        directions = steepest_directions(objective, folder / PROBE)
        start = heaviest_view(objective, directions[STEEPEST][0]) if STEEPEST in directions else 0
    try:
        server = viser.ViserServer(host=options.host, port=options.port, label="splat-landscape", verbose=False)
    except OSError as error:
        raise InputError(f"expected a free --port, got {options.port} ({error}); choose another") from error
    try:
        viewer = Viewer(server, objective, start)
        if options.html is None:
            console.print(f"open http://{options.host}:{server.get_port()}; Ctrl-C ends it", highlight=False)
        notes: list[str] = []
        with stages, stages.stage("fields") as progress:
            viewer.add_fields(measured_fields(objective, folder / PROBE, notes, progress), options.shown)
        say(*notes, style="yellow", console=console)
        if options.html is not None:
            write_atomically(options.html, offline_page(viewer, options.shown).encode())
            say(f"written: {options.html}", console=console)
            from analysis.records import report  # half a second of imports

            if (
                options.html.resolve() == (folder / report.SPLATS).resolve()
                and (folder / PROBE / report.FILE).is_file()
            ):
                report.write_report(folder / PROBE)  # its page has a link to this one
            return 0
        viewer.add_steps(directions)
        Event().wait()
    except KeyboardInterrupt:
        console.print("ended", highlight=False)
    finally:
        server.stop()
    return 0


def _viser() -> Any:
    try:
        return import_module("viser")
    except ImportError as error:
        raise InputError(
            f"expected the package viser, which shows a scene in the browser, got none ({error}); pip install -e '.[view]'"
        ) from None


def steepest_directions(objective: SceneObjective, probe: Path) -> dict[str, tuple[Tensor, float]]:
    """Unit vectors of the two largest eigenvalues in a probe, if any, and how far they may be followed."""
    recorded = recorded_probe(probe, objective, [])
    if recorded is None:
        return {}
    ends, vectors = recorded.data.eigenvalues, recorded.arrays["eigenvectors"]["largest"]
    values = {STEEPEST: ends.max.value, "e₂": ends.second.value if ends.second else None}
    rise = RISE * objective.loss(objective.active.flat)
    return {
        name: (torch.from_numpy(vectors[:, i]), curvature_reach(value, rise, UNITS))
        for i, (name, value) in enumerate(values.items())
        if value and i < vectors.shape[1]
    }
