"""Settings and values of a file: what their types exclude is refused by name, in one line."""

from math import inf, nan
from typing import Any

import pytest
import torch

from splat.model.typed import Count, typed
from splat.training.densify import DensifySettings
from splat.training.methods.corgs import CoRGS
from splat.training.methods.depth import FSGS, DNGaussian
from splat.training.methods.dropout import DropGaussian, DropoutGS
from splat.training.methods.sam import SAM
from splat.training.methods.stablegs.attribute_probe import Caps, Constants, ProbeSettings
from splat.training.methods.stablegs.stablegs import StableGS
from splat.training.methods.stablegs.viewpoint_probe import ViewpointSettings
from splat.training.state import LearningRates, TrainConfig
from tests.refusals import refused

WRONG: list[tuple[type, str, Any]] = [  # each of the values for each of the names
    (TrainConfig, "iterations", [0, 1.5, "many"]),
    (TrainConfig, "sh_degree", [4, -1]),
    (TrainConfig, "sh_degree_every", [0]),
    (TrainConfig, "seed", [-1, 2**63]),
    (TrainConfig, "background", [(0.0, 0.0, 2.0), (0.0, 1.0), (nan, 0.0, 0.0)]),
    (LearningRates, "position", [inf, 0.0]),
    (LearningRates, "position_final", [0.0]),
    (LearningRates, "quats opacity_logits", [-1.0, nan]),
    (DensifySettings, "every reset_every gradient_threshold", [0]),
    (DensifySettings, "start stop every_share prune_scale", [-1]),
    (DensifySettings, "clone_scale", [0.0, nan]),
    (DensifySettings, "stop_share", [1.5]),
    (DensifySettings, "reset_opacity", [1.0]),
    (DropGaussian, "p_max", [0.0, 1.0, nan]),
    (DropoutGS, "p", [0.0, 1.0]),
    (DropoutGS, "weight", [0.0, inf]),
    (SAM, "rho", [0.0, nan]),
    (SAM, "metric", ["l2"]),
    (CoRGS, "prune_every prune_start pseudo_start noise", [-1]),
    (CoRGS, "distance", [0.0]),
    (CoRGS, "weight", [nan]),
    (FSGS, "neighbours threshold", [0]),
    (FSGS, "unpool_until depth_until depth_weight", [-1]),
    (FSGS, "large", [nan]),
    (FSGS, "late_depth_weight", [inf]),
    (FSGS, "depths", ["metres"]),
    (DNGaussian, "hard_start soft_start local_weight", [-1]),
    (DNGaussian, "smallest_patch", [1]),
    (DNGaussian, "global_weight tolerance", [nan, inf]),
    (DNGaussian, "depths", ["metres"]),
    (StableGS, "warm_up asp_weight", [-1]),
    (StableGS, "every sampled_every", [0]),
    (StableGS, "vsp_weight", [nan]),
    (StableGS, "traces viewpoints asp_views vsp_gradient", ["guess"]),
    (StableGS, "accuracy vsp_share", [0.0, nan]),
    (StableGS, "vsp_share", [1.1]),
    (ProbeSettings, "attributes", [("colour",)]),
    (ProbeSettings, "dimension dose rotation_unit", ["degree"]),
    (ProbeSettings, "eps kappa_full", [0.0]),
    (ProbeSettings, "gamma", [1.1]),
    (Constants, "means", [-1.0, inf]),
    (Caps, "quats", [0.0, nan]),
    (ViewpointSettings, "t_min", [nan, -2.0]),
    (ViewpointSettings, "theta_sigma", [-1.0, 61.0]),
    (ViewpointSettings, "parallax_sigma", [inf]),
    (ViewpointSettings, "capture axis", ["z"]),
]


@pytest.mark.parametrize(("kind", "names", "values"), WRONG, ids=lambda value: str(getattr(value, "__name__", "")))
def test_settings_outside_of_their_ranges_are_refused_by_name(kind, names, values):
    kind()
    for name in names.split():
        for value in values:
            refused(rf"^'{name}(\[\d\])?': expected .*, got ", kind, **{name: value})


@pytest.mark.parametrize(
    ("kind", "content", "words"),
    [
        (LearningRates, {"quats": "fast"}, "^'c.quats': expected float, got str$"),
        (TrainConfig, {"loss": {"pixel": "l3"}}, "^'c.loss.pixel': expected 'l1' or 'charbonnier' or 'l2', got 'l3'$"),
        (TrainConfig, {"rates": {"position": -1}}, "^'c.rates.position': expected float > 0.0, got -1$"),
        (TrainConfig, {"loss": 3}, "^'c.loss': expected object, got int$"),
        (TrainConfig, {"background": (0, 10**400, 0)}, r"^'c.background\[1\]': expected float, got a whole number of"),
        (list[Count], [1, -1], r"^'c\[1\]': expected int >= 0, got -1$"),
        (dict[str, Count], {"a": torch.zeros(2)}, r"^'c\[...\]': expected int, got Tensor$"),
        (DensifySettings, {"min_opacity": 0.5}, "^'c': expected min_opacity < reset_opacity"),
        (TrainConfig, {"loss": {"pixel": "\ud800"}}, r"^'c': expected text, got '\\ud800'$"),
    ],
)
def test_values_of_a_file_are_refused_with_key_expected_and_got(kind, content, words):
    refused(words, typed, kind, content, "c")


def test_values_that_fit_become_what_they_should_be():
    expected = TrainConfig(background=(0.0, 1.0, 0.5), rates=LearningRates(quats=1.0))
    assert typed(TrainConfig, {"background": [0, 1, 0.5], "rates": {"quats": 1}}) == expected
