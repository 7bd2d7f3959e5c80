"""The thresholds of the renderer."""

import pytest
import torch

from splat.model.settings import RenderSettings
from tests.refusals import refused


def test_defaults_are_those_of_the_original_rasterizer():
    settings = RenderSettings()
    assert (settings.blur, settings.fov_clamp, settings.near) == (0.3, 1.3, 0.2)
    assert (settings.alpha_max, settings.alpha_min, settings.transmittance_min) == (0.99, 1 / 255, 1e-4)


def test_a_pixel_in_float32_stops_at_the_threshold_itself():
    """What a training comes to depends on every bit of it."""
    assert RenderSettings().floor(torch.float32) == 1e-4 < RenderSettings().floor(torch.float64)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"alpha_max": 1.0}, "expected 0 < alpha_max < 1, got 1.0"),
        ({"alpha_max": 0.0}, "expected 0 < alpha_max < 1, got 0.0"),
        ({"alpha_min": 0.995}, "expected 0 <= alpha_min < alpha_max = 0.99, got 0.995"),
        ({"alpha_min": -0.1}, "expected 0 <= alpha_min"),
        ({"transmittance_min": 1.0}, "expected 0 <= transmittance_min < 1, got 1.0"),
        ({"transmittance_min": -1e-9}, "expected 0 <= transmittance_min < 1"),
        ({"blur": -0.1}, "'blur': expected float >= 0"),
        ({"near": 0.0}, "'near': expected float > 0"),
        ({"fov_clamp": 0.0}, "'fov_clamp': expected float > 0"),
        ({"contour_sigma": 0.0}, "'contour_sigma': expected float > 0.0, got 0.0"),
        ({"accumulation": "fast"}, "'accumulation': expected 'deterministic' or 'atomic', got 'fast'"),
    ],
)
def test_thresholds_out_of_range_are_refused(wrong, message):
    refused(message, RenderSettings, **wrong)
