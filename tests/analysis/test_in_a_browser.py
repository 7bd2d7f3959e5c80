"""The pages in a real browser: the report and `landscape view`, driven as a user drives them."""

from collections.abc import Callable, Iterator
from functools import partial
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from analysis.commands.map.fields import measured_fields
from analysis.commands.map.pictures import rendered
from analysis.commands.view import viewer as view
from analysis.commands.view.command import offline_page
from analysis.runs.compare import render_page
from analysis.runs.compare_table import Run, comparison
from analysis.runs.seeds import Group, grouped
from splat.curvature.objective import SceneObjective
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.training.origin.fingerprint import Fingerprint
from splat.training.state import TrainConfig
from tests.analysis.records.test_report import carried, with_views
from tests.browser import chromium, errors_in, requests_of, until
from tests.recorded import probe_of, synthetic
from tests.waiting import PATIENCE, waits_for

NOTHING = Fingerprint({}, {}, "")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


def keys_to(browser: Any, selector: str, *keys: str) -> None:
    browser.find_element("css selector", selector).send_keys(*keys)


def test_the_report_draws_moves_and_asks_for_nothing(browser, tmp_path):
    path = with_views(tmp_path / "probe", ["a.png", "b.png"])
    requests_of(browser)
    browser.get(path.as_uri())
    assert until(browser, "[...document.images].every(image => image.complete && image.naturalWidth > 0)")
    keys_to(browser, "#chosen", "\ue014")  # the right arrow
    assert until(browser, "document.querySelector('#views img').alt.endsWith('b.png')")
    assert until(browser, "document.querySelectorAll('#views img')[1].naturalWidth") == 8
    assert errors_in(browser) == [] and requests_of(browser) == [path.as_uri()]


def page_of_a_comparison(folder: Path) -> Path:
    """The page of two runs with long names and a picture."""
    data = probe_of(synthetic()[0])
    data.provenance.command = f"landscape probe {'folder/' * 40}checkpoint.pt"
    checkpoint: Any = SimpleNamespace(training=SimpleNamespace(config=TrainConfig(), step=4))
    runs = [Run(Path(name), name, checkpoint, None, data) for name in ("the_first_of_the_runs/" * 3, "other")]
    groups = [Group(run.label, (run.folder,)) for run in runs]
    folder.mkdir()
    Image.new("RGB", (2000, 900), "white").save(folder / "compare_traces.png")
    path = folder / "compare.html"
    path.write_text(render_page(runs, groups, grouped(comparison(runs), groups), ["it says"], [], folder), "utf-8")
    return path


@pytest.mark.parametrize("width", [420, 1280])
@pytest.mark.parametrize("compared", [False, True])
def test_nothing_of_the_pages_is_cut_or_scrolls_sideways(browser, tmp_path, width, compared):
    several = partial(with_views, names=["a.png", "b.png"], data=carried("a.png"))
    path = (page_of_a_comparison if compared else several)(tmp_path / "probe")
    screen = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    browser.get(path.as_uri())
    browser.execute_script("document.querySelectorAll('details').forEach(each => each.open = true)")
    beyond = "[...document.body.querySelectorAll('*')].filter(each => !each.closest('.scroll, svg')"
    beyond += " && each.getBoundingClientRect().right > innerWidth + 1).map(each => each.outerHTML.slice(0, 80))"
    assert browser.execute_script(f"return [document.documentElement.scrollWidth <= {width}, {beyond}]") == [True, []]
    if compared:  # a tap makes the picture as large as on a wide screen, and the page stays as wide as it was
        browser.find_element("css selector", "figure img").click()
        shown = "document.images[0].getBoundingClientRect().width"
        size = browser.execute_script(f"return [{shown} > 1000, document.documentElement.scrollWidth <= {width}]")
        assert size == [True] * 2 and browser.execute_script("return document.querySelectorAll('.scroll').length") == 1
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@pytest.fixture
def viewer() -> Iterator[view.Viewer]:
    viser = pytest.importorskip("viser", reason="needs viser; pip install -e '.[view]'")
    made = synthetic_scene(SyntheticSettings(gaussians=150, views=2, width=32, height=24))
    objective = SceneObjective(made.truth, made.scene.load())
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    found = view.Viewer(server, objective, 1)
    found.add_fields(measured_fields(objective, Path("nowhere"), NOTHING, [], lambda *_: None), "largest")
    direction = torch.zeros_like(objective.active.flat)
    direction[objective.blocks["sh"]] = 1.0
    found.add_steps({"e₁": (direction, 0.05)})
    yield found
    server.stop()


def test_a_click_a_field_and_a_step_reach_the_viewer(browser, viewer):
    from selenium.webdriver import ActionChains

    browser.get(f"http://127.0.0.1:{viewer.server.get_port()}")
    until(browser, "document.body.innerText.includes('training view')")
    until(browser, "/splats, from .+ to /.test(document.body.innerText)")
    camera, own = next(iter(viewer.server.get_clients().values())).camera, viewer.objective.views[1].camera
    assert np.allclose(camera.position, viewer.frame.place(own.centre), atol=1e-3)
    canvas = browser.find_element("tag name", "canvas")
    ActionChains(browser).move_to_element_with_offset(canvas, -130, 0).click().perform()
    until(browser, "/Gaussian \\d+, \\d+% of this pixel/.test(document.body.innerText)")
    assert "largest curvature" in viewer.numbers.content
    field = next(x for x in browser.find_elements("tag name", "input") if "largest" in x.get_attribute("value"))
    field.click()
    field.send_keys("\ue009a")  # all of it
    field.send_keys("condition")
    shown = "[...document.querySelectorAll('[role=option]')].filter(each => each.offsetHeight)"
    until(browser, f"{shown}.length === 1")  # what is left
    field.send_keys("\ue015", "\ue007")  # the first, by the arrow down and Enter
    waits_for(lambda: viewer.names[viewer.field.value] == "condition")
    until(browser, "document.body.innerText.includes('condition of its splat')")
    browser.find_elements("css selector", "[role=slider]")[-1].send_keys("\ue010")  # to the end
    (direction, reach), active = viewer.steps["e₁"], viewer.objective.active
    there = active.with_flat(active.flat + reach * direction)
    until(browser, f"document.body.innerText.includes('loss {view.quantity(viewer.objective.loss(there.flat))}')")
    assert (viewer.render.image == view.bytes_of(rendered(viewer.objective, 1, there))).all()


def test_the_page_of_the_splats_needs_no_network_and_switches_colours(browser, viewer, tmp_path):
    path = tmp_path / "view.html"
    path.write_text(offline_page(viewer, "condition"), encoding="utf-8")
    browser.get("about:blank")  # the page of a test before may still look for its server
    requests_of(browser)
    errors_in(browser)
    browser.set_network_conditions(offline=True, latency=0, throughput=0)
    browser.get(path.as_uri())
    shown = splats_of(browser, lambda _: True)
    assert "(long : short axis)²" in browser.find_element("id", "legend").text
    keys_to(browser, "#fields select", "appearance")
    splats_of(browser, lambda pixels: apart(pixels, shown) > 3)
    assert browser.find_element("id", "legend").text == ""
    keys_to(browser, "#fields select", "condition")
    splats_of(browser, lambda pixels: apart(pixels, shown) < 0.5)
    assert requests_of(browser) == [path.as_uri()]
    assert [error for error in errors_in(browser) if "Computed radius is NaN" not in error] == []  # viser's own
    browser.delete_network_conditions()


def splats_of(browser: Any, condition: Callable[[np.ndarray], bool]) -> np.ndarray:
    """The picture of the splats once they are drawn, two in a row are the same, and a condition holds."""
    from selenium.webdriver.support.ui import WebDriverWait

    before = np.zeros(())

    def drawn(_: Any) -> list[np.ndarray]:
        image = Image.open(BytesIO(browser.find_element("tag name", "canvas").screenshot_as_png)).convert("RGB")
        nonlocal before
        last, before = before, np.asarray(image, float)[:, image.width // 2 :]  # beside the panel
        done = len(image.getcolors(2**24) or []) > 2000 and np.array_equal(last, before) and condition(before)
        return [before] if done else []

    return WebDriverWait(browser, PATIENCE, 0.5).until(drawn)[0]


def apart(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one - other).mean())
