"""A self-contained page about one record: where the curvature is, the summary, the pictures, and every number, folded.

The page carries its pictures within it, and its content security policy forbids every request to a network.  Text from the
record is escaped.
"""

import base64
import html
import io
import math
import re
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from PIL import Image

from analysis.records.findings import Line, attribute_name, findings, shares_per_trace
from analysis.records.json_files import plain
from analysis.records.page.summary import told
from analysis.records.provenance import Provenance
from analysis.records.quantities import percent, quantity, ratio, rough
from analysis.records.records import PHOTOGRAPH, RENDER, ProbeRecord, Record, read_record
from analysis.records.run_files import MAP, MapRecord, Steepest, read_map, read_maps
from analysis.records.schema import INDICES
from analysis.records.tables import family_lines, number_rows
from landscape.errors import InputError
from splat.model.untrusted import read_picture, write_atomically

FILE, SPLATS = "report.html", "view.html"  # in the record's folder, and beside it: the page of `landscape view --html`
FINE, COARSE = 82, 60  # quality of WebP: of drawings, and of maps, which are noisy
EFFORT = 2  # of its encoder, 0 to 6
PICTURES = {
    "slice2d": "The loss on the plane of the two steepest directions, along each of them and over both.",
    "surface": "The same plane as a surface.",
    "spectrum": "The density of the spectrum, broadened; the share of all directions and of all curvature below a value; the "
    "eigenvalues that the search for the extreme ones met, each with the residual within which a true one lies.",
    "places": "Each position along two axes of the scene, in the colour of the largest curvature of its own block.",
    "traces": "The trace of each attribute's block of the Hessian, in units of its own: the rows do not compare.",
}
COMPARED = (  # of the traces, where the record has these steps
    "By how much of itself the loss changes in a random step as long as the optimiser's first, which compares; beside the "
    "names their traces, each in its own unit. Where rendered steps change it by more than curvature says: over a whole step "
    "L1's kinks curve too and splats change their order, and the Hessian sees neither."
)
PIXEL = "1 px along the ray: a way as long as the one that moves a splat by a pixel where it is across the ray."
GLOSSARY = {  # of the words that a page uses
    "unit": "of the parameters: world units, logarithms of scales, unit quaternions, logits of opacity, SH coefficients; "
    "curvature is loss per squared unit",
    "curvature unit": "of a direction: the step over which its curvature alone changes the loss by as much as is said",
    "e₁": "unit vector over all parameters along which the curvature is largest (λ max)",
    "e₂": "the same, of the second largest curvature",
    "eₘᵢₙ": "the same, of the smallest curvature (λ min)",
    "block": "the part of the Hessian that concerns one Gaussian, or one attribute, alone",
    "trace": "the sum of a block's curvatures in all its directions",
    "τ": "the square root of a block's mean curvature",
    "dim": "number of directions of a block; of colours, of those that some view sees",
    "rank": "number of directions of the parameters that are not exactly flat",
    "kinks": "points at which L1's slope jumps: the curvature that they make over finite steps is not in the Hessian",
    "optimiser's step": "as long as the first that Adam takes, of random signs: the learning rate in every parameter; along a "
    "direction, the root mean square of its part there",
    "numerical": "behind ±: how well an eigenvalue was found; a true one lies within. Other trainings differ by more",
    "noise floor": "the search ended where rounding in products of the Hessian allows no smaller error",
    "participation ratio": "(sum of |curvature|)² over the sum of its squares: over how many directions curvature is spread",
    "quadrature width": "of the sum of |curvature|: the mean distance of its two bounds, over the start vectors",
    "start vector": "random vector from which the density is made; each gives an estimate of its own",
    "order changed": "some splats lie in another order along their rays than in the checkpoint, which derivatives do not see",
    "matvec budget": "largest number of products of the Hessian with a vector that a search may use",
    "condition": "of a splat: its longer axis in the picture over the shorter one, squared; above 100, 10 : 1, it is a needle",
    "in sight": "drawn in a training view",
    "the paper": "Zhao et al., “Geometric Probing for Isotropic Optimization Manifold in Sparse-View 3D Gaussian Splatting” "
    "(StableGS)",
    "carries": "has a part of the squared length of a direction, or of the sum of all curvatures",
}
OPTION = re.compile(r"--[a-z][a-z-]*")  # of a command, which a page must not break
THINNEST = 2.0  # px, half axes of an outline
ROOM, SMALLEST = 3.0, 6  # of the part around an outline: in its half length; at least 1 / SMALLEST of the picture


def write_report(folder: str | Path) -> Path:
    """Write report.html about the record in `folder`, with the pictures that lie beside it; returns its path.

    The page replaces an older one at once.  Raises FileNotFoundError or ValueError as `read_record` does.
    """
    record = read_record(folder, ProbeRecord)
    path = record.folder / FILE
    write_atomically(path, render_report(record).encode())
    return path


@cache
def template_environment(folder: Path = Path(__file__).parent) -> jinja2.Environment:
    """Jinja2 environment of the templates in a folder, by default those beside this file; each is compiled once."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "quantity": quantity,
        "cell": _cell,
        "rough": rough,
        "coded": lambda text: OPTION.sub(r"<code>\g<0></code>", html.escape(text)),
        "capitalise": lambda words: words[:1].upper() + words[1:],
    }
    return environment


def render_report(record: Record[ProbeRecord]) -> str:
    """The page as text.  A damaged map beside the record costs it the map's pictures alone, and is said."""
    try:
        return _page(record, map_beside(record), findings(record.data))
    except InputError as error:
        return _page(record, None, [Line(f"The map is left out: {error}.", "caution"), *findings(record.data)])


def _page(record: Record[ProbeRecord], mapped: MapRecord | None, said: list[Line]) -> str:
    data, run = record.data, record.folder.parent
    lines, numbers = told(data), number_rows(data)
    numbers.pop("Sizes", None)  # the counts have them
    captions = PICTURES | ({"traces": COMPARED} if shares_per_trace(data) else {})
    with ThreadPoolExecutor() as pool:
        pictures = pool.submit(pictures_in, record.folder, captions, shown_numbers(record))
        places = pool.submit(map_pictures, run / MAP, mapped)
        views = views_in(record, mapped)
    end = data.eigenvalues.max.carrier
    start = next((i for i, view in enumerate(views) if end and view["name"] == end.view), 0)
    listed = list(views)
    if views:  # the pictures of this view are in the page once, as images; the script reads them from there
        listed[start] = views[start] | {"pictures": [each | {"uri": ""} for each in views[start]["pictures"]]}
    template = template_environment().get_template("report.html.jinja")
    text = template.render(
        data=data,
        counts=plain(data.counts),
        provenance=_told(data.provenance),
        subtitle=subtitle(data),
        lines=lines,
        place=place_of(record, views) if "steepest" in lines else None,
        findings=said,
        numbers=numbers,
        views=views,
        listed_views=listed,
        start=start,
        title=title(data),
        pictures=pictures.result(),
        where=places.result(),
        splats=f"../{SPLATS}" if (run / SPLATS).is_file() else "",
        per_attribute=family_lines(data),
        indices=INDICES,
    )
    shown = html.unescape(re.sub(r"<(style|script)>.*?</\1>|<[^>]*>", " ", text, flags=re.DOTALL))
    terms = [term for term in GLOSSARY if re.search(rf"(?<!\w){term}", shown)]
    used = [f"<dt>{term}</dt><dd>{GLOSSARY[term]}</dd>" for term in terms]
    return text.replace('<dl id="glossary">', "\n".join(['<dl id="glossary">', *used]), 1)


def _told(made: Provenance) -> dict[str, Any]:
    """Provenance as plain types, but a digest in place of the views, which may be hundreds."""
    told = plain(made)
    if made.fingerprint:
        told["fingerprint"] |= {"data": made.fingerprint.digests["data"]}
    return told


def title(data: ProbeRecord) -> str:
    """Title of the page: scene, views and steps, as far as they are known."""
    scene, steps, count = data.provenance.scene, plain(data.provenance).get("iteration"), data.counts.views
    parts = [f"Loss landscape of {scene or 'a checkpoint'}", f"{count:,} view{'' if count == 1 else 's'}"]
    return ", ".join(parts + ([f"{steps:,} steps"] if steps else []))


def place_of(record: Record[ProbeRecord], views: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Where the steepest direction is: the Gaussian that carries it, outlined in the view where it has most weight.

    "view": of `views`; "ellipse" and its "angle", degrees, in px of the photograph; "boxes": of the whole photograph and of a
    part.  None where it is not known.
    """
    carrier, sizes = record.data.eigenvalues.max.carrier, record.data.objective.sizes
    names = record.data.provenance.views or []
    if not (carrier and len(carrier.outline) == 5 and sizes and carrier.view in names):
        return None
    view = next((each for each in views if each["name"] == carrier.view), None)
    width, height = sizes[min(names.index(carrier.view), len(sizes) - 1)]
    x, y, long, short, angle = carrier.outline
    side = min(max(ROOM * long, height / SMALLEST), height)  # high; as wide as the photograph is to its height
    wide = side * width / height
    left, top = (min(max(at - size / 2, 0), most - size) for at, size, most in ((x, wide, width), (y, side, height)))
    boxes = [(0, 0, width, height), (round(left), round(top), round(wide), round(side))]
    ellipse = {"cx": x, "cy": y, "rx": max(long, THINNEST), "ry": max(short, THINNEST)}
    return view and {"view": view, "ellipse": ellipse, "angle": math.degrees(angle), "boxes": boxes}


def subtitle(data: ProbeRecord) -> str:
    """Gaussians, the loss and its formula, the pictures' size, and the gradient, as far as they are known."""
    loss, parts = data.objective, [f"{data.counts.gaussians:,} Gaussians"] if data.counts.gaussians else []
    if loss.value is not None:
        parts.append(f"loss {quantity(loss.value)}" + (f" = {loss.loss}" if loss.loss else ""))
    if sizes := {tuple(size) for size in loss.sizes or []}:
        parts.append("pictures of " + ", ".join(f"{width} x {height}" for width, height in sorted(sizes)[:3]) + " px")
    if loss.gradient_norm is not None:
        parts.append(f"gradient norm {quantity(loss.gradient_norm)}")
    return ", ".join(parts) + "."


def map_beside(record: Record[ProbeRecord]) -> MapRecord | None:
    """The map beside the record, if it is of the same checkpoint, views and loss."""
    folder = record.folder.parent / MAP
    if not (folder / MapRecord.FILE).is_file():
        return None
    found, made = read_map(folder), record.data.provenance.fingerprint
    about = found.provenance.fingerprint
    return found if made and about and not made.apart_from(about) else None


def views_in(record: Record[ProbeRecord], mapped: MapRecord | None) -> list[dict[str, Any]]:
    """Training views whose pictures lie in the folder: photograph, render and, where there is a map, the mapped ones with it.

    A view has its "name" and its "pictures": "words", "uri" and "legend" (the scale of a map's colours, else empty).
    """
    names, folder = record.data.provenance.views or [], record.folder
    pairs = [(folder / PHOTOGRAPH.format(i), folder / RENDER.format(i)) for i in range(len(names))]
    drawn = [i for i, pair in enumerate(pairs) if all(path.is_file() for path in pair)]
    maps = record.folder.parent / MAP
    panels = {panel.place: panel.file for panel in (mapped.panels if mapped else []) if panel.place in drawn}
    panels = {place: file for place, file in panels.items() if (maps / f"{file}.npz").is_file()}
    views = []
    for i in sorted(panels) or drawn:
        pictures = [
            {"words": words, "uri": data_uri(path.read_bytes(), "jpeg"), "legend": ""}
            for words, path in zip(("photograph", "render"), pairs[i])
        ]
        if mapped and panels:
            shades = {name: mapped.shades[name] for name in (mapped.field, "error")}
            arrays = read_maps(maps, panels[i], shades)
            for name, shade in shades.items():
                coloured = Image.fromarray(shade.palette[arrays[name]])
                coloured.thumbnail(read_picture(pairs[i][0]).size)
                uri = picture_uri(coloured, COARSE)
                pictures.append({"words": shade.title, "uri": uri, "legend": shade.legend})
        views.append({"name": names[i], "pictures": pictures})
    return views


def map_pictures(folder: Path, mapped: MapRecord | None) -> list[dict[str, str]]:
    """Pictures of the map in a folder: "uri", "words", the "text" above and the "caption" below each."""
    if mapped is None:
        return []
    ends = mapped.steepest
    rows = [(end.file, f"{end.sentence} {end.rendered}", end.sentence, carriers_in_words(end)) for end in ends]
    fragile, named = "\n".join(mapped.sentences[len(mapped.steepest) :]), {end.view for end in mapped.steepest[:1]}
    panel = next((panel for panel in mapped.panels if panel.name in named), mapped.panels[0] if mapped.panels else None)
    words = f"{panel.name}: maps of its fragility in position, conditioning and opacity. {PIXEL}" if panel else ""
    rows.append((panel.file.replace("view", "fragility") if panel else "", fragile, words, words))
    return [
        {"text": text, "caption": caption, "words": words, "uri": picture_uri(path) if path.is_file() else ""}
        for path, text, words, caption in ((folder / f"{name}.png", *rest) for name, *rest in rows)
    ]


def carriers_in_words(end: Steepest) -> str:
    """The caption of the picture of an end of the spectrum."""
    carriers = "; ".join(
        f"Gaussian {each.gaussian:,} has {percent(each.share)} of it: standard deviations "
        f"{', '.join(map(quantity, each.sigmas))} world units, opacity {each.opacity:.2f}, {ratio(each.aspect)} in the picture"
        for each in end.carriers
    )
    place = f"{end.name} in {end.view.rpartition('/')[2]}"
    first = end.carriers[0]
    turn = 2 * math.degrees(math.atan(end.step * math.sqrt(first.attributes.get("quats", 0.0))))
    turned = f" The step turns Gaussian {first.gaussian:,} by {quantity(turn)}°." if turn > 0 else ""
    length = f" ({end.length})" if end.length else ""
    pictures = f"its carriers, outlined at two standard deviations, and renders a step back and forth{length}"
    return f"{place}: {pictures}. {carriers}.{turned}"


def picture_uri(picture: Path | Image.Image, quality: int = FINE) -> str:
    """A picture as a data URI; WebP takes a quarter of the bytes of PNG."""
    content, image = io.BytesIO(), read_picture(picture) if isinstance(picture, Path) else picture
    image.convert("RGB").save(content, "WEBP", quality=quality, method=EFFORT)
    return data_uri(content.getvalue(), "webp")


def data_uri(content: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def pictures_in(
    folder: Path, captions: Mapping[str, str], words: Mapping[str, str] | None = None
) -> list[dict[str, str]]:
    """The pictures NAME.png that lie in a folder: "name", "uri", "caption", and alternative text, by default the caption."""
    return [
        {"name": name, "caption": caption, "words": (words or {}).get(name, caption), "uri": picture_uri(path)}
        for name, caption in captions.items()
        if (path := folder / f"{name}.png").is_file()
    ]


def shown_numbers(record: Record[ProbeRecord]) -> dict[str, str]:
    """Alternative texts of the pictures, by name: the numbers that they show."""
    data, ends = record.data, record.data.eigenvalues
    traces = ", ".join(f"{attribute_name(name)} {quantity(trace.value)}" for name, trace in data.traces.items())
    found = {
        "spectrum": f"Curvatures from {quantity(ends.min.value)} to {quantity(ends.max.value)}, in order of size.",
        "traces": f"Traces: {traces}.",
    }
    if data.slice is not None and "slice" in record.arrays:
        loss, names = record.arrays["slice"]["loss"], " and ".join(each.name for each in data.slice.directions)
        extent = " to ".join(quantity(float(end(loss))) for end in (np.nanmin, np.nanmax))
        plane = f"over the plane of {names}: from {extent}, at the centre {quantity(data.slice.center_loss)}."
        found |= {"slice2d": f"Contours of the loss {plane}", "surface": f"Surface of the loss {plane}"}
    return found


def _cell(value: Any) -> str:
    """A value of the record in a table: counts with separators, numbers with three digits, other values as `str`."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, list):
        return ", ".join(map(_cell, value))
    return quantity(value) if value is None or isinstance(value, float) else str(value)
