"""A view, an objective and a training on the GPU (without one, by Triton's interpreter), against CPU and specification."""

import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="the kernels for GPUs need triton")

from splat.curvature.hessian import SceneHessian
from splat.curvature.linearize import LinearizedView
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.backend import backend_of
from splat.render.render import Backend, render
from splat.scenes.view import View
from splat.training.state import Training
from tests.splat.gpu.interpreted import emulate
from tests.splat.held_scenes import BACKGROUND, gradient_and_products, two_views
from tests.splat.random_scenes import MODES, filtered, random_gaussians, random_like
from tests.splat.tiny import EXTENT, ended, tiny_config, tiny_gaussians
from tests.splat.tolerances import DERIVATIVE, errors_by_block, relative_error

LOSS = LossSettings("charbonnier")


@pytest.fixture
def gpu(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The device, with its kernels for all tensors on it."""
    emulate(monkeypatch, device.type == "cpu")
    return device


def scene(dtype: torch.dtype) -> Gaussians:
    """Opaque ones in front that stop pixels, a needle, one that no pixel sees."""
    gaussians = random_gaussians(8, 1, logit=1.0, spread=0.4)
    gaussians.opacity_logits[:3], gaussians.log_scales[:3] = 7.0, -0.7
    gaussians.log_scales[3] = torch.tensor([0.5, -5.0, -5.0])
    gaussians.means[4, 2] = -3.0
    return gaussians.to(dtype)


def views() -> list[View]:
    """Of two tiles each; the loss has one program, as those of more are in `test_loss.py`."""
    return two_views(17, 5)


def on(gaussians: Gaussians, device: torch.device) -> Gaussians:
    return gaussians.with_flat(gaussians.flat.to(device))


@pytest.mark.parametrize(
    ("dtype", "mode"), [(torch.float32, "none"), (torch.float64, "none"), (torch.float64, "mip-splatting")]
)
def test_gradient_and_products_of_a_view_on_the_gpu_are_those_of_the_specification(dtype, mode, gpu):
    vectors = 3 if dtype == torch.float64 else 1
    view, U = views()[0], random_like((scene(dtype).flat.numel(), vectors), 1).float()
    given, settings = filtered(scene(torch.float64), mode), MODES[mode]
    gradient, products = gradient_and_products(given, [view], LOSS, U.double(), settings)
    gaussians = on(given.to(dtype), gpu)
    loss = backend_of(gaussians.flat).view_loss(view.image, LOSS, gaussians.flat)
    held = LinearizedView(gaussians, view.camera, loss, BACKGROUND, settings)
    assert max(errors_by_block(held.gradient.cpu(), gradient, gaussians.blocks).values()) < DERIVATIVE[dtype]
    hvp = held.hvp(U.to(gpu, dtype))
    assert max(errors_by_block(hvp.cpu(), products, gaussians.blocks).values()) < DERIVATIVE[dtype]
    assert torch.equal(held.hvp(U.to(gpu, dtype)), hvp)
    assert held.touched <= 7 and held.bytes > 0 and held.workspace(2) > held.workspace(1)


def test_all_that_a_view_on_the_gpu_gives_is_what_one_on_the_cpu_gives(device, monkeypatch):
    view, gaussians = views()[0], scene(torch.float64)
    U, G = random_like((gaussians.flat.numel(), 2), 2), random_like((2, 4, 5, 17), 3)

    def everything(gaussians: Gaussians) -> list[Tensor]:
        loss = backend_of(gaussians.flat).view_loss(view.image, LOSS, gaussians.flat)
        held = LinearizedView(gaussians, view.camera, loss, BACKGROUND, RenderSettings())
        own, coarse = (held.block_diagonals(approximate=True, parts=(part,))[0] for part in (False, True))
        u = U.to(gaussians.flat)
        found = [held.image, held.gradient, held.jvp(u), held.vjp(G.to(u)), held.hvp(u), held.ggn(u)]
        found += [own.geometry, own.sh, coarse.geometry, coarse.sh, *held.loss_curvatures(u)]
        return [each.cpu() for each in found]

    expected = everything(gaussians)
    emulate(monkeypatch, device.type == "cpu")
    for got, one in zip(everything(on(gaussians, device)), expected, strict=True):
        assert relative_error(got, one) < 1e-12


def test_the_hessian_of_a_scene_on_the_gpu_is_that_on_the_cpu(device, monkeypatch):
    gaussians = scene(torch.float64)
    V = random_like((gaussians.flat.numel(), 2), 2)

    def products(gaussians: Gaussians) -> list[Tensor]:
        objective = SceneObjective(gaussians, views()[:1], LOSS, BACKGROUND, keep_unseen=True)
        value = torch.tensor(objective.loss(objective.active.flat))
        operators = [SceneHessian(objective), SceneHessian(objective, gauss_newton=True)]
        found = [operator.apply(V.to(gaussians.flat)) for operator in operators]
        return [value, objective.gradient.cpu(), *(each.cpu() for each in found)]

    expected = products(gaussians)
    emulate(monkeypatch, device.type == "cpu")
    for got, one in zip(products(on(gaussians, device)), expected, strict=True):
        assert relative_error(got, one) < 1e-10  # the projectors are found by singular value decompositions


def test_images_on_the_gpu_are_twice_differentiable(gpu):
    view, gaussians = views()[0], scene(torch.float64)
    weight = random_like((3, 5, 17), 4)
    found = []
    cases: list[tuple[Backend, Gaussians]] = [("reference", gaussians), ("kernels", on(gaussians, gpu))]
    for backend, at in cases:
        flat = at.flat.clone().requires_grad_()
        image = render(at.with_flat(flat), view.camera, BACKGROUND, backend=backend).image
        value = (image.square() * weight.to(flat)).sum()
        (gradient,) = torch.autograd.grad(value, flat, create_graph=True)
        (product,) = torch.autograd.grad((gradient * random_like(flat.shape, 5).to(flat)).sum(), flat)
        found.append([each.detach().cpu() for each in (image, gradient, product)])
    for one, other in zip(*found, strict=True):
        assert relative_error(other, one) < 1e-12


def test_a_training_on_the_gpu_takes_the_steps_of_one_on_the_cpu(device, monkeypatch):
    expected, found = (Training.start(tiny_gaussians(dtype=torch.float64), EXTENT, tiny_config(3)) for _ in range(2))
    ended(expected, views())
    emulate(monkeypatch, device.type == "cpu")
    found.move(device)
    ended(found, views())
    assert len(found.gaussians) == len(expected.gaussians) and found.adam.updates == expected.adam.updates == 3
    # Adam divides by the gradient's own size, so that what is next to 0 keeps few digits
    assert relative_error(found.gaussians.flat.cpu(), expected.gaussians.flat) < 1e-9
