"""gsplat's gradient, of a package that stands in for it."""

import sys
from types import ModuleType

import pytest
import torch

from analysis.bench.workloads import Size, synthetic_workload
from notebooks.accuracy.gsplat import MissingPeer, gsplat_gradient
from splat.render.backend import backend_of


def test_gsplat_is_given_the_same_view_and_the_same_loss(monkeypatch):
    workload, seen = synthetic_workload(Size(50, 16, 12)), {}

    def rasterization(means, quats, scales, opacities, colours, poses, lenses, width, height, **more):
        seen.update(more, poses=poses, lenses=lenses, size=(width, height), scales=scales)
        return (means.sum() + torch.zeros(1, height, width, 3)), None, {}

    module = ModuleType("gsplat")
    monkeypatch.setattr(module, "rasterization", rasterization, raising=False)
    monkeypatch.setitem(sys.modules, "gsplat", module)
    view = workload.views[0]
    loss = backend_of(workload.gaussians.flat).view_loss(view.image, workload.loss, workload.gaussians.flat)
    gsplat_gradient(workload, view, loss)()
    means = workload.gaussians.means
    homogeneous = torch.cat([means, torch.ones(len(means), 1)], dim=1) @ seen["poses"][0].T
    camera = view.camera
    offset = (means.double() - camera.centre) @ camera.rotation.double().T
    assert torch.allclose(homogeneous[:, :3].double(), offset, atol=1e-5)
    assert seen["size"] == (16, 12) and seen["lenses"][0, 0, 0] == pytest.approx(camera.fx)
    assert torch.equal(seen["scales"], workload.gaussians.log_scales.exp())

    monkeypatch.setattr(module, "rasterization", lambda *given, **more: 1 / 0)
    with pytest.raises(MissingPeer, match=r"gsplat does not run \(division by zero\)"):
        gsplat_gradient(workload, view, loss)
