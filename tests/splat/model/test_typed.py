"""Settings and values of a file: what their types exclude is refused by name, in one line."""

from math import inf, nan
from typing import Any

import pytest
import torch

from landscape.errors import InputError
from splat.model.typed import Count, typed
from splat.training.densify import DensifySettings
from splat.training.methods.corgs import CoRGS
from splat.training.methods.depth.dngaussian import DNGaussian
from splat.training.methods.depth.fsgs import FSGS
from splat.training.methods.dropout.dropgaussian import DropGaussian
from splat.training.methods.dropout.dropoutgs import DropoutGS
from splat.training.methods.sam import SAM
from splat.training.methods.stablegs.attribute_probe import Caps, Constants, ProbeSettings
from splat.training.methods.stablegs.stablegs import StableGS
from splat.training.methods.stablegs.viewpoint_probe import ViewpointSettings
from splat.training.state import LearningRates, TrainConfig

WRONG: list[tuple[type, dict[str, list[Any]]]] = [
    (
        TrainConfig,
        {
            "iterations": [0, 1.5, "many"],
            "seed": [-1, 2**63],
            "sh_degree": [4, -1],
            "sh_degree_every": [0],
            "background": [(0.0, 0.0, 2.0), (0.0, 1.0), (nan, 0.0, 0.0)],
        },
    ),
    (LearningRates, {"position": [inf, 0.0], "position_final": [0.0], "quats": [-1.0], "opacity_logits": [nan]}),
    (
        DensifySettings,
        {
            "every": [0],
            "reset_every": [0],
            "start": [-1],
            "stop": [-1],
            "stop_share": [1.5],
            "every_share": [-0.1],
            "gradient_threshold": [0.0],
            "clone_scale": [0.0, nan],
            "prune_scale": [-1.0],
            "reset_opacity": [1.0],
        },
    ),
    (DropGaussian, {"p_max": [0.0, 1.0, nan]}),
    (DropoutGS, {"p": [0.0, 1.0], "weight": [0.0, inf]}),
    (SAM, {"rho": [0.0, nan], "metric": ["l2"]}),
    (
        CoRGS,
        {
            "prune_every": [-1],
            "prune_start": [-1],
            "pseudo_start": [-1],
            "distance": [0.0],
            "weight": [nan],
            "noise": [-0.1],
        },
    ),
    (
        FSGS,
        {
            "neighbours": [0],
            "unpool_until": [-1],
            "depth_until": [-1],
            "threshold": [0.0],
            "large": [nan],
            "depth_weight": [-1.0],
            "late_depth_weight": [inf],
            "depths": ["metres"],
        },
    ),
    (
        DNGaussian,
        {
            "local_weight": [-0.1],
            "global_weight": [nan],
            "tolerance": [inf],
            "hard_start": [-1],
            "soft_start": [-1],
            "smallest_patch": [1],
            "depths": ["metres"],
        },
    ),
    (
        StableGS,
        {
            "warm_up": [-1],
            "every": [0],
            "asp_weight": [-1.0],
            "vsp_weight": [nan],
            "traces": ["guess"],
            "viewpoints": ["some"],
            "accuracy": [0.0, nan],
            "sampled_every": [0],
            "asp_views": ["one"],
            "vsp_gradient": ["base"],
            "vsp_share": [0.0, 1.1, nan],
        },
    ),
    (
        ProbeSettings,
        {
            "attributes": [("colour",)],
            "dimension": ["all"],
            "eps": [0.0],
            "gamma": [1.1],
            "kappa_full": [0.0],
            "dose": ["double"],
            "rotation_unit": ["degree"],
        },
    ),
    (Constants, {"means": [-1.0, inf]}),
    (Caps, {"quats": [0.0, nan]}),
    (
        ViewpointSettings,
        {
            "t_min": [nan, -2.0],
            "theta_sigma": [-1.0, 61.0],
            "parallax_sigma": [inf],
            "capture": ["sphere"],
            "axis": ["z"],
        },
    ),
]


@pytest.mark.parametrize(("kind", "wrong"), WRONG, ids=[kind.__name__ for kind, _ in WRONG])
def test_settings_outside_of_their_ranges_are_refused_by_name(kind, wrong):
    kind()
    for name, values in wrong.items():
        for value in values:
            with pytest.raises(InputError, match=rf"^'{name}(\[\d\])?': expected .*, got "):
                kind(**{name: value})


@pytest.mark.parametrize(
    ("kind", "content", "words"),
    [
        (LearningRates, {"quats": "fast"}, "^'c.quats': expected float, got str$"),
        (
            TrainConfig,
            {"loss": {"pixel": "most"}},
            "^'c.loss.pixel': expected 'l1' or 'charbonnier' or 'l2', got 'most'$",
        ),
        (TrainConfig, {"rates": {"position": -1}}, "^'c.rates.position': expected float > 0.0, got -1$"),
        (TrainConfig, {"loss": 3}, "^'c.loss': expected object, got int$"),
        (
            TrainConfig,
            {"background": (0.0, 10**400, 0.0)},
            r"^'c.background\[1\]': expected float, got a whole number of more",
        ),
        (list[Count], [1, -1], r"^'c\[1\]': expected int >= 0, got -1$"),
        (dict[str, Count], {"a": torch.zeros(2)}, r"^'c\[...\]': expected int, got Tensor$"),
        (DensifySettings, {"min_opacity": 0.5}, "^'c': expected min_opacity < reset_opacity"),
    ],
)
def test_values_of_a_file_are_refused_with_key_expected_and_got(kind, content, words):
    with pytest.raises(InputError, match=words) as caught:
        typed(kind, content, "c")
    assert "\n" not in str(caught.value)


def test_values_that_fit_become_what_they_should_be():
    assert typed(TrainConfig, {"background": [0, 1, 0.5], "rates": {"quats": 1}}) == TrainConfig(
        background=(0.0, 1.0, 0.5), rates=LearningRates(quats=1.0)
    )
