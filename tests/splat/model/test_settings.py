"""The thresholds of the renderer."""

import pytest

from splat.model.settings import SMOOTH, RenderSettings


def test_defaults_are_those_of_the_original_rasterizer():
    settings = RenderSettings()
    assert (settings.blur, settings.fov_clamp, settings.near) == (0.3, 1.3, 0.2)
    assert (settings.alpha_max, settings.alpha_min, settings.transmittance_min) == (0.99, 1 / 255, 1e-4)


def test_smooth_switches_off_every_threshold_that_can_be():
    assert SMOOTH.alpha_min == SMOOTH.transmittance_min == 0 and SMOOTH.contour_sigma is None


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"alpha_max": 1.0}, "expected 0 < alpha_max < 1, got 1.0"),
        ({"alpha_max": 0.0}, "expected 0 < alpha_max < 1, got 0.0"),
        ({"alpha_min": 0.995}, "expected 0 <= alpha_min < alpha_max = 0.99, got 0.995"),
        ({"alpha_min": -0.1}, "expected 0 <= alpha_min"),
        ({"transmittance_min": 1.0}, "expected 0 <= transmittance_min < 1, got 1.0"),
        ({"transmittance_min": -1e-9}, "expected 0 <= transmittance_min < 1"),
        ({"blur": -0.1}, "expected blur >= 0"),
        ({"near": 0.0}, "near > 0"),
        ({"fov_clamp": 0.0}, "fov_clamp > 0"),
        ({"contour_sigma": 0.0}, "expected contour_sigma > 0 or None, got 0.0"),
        ({"alpha_max": float("nan")}, "expected 0 < alpha_max < 1"),
        ({"blur": float("nan")}, "expected blur >= 0"),
        ({"near": float("inf")}, "all up to 1e.18, got .*near=inf"),
        ({"contour_sigma": float("nan")}, "expected contour_sigma > 0 or None, got nan"),
        ({"blur": 1e308}, "up to 1e.18, got .*blur=1e.308"),
        ({"near": 1e39}, "up to 1e.18"),
        ({"fov_clamp": 1e300}, "up to 1e.18"),
        ({"accumulation": "fast"}, "expected accumulation 'deterministic' or 'atomic', got 'fast'"),
    ],
)
def test_thresholds_out_of_range_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        RenderSettings(**wrong)
