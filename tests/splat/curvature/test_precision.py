"""What float32 costs is measured against float64, with decisions held equal."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from analysis.bench.workloads import Size, Workload, synthetic_workload
from splat.losses.cpu.loss import CpuViewLoss
from splat.model.settings import RenderSettings
from splat.projection.cpu import project_arrays
from splat.projection.formulas import lens_of
from tests.splat.curvature.precision import precision, same_decisions


@pytest.fixture(scope="module")
def workload() -> Workload:
    made = synthetic_workload(Size(60, 40, 24))
    return replace(made, views=made.views[:1])


def test_with_decisions_held_round_scenes_keep_the_digits_of_float32(workload):
    lines = {line.quantity: line for line in precision(workload) if line.decisions == "held equal"}
    assert {"image", "gradient", "H v, vector 0", "trace of quats", "trace of sh"} <= lines.keys()
    assert all(0 < line.error < 1e-5 for line in lines.values())


@pytest.fixture(scope="module")
def needles() -> Workload:
    """Lines across the image: half of the splats longer than wide by a factor of 19, the most slender one by 90."""
    made, generator = synthetic_workload(Size(60, 240, 180)), torch.Generator().manual_seed(0)
    share = torch.rand(60, 3, generator=generator)
    made.gaussians.log_scales[:] = share * torch.tensor([2.3, 0.5, 0.5]) - torch.tensor([2.3, 6.0, 6.0])
    made.gaussians.quats[:] = torch.randn(60, 4, generator=generator)
    return replace(made, views=made.views[:1])


def test_with_decisions_held_needles_keep_the_digits_of_float32(needles):
    camera = needles.views[0].camera
    splats, _, drawn = project_arrays(needles.gaussians, lens_of(camera, needles.settings))
    a, b, c = splats[drawn, 2:5].T
    ratio = np.sqrt(np.linalg.cond(np.stack([a, b, b, c], axis=1).reshape(-1, 2, 2)))
    assert np.median(ratio) > 15 and ratio.max() > 80
    errors = {line.quantity: line.error for line in precision(needles) if line.decisions == "held equal"}
    assert {"H v, vector 0", "trace of log_scales", "trace of quats"} <= errors.keys()
    assert max(errors.values()) < 1e-5, errors


def test_gaussians_that_change_places_in_the_order_are_told_apart(workload):
    gaussians, view = workload.gaussians, workload.views[0]
    assert same_decisions(gaussians, view, RenderSettings()).all()
    depth = (gaussians.means.double() - view.camera.centre) @ view.camera.forward
    first, second = depth.argsort()[:2].tolist()
    close = gaussians.to(torch.float64)
    close.means[max(first, second)] = close.means[min(first, second)]
    close.means[max(first, second)] -= 1e-10 * view.camera.forward  # equal in float32, nearer in float64
    agreed = same_decisions(close, view, RenderSettings())
    assert not agreed[first] and not agreed[second] and int((~agreed).sum()) == 2


def test_an_error_in_single_precision_alone_is_seen(workload, monkeypatch):
    def spoiled(image, loss, dtype):
        return CpuViewLoss(image * (1.01 if dtype == torch.float32 else 1.0), loss, dtype)

    monkeypatch.setattr("splat.render.backend.CpuViewLoss", spoiled)
    lines = {line.quantity: line.error for line in precision(workload) if line.decisions == "held equal"}
    assert lines["image"] < 1e-5 < 1e-4 < lines["gradient"]
