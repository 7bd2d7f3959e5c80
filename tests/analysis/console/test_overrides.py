"""Settings changed by name, from text and from plain values."""

from dataclasses import asdict, replace

import pytest

from analysis.console.overrides import assignments, overridden
from splat.model.typed import leaves
from splat.training.methods.methods import METHODS
from splat.training.methods.stablegs.stablegs import StableGS
from splat.training.state import TrainConfig
from tests.refusals import refused

METHOD = StableGS()
STABLE = TrainConfig(method=METHOD)


def test_each_type_is_read_from_text_and_from_a_plain_value():
    method = METHOD
    for key, text, value, expected in [
        ("warm_up", "10", 10, replace(method, warm_up=10)),
        ("vsp_weight", "0", 0, replace(method, vsp_weight=0.0)),
        ("viewpoints", "one", "one", replace(method, viewpoints="one")),
        ("method.probe.gamma", "0.5", 0.5, replace(method, probe=replace(method.probe, gamma=0.5))),
        (
            "probe.attributes",
            "means, sh",
            ["means", "sh"],
            replace(method, probe=replace(method.probe, attributes=("means", "sh"))),
        ),
        ("probe.attributes", "", [], replace(method, probe=replace(method.probe, attributes=()))),
        ("viewpoint.parallax", "False", False, replace(method, viewpoint=replace(method.viewpoint, parallax=False))),
    ]:
        for given in (text, value):
            changed = overridden(STABLE, {key: given})
            assert changed == replace(STABLE, method=expected), key
    changed = overridden(STABLE, {"vsp_weight": 0}).method
    assert isinstance(changed, StableGS) and type(changed.vsp_weight) is float
    assert overridden(STABLE, {"background": "0,0.5,1"}).background == (0.0, 0.5, 1.0)
    assert overridden(STABLE, {"render.contour_sigma": "3"}).render.contour_sigma == 3.0
    assert overridden(STABLE, {"render.contour_sigma": "none"}).render.contour_sigma is None


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("warmup", "1", r"the method stablegs, got 'warmup'; did you mean warm_up\?$"),
        ("rho", "1", r"the method stablegs, got 'rho', which is one of --method sam$"),
        ("probe.gama", "1", "expected a setting among .*gamma.*, got 'gama' in 'probe.gama'; did you mean gamma"),
        ("name", "sam", "expected a setting of the training"),
        ("teapot", "1", r"or of the method stablegs, got 'teapot'; there are iterations, seed, .*rates.quats, .*gamma"),
        ("contour", "1", r"; there are .*render\.contour_sigma, "),
        ("densify", "1", "name of a single setting, as in densify.enabled"),
        ("seed.x", "1", "'seed' to be the last name"),
        ("warm_up", "1.5", "'warm_up': expected int, got '1.5'"),
        ("warm_up", 1.5, "'warm_up': expected int, got 1.5"),
        ("warm_up", True, "expected int, got True"),
        ("vsp_weight", "much", "'vsp_weight': expected float, got 'much'"),
        ("viewpoints", "two", "expected 'all' or 'one', got 'two'"),
        ("viewpoint.parallax", "maybe", "expected bool, got 'maybe'"),
        ("background", "0,1", "expected array of length 3, got 2"),
        ("probe.attributes", "colour", "expected 'means' or"),
        ("iterations", "none", "expected int, got 'none'"),
        ("every", "0", "'every': expected int >= 1, got 0"),
    ],
)
def test_what_does_not_fit_is_refused_with_what_was_expected(key, value, message):
    refused(message, overridden, STABLE, {key: value})


def test_an_assignment_has_a_key_and_an_equals_sign():
    assert assignments(["a=1", " b.c = x=y "]) == {"a": "1", "b.c": "x=y"}
    for text in ("a", "=1", ""):
        refused("expected KEY=VALUE", assignments, [text])
    refused("expected each KEY once, got --set a twice", assignments, ["a=1", " a = 2"])


@pytest.mark.parametrize("method", METHODS)
def test_no_setting_takes_a_number_that_float32_cannot_hold(method):
    config = TrainConfig(method=METHODS[method]())
    every = leaves({**asdict(replace(config, method=TrainConfig().method)), **asdict(config.method)})
    numbers = [name for name, value in every.items() if isinstance(value, float)]
    assert len(numbers) > 20
    for name in numbers:
        endless = [] if "caps." in name or name == "accuracy" else ["inf"]  # of which it stands for none
        for value in ("1e39", "-1e39", "1e308", "1e-320", "nan", "-inf", *endless):
            refused("expected", overridden, config, {name: value})
            refused("expected", overridden, config, {name: float(value)})
