"""The figure of a slice along a line: what is drawn is what was recorded, and stays legible."""

import math

import numpy as np
import pytest
from matplotlib.colors import to_hex

from analysis.records.quantities import rough
from figures import make_all, slice1d, slice2d
from figures.style import BLACK, BLUE, SKY, VERMILION
from tests.figures.test_figures import require_layout
from tests.recorded import synthetic, synthetic_line, written
from tests.refusals import refused


def difficult(case):
    if case in {"1e-12", "1e9"}:
        return synthetic_line(float(case))
    data, arrays = synthetic_line()
    if case == "no numbers":
        arrays["slice"]["loss"][:5] = math.nan
        data["finite_probe"]["curvatures"][0] = None
        data["finite_probe"]["round_off"] = [None] * 4
    if case == "flat":
        arrays["slice"]["loss"][:] = data["slice"]["center_loss"]
        data["finite_probe"] |= {"infinitesimal": 0.0, "curvatures": [0.0] * 4, "round_off": [0.0] * 4}
        data["slice"]["directions"][0] |= {"curvature": 0.0, "unit": math.inf}
    if case == "least":
        data["finite_probe"] = None
        arrays = {"slice": {name: arrays["slice"][name] for name in ("x", "loss")}}
    return data, arrays


@pytest.mark.parametrize("case", ["plain", "1e-12", "1e9", "no numbers", "flat", "least"])
def test_labels_stay_inside_the_column_and_apart_whatever_the_record(tmp_path, case):
    figure = slice1d.draw(written(tmp_path / "slice", *difficult(case)))
    require_layout(figure)


def test_the_titles_name_the_direction_and_say_how_the_loss_curves_beside_the_curvature(tmp_path):
    data, arrays = synthetic_line()
    center = data["slice"]["center_loss"]
    arrays["slice"]["loss"] = center + 3 * (arrays["slice"]["model"] - center)
    above, below = (axes.get_title(loc="left") for axes in slice1d.draw(written(tmp_path / "slice", data, arrays)).axes)
    name, said = data["slice"]["directions"][0]["name"], "what its\ncurvature says, at 0.15 to 1.5 curvature units"
    assert above == f"Along {name} the loss curves up 3.0 times {said}"
    steps = f"{rough(1e-5)} to {rough(1e-3)}"
    assert below == f"At finite steps 1.0 to 1.8 times the curvature\n(steps of {steps}; bars: round-off)"


def test_dots_are_renders_and_the_blue_ones_are_crossed(tmp_path):
    record = written(tmp_path / "slice", *synthetic_line())
    above, arrays = slice1d.draw(record).axes[0], record.arrays["slice"]
    dots = {line.get_color(): np.asarray(line.get_xdata()) for line in above.lines if line.get_marker() == "."}
    assert dots[SKY] == pytest.approx(arrays["x"][arrays["crossed"]] * 1e3)
    assert dots[BLACK] == pytest.approx(arrays["x"][arrays["evaluated"] & ~arrays["crossed"]] * 1e3)
    (model,) = [line for line in above.lines if line.get_color() == VERMILION]
    change = arrays["model"] - record.data.slice.center_loss
    assert np.asarray(model.get_ydata()) == pytest.approx(change * 1e6, abs=1e-9)


def test_curvatures_that_round_off_hides_set_no_limits_and_have_no_dot(tmp_path):
    record = written(tmp_path / "slice", *synthetic_line())
    below, probe = slice1d.draw(record).axes[1], record.data.finite_probe
    dots = {to_hex(line.get_markerfacecolor()): line for line in below.lines if line.get_marker() == "o"}
    assert list(np.asarray(dots[BLUE.lower()].get_xdata())) == probe.steps[1:2]
    assert list(np.asarray(dots["#ffffff"].get_ydata())) == probe.curvatures[2:]
    low, high = below.get_ylim()
    assert 20 < low < 37 and 70 < high < 90
    labels = below.get_legend_handles_labels()[1]
    assert "infinitesimal: 40.0" in labels and "hidden by round-off" in labels


def test_a_value_that_is_hardly_known_does_not_flatten_the_others(tmp_path):
    data, arrays = synthetic_line()
    probe = data["finite_probe"]
    probe["curvatures"][0], probe["round_off"][0] = -9000.0, 3000.0
    below = slice1d.draw(written(tmp_path / "slice", data, arrays)).axes[1]
    low, high = below.get_ylim()
    assert 20 < low < 37 and 70 < high < 90
    (beyond,) = [line for line in below.lines if line.get_marker() == "v"]
    assert list(np.asarray(beyond.get_xdata())) == probe["steps"][:1] and list(np.asarray(beyond.get_ydata())) == [low]
    assert "beyond the axis" in below.get_legend_handles_labels()[1]


def test_a_line_has_one_figure_and_a_plane_is_asked_for_elsewhere(tmp_path):
    record = written(tmp_path / "slice", *synthetic_line())
    assert [path.name for path in make_all.draw_probe(record.folder)] == ["slice1d.png"]
    refused("got one along a line", slice2d.draw, record)


def test_without_a_line_or_a_finite_loss_it_says_so(tmp_path):
    data, arrays = synthetic_line()
    arrays["slice"]["loss"][:] = math.nan
    refused("expected finite losses", slice1d.draw, written(tmp_path / "slice", data, arrays))
    refused("expected a slice along a line", slice1d.draw, written(tmp_path / "plane", *synthetic()))
