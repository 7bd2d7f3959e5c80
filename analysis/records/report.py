"""A self-contained page about one record: the scene, five numbers and three sentences; the pictures; every number, folded.

The page carries its pictures and plotly.js (compressed) within it, and its content security policy forbids every request
to a network.  Text from the record is escaped.
"""

import base64
import gzip
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import plotly.graph_objects as go
import plotly.io
from PIL import Image
from plotly.offline import get_plotlyjs

from analysis.records.findings import attribute_name, findings, headline, is_open
from analysis.records.json_files import plain
from analysis.records.quantities import limits, measured, quantity
from analysis.records.records import PHOTOGRAPH, RENDER, ProbeRecord, Record, read_record
from analysis.records.run_files import MAP, MapRecord, read_map
from analysis.records.schema import INDICES
from analysis.records.tables import family_lines

FILE = "report.html"
PICTURES = {
    "slice2d": "The loss on the plane of the two steepest directions. Dots: renders, blue where the order of the splats or the "
    "set of visible ones is not the checkpoint's; dashed: the quadratic model.",
    "surface": "The same plane as a surface.",
    "spectrum": "The density of the spectrum, broadened; the share of all directions and of all curvature below a value; the "
    "eigenvalues that the search for the ends met, each with the residual within which a true one lies.",
    "traces": "What a random step as long as the optimiser's first changes of the loss by each attribute's curvature, which "
    "compares; beside the names their traces, each in its own unit.",
}


def write_report(folder: str | Path, surface: str | None = None) -> Path:
    """Write report.html about the record in `folder`, with the pictures that lie beside it; returns its path.

    surface: `embedded_surface` of the record, where it is known already.  The page replaces an older one at once.  Raises
    FileNotFoundError or ValueError as `read_record` does.
    """
    record = read_record(folder, ProbeRecord)
    path = record.folder / FILE
    temporary = path.with_suffix(".html.tmp")
    temporary.write_text(render_report(record, surface), encoding="utf-8")
    temporary.replace(path)
    return path


def template_environment() -> jinja2.Environment:
    """Of the pages whose templates lie beside this file."""
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render_report(record: Record[ProbeRecord], surface: str | None = None) -> str:
    """The page as text; surface: as for `write_report`."""
    environment = template_environment()
    environment.filters |= {
        "quantity": quantity,
        "limits": limits,
        "measured": measured,
        "attribute": attribute_name,
        "cell": _cell,
        "open_ended": is_open,
    }
    surface = embedded_surface(record) if surface is None else surface
    return environment.get_template("report.html.jinja").render(
        data=record.data,
        counts=plain(record.data.counts),
        provenance=plain(record.data.provenance),
        numbers=numbers(record.data),
        headline=headline(record.data),
        findings=findings(record.data),
        views=views_in(record),
        pictures=pictures_in(record.folder, PICTURES),
        where=where(record),
        families=family_lines(record.data),
        indices=INDICES,
        surface=surface,
        plotly_js=base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode() if surface else "",
    )


def numbers(data: ProbeRecord) -> list[dict[str, str]]:
    """The five numbers at the top: value with its error or bracket, and what it is."""
    ends, found = data.eigenvalues, []
    for end, words in ((ends.max, "largest curvature"), (ends.min, "smallest curvature")):
        found.append({"value": measured(end.value, end.residual), "words": words})
    traces = {
        name: trace for name, trace in data.traces.items() if trace.value is not None and math.isfinite(trace.value)
    }
    if traces:
        name, trace = max(traces.items(), key=lambda item: abs(item[1].value or 0.0))
        words = f"trace of {attribute_name(name)}, the largest of five"
        found.append({"value": measured(trace.value, trace.standard_error), "words": words})
    if index := data.anisotropy.literal:
        bracket = " to ".join(limits(index.low, index.high))
        known = index.low is not None and index.high is not None
        found.append({"value": quantity(index.value if known else None), "words": f"largest over smallest ({bracket})"})
    if lives := ends.max.lives_on:
        words = f"Gaussians carry the steepest direction, of {data.counts.visible_gaussians:,} in sight"
        found.append({"value": quantity(lives.participation), "words": words})
    return found


def views_in(record: Record[ProbeRecord]) -> list[dict[str, str]]:
    """Photograph and render of the training views whose pictures lie in the folder, as data URIs with the view's name."""
    names, folder = record.data.provenance.views or [], record.folder
    pairs = [(name, folder / PHOTOGRAPH.format(i), folder / RENDER.format(i)) for i, name in enumerate(names)]
    return [
        {"name": name, "photograph": _uri(photograph, "jpeg"), "render": _uri(render, "jpeg")}
        for name, photograph, render in pairs
        if photograph.is_file() and render.is_file()
    ]


def where(record: Record[ProbeRecord]) -> dict[str, Any]:
    """Sentences and pictures, as JPEG, of the map beside the record that was made of the same step of the training, if any."""
    folder = record.folder.parent / MAP
    if not (folder / MapRecord.FILE).is_file():
        return {}
    found = read_map(folder)
    if plain(found.provenance).get("iteration") != plain(record.data.provenance).get("iteration"):
        return {}
    beneath = "the Gaussians that carry it, outlined, and what a step along it does."
    shown = [(end.file, f"{end.name}: {beneath}", end.sentence) for end in found.steepest]
    for panel in found.panels[:1]:
        words = (
            f"{panel.name}: photograph, render, error, and {found.shades[found.field].words} of the Gaussians there."
        )
        axes = f"{panel.name}: where it is fragile in position, conditioning and opacity."
        shown.append((panel.file, words, words))
        shown.append((panel.file.replace("view", "fragility"), axes, " ".join(found.sentences[len(found.steepest) :])))
    pictures = [
        {"caption": caption, "words": words, "uri": _as_jpeg(folder / f"{name}.png")}
        for name, caption, words in shown
        if (folder / f"{name}.png").is_file()
    ]
    return {"sentences": found.sentences, "pictures": pictures}


def _as_jpeg(path: Path) -> str:
    """A picture, mostly of photographs, in a quarter of its bytes."""
    content = io.BytesIO()
    Image.open(path).convert("RGB").save(content, "JPEG", quality=88)
    return f"data:image/jpeg;base64,{base64.b64encode(content.getvalue()).decode()}"


def _uri(path: Path, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def interactive_surface(record: Record[ProbeRecord]) -> go.Figure | None:
    """The recorded slice as a surface to turn and zoom, with the quadratic model where known; None without one."""
    about = record.data.slice
    if about is None or "slice" not in record.arrays or not about.is_resolved:
        return None
    arrays = record.arrays["slice"]
    layers = [("loss", "loss", "Cividis", 1.0), ("model", "quadratic model", "Greys", 0.45)]
    figure = go.Figure()
    for name, label, colours, opacity in layers:
        if name in arrays:
            change = np.where(np.isfinite(arrays[name]), arrays[name], np.nan) - about.center_loss
            figure.add_surface(
                x=arrays["x"], y=arrays["y"], z=change.T, name=label, colorscale=colours, opacity=opacity,
                showscale=name == "loss", showlegend=True, visible=True if name == "loss" else "legendonly",
                colorbar={"exponentformat": "power", "len": 0.8},
            )  # fmt: skip
    names = [_escaped(direction.name) for direction in about.directions]
    figure.update_layout(
        scene={
            "xaxis_title": f"step along {names[0]}",
            "yaxis_title": f"step along {names[1]}",
            "zaxis_title": "change of loss",
            "aspectmode": "cube",
            "camera": {"eye": {"x": 1.2, "y": -1.9, "z": 1.0}, "center": {"x": 0, "y": 0, "z": -0.15}},
            **{f"{axis}axis_exponentformat": "power" for axis in "xyz"},
        },
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        height=520,
        legend={"orientation": "h"},
    )
    return figure


def embedded_surface(record: Record[ProbeRecord]) -> str:
    """`interactive_surface` as a part of a page, empty without a slice."""
    figure = interactive_surface(record)
    if figure is None:
        return ""
    buttons = ["toImage", "zoom3d", "pan3d", "orbitRotation", "resetCameraDefault3d"]
    settings = {"displaylogo": False, "responsive": True, "plotlyServerURL": "", "modeBarButtons": [buttons]}
    return plotly.io.to_html(figure, full_html=False, include_plotlyjs=False, div_id="surface", config=settings)


def _escaped(text: str) -> str:
    """plotly reads some tags in its texts; a record's text has none to be read."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def pictures_in(folder: Path, captions: Mapping[str, str]) -> list[dict[str, str]]:
    """The pictures that were drawn, as data URIs with their captions."""
    drawn = [(name, caption, folder / f"{name}.png") for name, caption in captions.items()]
    return [
        {"name": name, "caption": caption, "uri": _uri(path, "png")} for name, caption, path in drawn if path.is_file()
    ]


def _cell(value: Any) -> str:
    """A value of the record in a table: counts with separators, numbers with few digits, the rest as it is."""
    match value:
        case None:
            return quantity(None)
        case bool():
            return "yes" if value else "no"
        case int():
            return f"{value:,}"
        case float():
            return quantity(value)
        case list():
            return ", ".join(_cell(item) for item in value)
    return str(value)
