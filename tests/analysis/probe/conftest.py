"""A checkpoint that was probed, and its dense Hessian: made once, for all tests of this folder."""

from contextlib import nullcontext
from pathlib import Path

import pytest
import torch

from analysis.commands.cli import main
from analysis.records.records import Record
from splat.render.render import render
from splat.scenes.synthetic import synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint
from tests.analysis.probe.probed import SCENE, save_double, unlimited
from tests.splat.photometric import photometric_loss


@pytest.fixture(scope="session")
def run(tmp_path_factory) -> Path:
    """A run folder with its scene beside it; the checkpoint is in double precision."""
    folder = tmp_path_factory.mktemp("probe")
    write_transforms_scene(synthetic_scene(SCENE).scene, folder / "still")
    out = folder / "run"
    settings = ["--iterations", "30", "--no-densify", "--sh-degree", "1"]
    assert main(["train", str(folder / "still"), "--out", str(out), *settings]) == 0
    save_double(out / "checkpoint.pt", out / "double.pt")
    return out


@pytest.fixture(scope="session")
def record(run) -> Record:
    return unlimited(run / "double.pt", run / "recorded")


@pytest.fixture
def no_pictures(monkeypatch):
    """For tests of the numbers alone."""
    monkeypatch.setattr("analysis.console.drawing.drawing", lambda *_: nullcontext(lambda target: []))


@pytest.fixture(scope="session")
def dense(run):
    """(objective, P H P, L, gradient): double backward through the reference renderer, on the quaternions' tangent spaces."""
    path = run / "double.pt"
    loaded = load_checkpoint(path)
    objective = loaded.with_scene(path).objective()
    active, settings = objective.active, loaded.training.config.loss

    def loss(flat):
        images = (render(active.with_flat(flat), v.camera, backend="reference").image for v in objective.views)
        losses = [photometric_loss(i, v.image.double(), settings) for i, v in zip(images, objective.views, strict=True)]
        return torch.stack(losses).mean()

    point = active.flat.clone().requires_grad_()
    value = loss(point)
    (gradient,) = torch.autograd.grad(value, point, create_graph=True)
    (H,) = torch.autograd.grad(
        gradient, point, torch.eye(len(point), dtype=torch.float64), retain_graph=True, is_grads_batched=True
    )
    gradient = gradient.detach()
    for i, q in enumerate(active.quats):
        rows = slice(active.blocks["quats"].start + 4 * i, active.blocks["quats"].start + 4 * i + 4)
        H[rows] -= torch.outer(q, q @ H[rows])
        H[:, rows] -= torch.outer(H[:, rows] @ q, q)
    return objective, H, float(value.detach()), gradient
