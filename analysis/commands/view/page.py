"""The page of `landscape view --html`: viser's own of the scene, with a panel that switches the colours of the splats.

Without a server viser's only control is the tree of its nodes, so every field is a node with splats of its own.  One
is visible; the panel switches by the tree.
"""

from pathlib import Path

from analysis.commands.view.viewer import APPEARANCE, Viewer
from analysis.records.page.report import template_environment

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
    page, panel = scene.as_html(), template_environment(Path(__file__).parent).get_template("panel.html.jinja")
    end = page.rindex("</body>")
    return page[:end] + panel.render(entries=entries) + page[end:]
