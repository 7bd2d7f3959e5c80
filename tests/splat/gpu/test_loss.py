"""The losses on the GPU (without one, by Triton's interpreter), against the specification: the cases of the CPU's tests."""

import pytest
import torch

pytest.importorskip("triton", reason="the kernels for GPUs need triton")

from splat.gpu.loss import CudaImageLoss, CudaViewLoss
from splat.losses.autograd import view_loss
from splat.losses.reference import LossSettings
from splat.render.backend import backend_of
from tests.splat.gpu.interpreted import emulate
from tests.splat.losses.test_losses import SETTINGS, image_and_target, truth, truth_of_both
from tests.splat.photometric import photometric_loss
from tests.splat.random_scenes import random_like
from tests.splat.tolerances import DERIVATIVE, DTYPES, IMAGE, relative_error

SINGLE, DOUBLE = DTYPES
INSIDE = (14, 12)  # of two programs; a window lies inside
CASES = [
    *((INSIDE, settings, DOUBLE) for settings in SETTINGS),
    (INSIDE, SETTINGS[0], SINGLE),
    ((1, 40), SETTINGS[1], DOUBLE),
    ((40, 1), SETTINGS[1], SINGLE),
]
each_case = pytest.mark.parametrize(("size", "settings", "dtype"), CASES)


@each_case
def test_value_gradient_and_products_on_the_gpu_are_the_specifications(size, settings, dtype, device):
    expected = truth(size, settings)
    loss, image = CudaViewLoss(expected.target.to(device), settings, dtype), expected.image.to(device, dtype)
    held = loss.linearize(image)
    assert held.value == pytest.approx(float(expected.value), rel=IMAGE[dtype], abs=IMAGE[dtype])
    # kernels of their own, in which compilers fuse other products (Triton 3.6 does)
    assert loss.value(image) == pytest.approx(held.value, rel=8 * torch.finfo(dtype).eps)
    assert relative_error(held.gradient[:3].cpu(), expected.gradient) < DERIVATIVE[dtype]
    tangents = torch.cat([expected.v, expected.v[:, :1]], dim=1).to(device, dtype)
    products = held.hvp(tangents)
    assert relative_error(products[:, :3].cpu(), expected.product) < DERIVATIVE[dtype]
    assert not products[:, 3].any() and not held.gradient[3].any()
    full, pixelwise = (each.cpu() for each in held.curvatures(tangents))
    weights = (expected.v, held.diagonal.cpu().double() * expected.v)
    for found, factor, each in ((full, expected.product, expected.v), (pixelwise, *weights)):
        terms = (factor * each).flatten(1)
        assert ((found - terms.sum(dim=1)).abs() <= DERIVATIVE[dtype] * terms.abs().sum(dim=1)).all()
    assert torch.equal(held.hvp(tangents, out=tangents), products)


@pytest.mark.parametrize("settings", SETTINGS[1:3], ids=lambda s: s.pixel)
def test_the_diagonal_on_the_gpu_is_that_of_the_dense_hessian(settings, device):
    size = (7, 9)
    expected = truth(size, settings)
    held = CudaViewLoss(expected.target.to(device), settings, torch.float64).linearize(expected.image.to(device))
    some = torch.arange(0, expected.image.numel(), 47)  # of every channel, with the first and the last
    units = torch.eye(expected.image.numel(), dtype=torch.float64)[some].view(-1, 3, *size).to(device)
    products = held.hvp(units)[:, :3].reshape(len(some), -1).cpu()
    diagonal = held.diagonal.reshape(-1).cpu()[some]
    assert relative_error(diagonal, products[torch.arange(len(some)), some]) < 1e-12


@each_case
def test_consistency_on_the_gpu_has_the_specifications_value_and_gradients(size, settings, dtype, device):
    value, *gradients = truth_of_both(size, settings)
    x, y = (picture.to(device, dtype) for picture in image_and_target(size))
    found, pair = CudaImageLoss(x, settings).consistency(x, y)
    assert float(found) == pytest.approx(value.item(), rel=IMAGE[dtype], abs=IMAGE[dtype])
    for got, expected in zip(pair, gradients, strict=True):
        assert got.dtype == dtype and relative_error(got.cpu(), expected) < DERIVATIVE[dtype]
    again, swapped = CudaImageLoss(y, settings).consistency(y, x)
    assert torch.equal(again, found) and torch.equal(swapped[0], pair[1]) and torch.equal(swapped[1], pair[0])


def test_near_a_fit_of_a_smooth_picture_ssim_keeps_its_digits_on_the_gpu(device):
    y, x = torch.meshgrid(torch.linspace(0, 3, INSIDE[0]), torch.linspace(0, 2, INSIDE[1]), indexing="ij")
    target = torch.stack([0.7 + 0.2 * torch.sin(x + c) * torch.cos(y) for c in range(3)])
    image = target + 0.01 * random_like(target.shape, 0).float()
    v, found = random_like((1, *target.shape), 1).float(), []
    for dtype in DTYPES:
        held = CudaViewLoss(target.to(device), LossSettings(ssim_weight=1.0), dtype).linearize(image.to(device, dtype))
        found.append((held.total, held.gradient, held.hvp(v.to(device, dtype)), held.diagonal))
    bound = 2 * 11 * torch.finfo(torch.float32).eps  # two sums over a window's length, one after the other
    assert [relative_error(one.cpu(), other.cpu()) < bound for one, other in zip(*found, strict=True)] == [True] * 4


def test_autograd_reaches_the_kernels_on_the_gpu_twice(device, monkeypatch):
    emulate(monkeypatch)
    image, target = (picture.to(device) for picture in image_and_target((9, 6)))
    x, v = image.clone().requires_grad_(), random_like(image.shape, 3).to(device)
    found = view_loss(x, backend_of(x).view_loss(target, SETTINGS[1], x))
    expected = photometric_loss(x, target, SETTINGS[1])
    (gradient,), (truth,) = (torch.autograd.grad(each, x, create_graph=True) for each in (found, expected))
    products = [torch.autograd.grad((each * v).sum(), x)[0] for each in (gradient, truth)]
    once, (slope, _) = backend_of(target).image_loss(target, SETTINGS[1]).consistency(image, target)
    pairs = ((found, expected), (gradient, truth), products, (once, expected), (slope, truth))
    assert all(relative_error(one.detach().cpu(), other.detach().cpu()) < 1e-12 for one, other in pairs)
