"""What float32 costs is measured against float64, with decisions held equal."""

from dataclasses import replace

import pytest
import torch

from analysis.precision import precision, same_decisions
from analysis.workloads import Size, Workload, synthetic_workload
from splat.losses_cpu import ViewLoss
from splat.settings import RenderSettings


@pytest.fixture(scope="module")
def workload() -> Workload:
    made = synthetic_workload(Size(60, 40, 24))
    return replace(made, views=made.views[:1])


def test_with_decisions_held_round_scenes_keep_the_digits_of_float32(workload):
    lines = {line.quantity: line for line in precision(workload) if line.decisions == "held equal"}
    assert {"image", "gradient", "H v, vector 0", "trace of quats", "trace of sh"} <= lines.keys()
    assert all(0 < line.error < 1e-5 for line in lines.values())


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
        return ViewLoss(
            image.numpy() * (1.01 if dtype == torch.float32 else 1.0), loss, torch.empty(0, dtype=dtype).numpy().dtype
        )

    monkeypatch.setattr("analysis.precision.ViewLoss.of", spoiled)
    lines = {line.quantity: line.error for line in precision(workload) if line.decisions == "held equal"}
    assert lines["image"] < 1e-5 < 1e-4 < lines["gradient"]
