"""`landscape view`: serve the viewer, or write a page that needs no server.

In such a page viser's only control is the tree of its nodes, so every field is a node with splats of its own.  One
is visible; the panel switches by the tree.
"""

from importlib import import_module
from pathlib import Path
from threading import Event
from typing import Any

import torch
from rich.console import Console
from torch import Tensor

from analysis.commands.map.fields import ENDS, PROBE, measured_fields
from analysis.commands.options import ViewOptions
from analysis.commands.view.viewer import APPEARANCE, Viewer
from analysis.console.options import require_known
from analysis.console.plain import say
from analysis.console.stages import Stages
from analysis.measures.steepest import heaviest_view
from analysis.measures.units import RISE, UNITS
from analysis.records.page import report
from analysis.records.records import recorded_probe
from landscape import curvature_reach
from landscape.errors import InputError
from splat.curvature.fields import FIELDS
from splat.curvature.objective import SceneObjective
from splat.training.checkpoint import open_subject, write_atomically
from splat.training.origin.fingerprint import Fingerprint

STEEPEST = "e₁"


def run_view(options: ViewOptions) -> int:
    """Show the checkpoint until Ctrl-C, or write a page; returns the exit code."""
    viser = import_module("viser")
    require_known("field", options.shown, (APPEARANCE, *FIELDS, *ENDS))
    console, folder = Console(stderr=True), options.checkpoint.parent
    stages = Stages(console)
    with stages.stage("load"):
        subject = open_subject(options.checkpoint, options.foreign, folder / "view")
        objective, made = subject.objective(), subject.checkpoint.fingerprint({}, 0)
        directions = steepest_directions(objective, folder / PROBE, made)
        start = heaviest_view(objective, directions[STEEPEST][0]) if STEEPEST in directions else 0
    server = _server(viser, options)
    try:
        viewer = Viewer(server, objective, start)
        if options.html is None:
            console.print(f"open http://{options.host}:{server.get_port()}; Ctrl-C ends it", highlight=False)
        notes: list[str] = []
        with stages, stages.stage("fields") as progress:
            viewer.add_fields(measured_fields(objective, folder / PROBE, made, notes, progress), options.shown)
        say(*notes, *subject.checkpoint.assumptions, style="yellow", console=console)
        if options.html is None:
            viewer.add_steps(directions)
            Event().wait()
        else:
            write_atomically(options.html, offline_page(viewer, options.shown).encode())
            say(f"written: {options.html}", console=console)
            _link_from_report(folder, options.html)
    except KeyboardInterrupt:
        console.print("ended", highlight=False)
    finally:
        server.stop()
    return 0


def _server(viser: Any, options: ViewOptions) -> Any:
    try:
        return viser.ViserServer(host=options.host, port=options.port, label="splat-landscape", verbose=False)
    except OSError as error:
        raise InputError(f"expected a free --port, got {options.port} ({error}); choose another") from error


def _link_from_report(run: Path, page: Path) -> None:
    """Write the probe's report anew, if there is one and the page lies where it links to."""
    if page.resolve() == (run / report.SPLATS).resolve() and (run / PROBE / report.FILE).is_file():
        report.write_report(run / PROBE)


def steepest_directions(objective: SceneObjective, probe: Path, made: Fingerprint) -> dict[str, tuple[Tensor, float]]:
    """Unit vectors of the two largest eigenvalues in a probe, if any, and how far they may be followed."""
    recorded = recorded_probe(probe, made, [])
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


OFFLINE = ("largest", "trace_means", "trace_quats", "split", "condition", "one_view", "order_gap")


def offline_page(viewer: Viewer, shown: str) -> str:
    """The page of a viewer with fields: its appearance, `shown` and the fields OFFLINE, and the ends of the spectrum."""
    fields, scene, entries = viewer.fields, viewer.server.scene, []
    assert fields is not None
    viewer.splats.remove()
    for name in dict.fromkeys((APPEARANCE, shown, *OFFLINE, *fields.ends)):
        words, colours, legend = APPEARANCE, viewer.plain, ""
        if name != APPEARANCE:
            shade = fields.shade(name)
            words, colours = fields.kinds[name].words, shade.colours_of(fields.values[name].numpy())
            legend = f"{shade.unit}{shade.legend}10th to 98th percentile, by weight"
        scene.add_gaussian_splats(
            f"/{words}", **viewer.frame.splats(viewer.objective.active), rgbs=colours, opacities=viewer.opacities,
            visible=name == shown,
        )  # fmt: skip
        entries.append({"words": words, "legend": legend, "shown": name == shown})
    page, panel = scene.as_html(), report.template_environment(Path(__file__).parent).get_template("panel.html.jinja")
    end = page.rindex("</body>")
    return page[:end] + panel.render(entries=entries) + page[end:]
