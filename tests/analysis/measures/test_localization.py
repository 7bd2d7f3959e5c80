from dataclasses import replace

import pytest
import torch

from analysis.measures.localization import conditions, localize, masses, participation
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.reference import project
from tests.refusals import misused
from tests.splat.tiny import tiny_gaussians, tiny_views

FOCAL, DEPTH = 40.0, 4.0
CAMERA = Camera(torch.eye(3).double(), torch.zeros(3).double(), FOCAL, FOCAL, 16.0, 12.0, 32, 24)


def facing(*scales: tuple[float, float]) -> Gaussians:
    """Gaussians on the optical axis with these standard deviations along x and y."""
    n = len(scales)
    attributes = {
        "means": torch.tensor([0.0, 0.0, DEPTH]).repeat(n, 1),
        "log_scales": torch.tensor([[x, y, 1e-3] for x, y in scales]).log(),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        "opacity_logits": torch.zeros(n),
        "sh": torch.zeros(n, 4, 3),
    }
    return Gaussians.pack(attributes).to(torch.float64)


def test_conditions_are_ratios_of_squared_widths_with_the_blur() -> None:
    scales = [(0.1, 0.1), (0.4, 0.1), (0.8, 0.002), (0.8, 1e-6)]
    found = conditions(facing(*scales), [CAMERA])
    widths = torch.tensor(scales, dtype=torch.float64).square() * (FOCAL / DEPTH) ** 2
    blurred = widths + RenderSettings().blur
    assert torch.allclose(found, blurred[:, 0] / blurred[:, 1], rtol=1e-6)  # scales were stored in float32


def test_conditions_are_the_largest_over_the_views_that_show_a_gaussian() -> None:
    gaussians, cameras = tiny_gaussians(dtype=torch.float64), [view.camera for view in tiny_views()]
    together, alone = conditions(gaussians, cameras), [conditions(gaussians, [camera]) for camera in cameras]
    assert torch.equal(together, torch.stack(alone).amax(dim=0))
    for camera, one in zip(cameras, alone, strict=True):
        a, b, c = project(gaussians, camera).conics.unbind(-1)
        values = torch.linalg.eigvalsh(torch.stack([a, b, b, c], dim=-1).view(-1, 2, 2))
        ratio = values[:, 1] / values[:, 0]
        assert torch.allclose(one, torch.where(one == 1, one, ratio), rtol=1e-9)
    behind = replace(CAMERA, centre=torch.tensor([0.0, 0.0, 10.0], dtype=torch.float64))
    assert conditions(facing((0.8, 0.002)), [behind]).tolist() == [1.0]


def test_a_vector_on_one_needle_lives_there_alone() -> None:
    gaussians = facing((0.1, 0.1), (0.8, 0.002), (0.4, 0.1))
    vector = torch.zeros(gaussians.flat.numel(), dtype=torch.float64)
    parts = gaussians.with_flat(vector)
    parts.means[1, 2], parts.sh[1, 3, 0] = 3.0, 4.0
    found = localize(vector, gaussians, conditions(gaussians, [CAMERA]))
    assert found.participation == 1.0
    assert (found.needles, found.needle_count) == (1.0, 1)
    parts.opacity_logits[:] = torch.tensor([5.0, 0.0, 0.0])
    found = localize(vector, gaussians, conditions(gaussians, [CAMERA]))
    assert found.participation == pytest.approx(2.0) and found.needles == pytest.approx(0.5)


def test_the_blur_hides_needles_thinner_than_a_pixel() -> None:
    gaussians = facing((0.3, 0.001))
    vector = torch.ones(gaussians.flat.numel(), dtype=torch.float64)
    found = localize(vector, gaussians, conditions(gaussians, [CAMERA]))
    assert (found.needles, found.needle_count) == (0.0, 0)


def test_masses_are_spread_as_the_vector_is() -> None:
    gaussians = tiny_gaussians(40, sh_degree=2, dtype=torch.float64)
    even = masses(torch.ones_like(gaussians.flat), gaussians)
    assert even.tolist() == [38.0] * 40 and participation(even) == pytest.approx(40)


def test_vectors_that_do_not_fit_or_have_no_length_are_refused() -> None:
    gaussians = facing((0.1, 0.1))
    misused("expected a vector of 23 parameters", masses, torch.ones(3), gaussians)
    for value in (0.0, float("nan")):
        misused("finite vector that is not zero", masses, torch.full((23,), value), gaussians)
