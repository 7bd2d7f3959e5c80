"""Losses: the specification against windows and kornia, the kernels against the specification."""

from dataclasses import dataclass
from functools import cache

import kornia.metrics
import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d
from torch import Tensor

from splat.losses.autograd import view_loss
from splat.losses.cpu.loss import CpuViewLoss
from splat.losses.reference import WINDOW, LossSettings, PixelLoss, psnr, ssim, ssim_map, window
from splat.render.backend import backend_of
from tests.oracles import similarity_by_windows
from tests.refusals import refused
from tests.splat.photometric import photometric_loss
from tests.splat.random_scenes import random_like
from tests.splat.tolerances import DERIVATIVE, DTYPES, IMAGE, relative_error

SIZES = [(53, 75), (7, 9), (1, 40), (40, 1)]
SETTINGS = [
    LossSettings(),
    LossSettings("charbonnier"),
    LossSettings("l2", literal=True),
    LossSettings("l2", ssim_weight=0),
    LossSettings("charbonnier", ssim_weight=0, eps=0.1),
    LossSettings("l1", ssim_weight=1.0),
    LossSettings("charbonnier", ssim_weight=0.4, border="valid"),
]
each_dtype = pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])
each_size = pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
each_loss = pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: f"{s.pixel} {s.ssim_weight} {s.literal}")
CASES = [(size, settings) for size in SIZES for settings in SETTINGS if min(size) > 2 * settings.margin]
each_case = pytest.mark.parametrize(
    ("size", "settings"), CASES, ids=[f"{h}x{w} {s.pixel} {s.ssim_weight} {s.literal}" for (h, w), s in CASES]
)


def image_and_target(size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Rounded to float32; a part of the image equals its target, so that residuals of 0 occur."""
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(3, *size, generator=generator)
    image = (target + 0.1 * random_like((3, *size), 1).float()).clamp(0, 1)
    image[:, : size[0] // 4] = target[:, : size[0] // 4]
    return image.double(), target.double()


@dataclass(frozen=True)
class Truth:
    image: Tensor
    target: Tensor
    v: Tensor
    value: Tensor
    gradient: Tensor
    product: Tensor


@cache
def truth(size: tuple[int, int], settings: LossSettings) -> Truth:
    image, target = image_and_target(size)
    v = random_like((2, *image.shape), 2).float().double()
    x = image.clone().requires_grad_()
    value = photometric_loss(x, target, settings)
    (gradient,) = torch.autograd.grad(value, x, create_graph=True)
    products = [
        torch.autograd.grad((gradient * each).sum(), x, retain_graph=True)[0] if gradient.requires_grad else 0 * each
        for each in v
    ]
    return Truth(image, target, v, value.detach(), gradient.detach(), torch.stack(products))


def test_similarity_is_that_of_the_windows_written_out():
    for size in SIZES:
        image, target = image_and_target(size)
        assert relative_error(ssim_map(image, target), similarity_by_windows(image.numpy(), target.numpy())) < 1e-12


def test_similarity_is_kornias_away_from_the_border():
    image, target = image_and_target((40, 31))
    peer = kornia.metrics.ssim(image[None], target[None], 11, eps=0.0, padding="valid")[0]
    assert relative_error(ssim_map(image, target)[:, 5:-5, 5:-5], peer) < 1e-12
    valid = photometric_loss(image, target, LossSettings(ssim_weight=1.0, border="valid"))
    assert float(valid) == pytest.approx(float(1 - peer.mean()), rel=1e-12)


def test_a_picture_smaller_than_a_window_has_no_valid_one():
    refused("at least 11 px a side", CpuViewLoss, torch.zeros(3, 10, 40), LossSettings(border="valid"), torch.float32)
    assert CpuViewLoss(torch.zeros(3, 11, 11), LossSettings(border="valid"), torch.float32).structural == 0.2 / 3


def test_psnr_is_kornias():
    image, target = image_and_target((40, 31))
    assert psnr(image, target) == pytest.approx(float(kornia.metrics.psnr(image, target, 1.0)), rel=1e-12)


def test_metrics_clip_what_a_picture_file_could_not_hold():
    image, target = image_and_target((20, 20))
    bright = image.clone()
    bright[0, 3, 3] = 7.0
    clipped = bright.clamp(0, 1)
    assert psnr(bright, target) == psnr(clipped, target) and ssim(bright, target) == ssim(clipped, target)


def test_the_photometric_loss_weighs_its_parts_as_written():
    image, target = image_and_target((20, 30))
    r = (image - target).numpy()
    structural = 1 - similarity_by_windows(image.numpy(), target.numpy()).mean()
    pixel: dict[PixelLoss, float] = {"l1": np.abs(r).mean(), "l2": (r**2).mean()}
    pixel["charbonnier"] = np.sqrt(r**2 + 0.03**2).mean()
    for kind, value in pixel.items():
        for literal, share in ((False, 0.7), (True, 1.0)):
            found = photometric_loss(image, target, LossSettings(kind, ssim_weight=0.3, eps=0.03, literal=literal))
            assert float(found) == pytest.approx(share * value + 0.3 * structural, rel=1e-12)


@each_dtype
@each_case
def test_kernels_give_the_specifications_value_gradient_and_products(size, settings, dtype):
    expected = truth(size, settings)
    loss = CpuViewLoss(expected.target.to(dtype), settings, dtype)
    held = loss.linearize(loss.padded(expected.image.to(dtype)))
    assert held.value == pytest.approx(float(expected.value), rel=IMAGE[dtype], abs=IMAGE[dtype])
    assert loss.value(loss.padded(expected.image.to(dtype))) == held.value
    assert relative_error(loss.cropped(held.gradient), expected.gradient) < DERIVATIVE[dtype]
    tangents = torch.stack([loss.padded(v.to(dtype)) for v in expected.v])
    products = held.hvp(tangents)
    for product, each in zip(products, expected.product, strict=True):
        assert relative_error(loss.cropped(product), each) < DERIVATIVE[dtype]


@each_dtype
@each_case
def test_quadratic_forms_are_those_of_products_and_of_the_diagonal(size, settings, dtype):
    expected = truth(size, settings)
    exact, loss = (CpuViewLoss(expected.target.to(each), settings, each) for each in (torch.float64, dtype))
    diagonal = exact.cropped(exact.linearize(exact.padded(expected.image)).diagonal)
    held = loss.linearize(loss.padded(expected.image.to(dtype)))
    full, pixelwise = held.curvatures(torch.stack([loss.padded(v.to(dtype)) for v in expected.v]))
    for found, products in ((full, expected.product), (pixelwise, diagonal * expected.v)):
        terms = (expected.v * products).flatten(1)
        assert ((found - terms.sum(dim=1)).abs() <= DERIVATIVE[dtype] * terms.abs().sum(dim=1)).all()


@each_dtype
@each_size
@pytest.mark.parametrize("contrast", [1.0, 0.001])
def test_the_windows_mean_and_variance_of_a_target_are_scipys(size, contrast, dtype):
    """In every pixel; at a low contrast the difference of the squares would lose the variance, eps (mean / std)^2 of it."""
    target = (0.7 + contrast * (image_and_target(size)[1] - 0.5)).float()
    taps = window(torch.float64).numpy()

    def blur(field: np.ndarray) -> np.ndarray:
        return correlate1d(correlate1d(field, taps, axis=1, mode="constant"), taps, axis=2, mode="constant")

    picture = target.double().numpy()
    mean, square = blur(picture), blur(picture**2)
    moments = CpuViewLoss(target, LossSettings(), dtype)._target_moments[:, :, : size[0], : size[1]]
    assert relative_error(moments[0], mean) < IMAGE[dtype]
    variance = square - mean**2
    ratio = np.sqrt(square / variance)
    rounding = torch.finfo(dtype).eps * (1 + ratio) + torch.finfo(torch.float64).eps * ratio**2  # the kernel's, scipy's
    assert (np.abs(moments[1] / variance - 1) < 2 * WINDOW * rounding).all()  # two sums over a window's length


def test_near_a_fit_of_a_smooth_picture_ssim_keeps_its_digits_in_float32():
    """Variances far beneath the squared means: the usual formula loses two digits more (2e-5 instead of 3e-7)."""
    y, x = torch.meshgrid(torch.linspace(0, 3, 60), torch.linspace(0, 2, 80), indexing="ij")
    target = torch.stack([0.7 + 0.2 * torch.sin(x + c) * torch.cos(y) for c in range(3)])
    generator = torch.Generator().manual_seed(0)
    image = target + 0.01 * torch.randn(target.shape, generator=generator)
    v = torch.randn(3, 60, 80, generator=generator)
    found = []
    for dtype in DTYPES:
        loss = CpuViewLoss(target, LossSettings(ssim_weight=1.0), dtype)
        held = loss.linearize(loss.padded(image.to(dtype)))
        product = held.hvp(torch.cat([loss.padded(v.to(dtype)), loss.padded(v.to(dtype))[:1]])[None])[0]
        found.append((torch.tensor(held.value), *map(loss.cropped, (held.gradient, product, held.diagonal))))
    bound = 2 * WINDOW * torch.finfo(torch.float32).eps  # two sums over a window's length, one after the other
    assert [relative_error(single, double) < bound for single, double in zip(*found, strict=True)] == [True] * 4


@each_size
@pytest.mark.parametrize("border", ["padded", "valid"])
def test_products_of_nearly_uniform_tangents_keep_their_digits_in_float32(size, border):
    """As of a splat that fills the picture: beside its mean such a tangent has nothing that SSIM's structure would see."""
    image, target = (each.float() for each in image_and_target(size if min(size) >= WINDOW else (WINDOW, 60)))
    generator = torch.Generator().manual_seed(0)
    image, target = 0.6 + 0.001 * image, 0.5 + 0.02 * target  # of low contrast
    v = 1 + 1e-4 * torch.randn(image.shape, generator=generator)
    found = []
    for dtype in DTYPES:
        loss = CpuViewLoss(target, LossSettings(ssim_weight=1.0, border=border), dtype)
        held = loss.linearize(loss.padded(image.to(dtype)))
        found.append(loss.cropped(held.hvp(loss.padded(v.to(dtype))[None])[0]))
    assert relative_error(*found) < 2 * WINDOW * torch.finfo(torch.float32).eps


@each_dtype
@each_loss
def test_padding_and_alpha_have_no_derivative(settings, dtype):
    size = (13, 17)
    expected = truth(size, settings)
    loss = CpuViewLoss(expected.target.to(dtype), settings, dtype)
    held = loss.linearize(loss.padded(expected.image.to(dtype)))
    for planes in (held.gradient, held.hvp(loss.padded(expected.v[0].to(dtype))[None])[0]):
        assert planes.shape[0] == 4 and not planes[3].any()
        assert not planes[:, size[0] :].any() and not planes[:, :, size[1] :].any()


@each_loss
def test_threads_change_no_bit_and_products_may_overwrite_their_vectors(settings, monkeypatch):
    monkeypatch.setattr("splat.losses.cpu.loss.RINGS", 1 << 16)  # so that two vectors are two sweeps
    expected = truth((37, 53), settings)

    def everything() -> list[Tensor]:
        loss = CpuViewLoss(expected.target, settings, torch.float64)
        held = loss.linearize(loss.padded(expected.image))
        tangents = torch.stack([loss.padded(v) for v in expected.v])
        over = torch.cat([tangents, tangents[:, :1]], dim=1)  # four planes, as the products have
        held.hvp(over, out=over)
        both = consistency(expected.image, expected.target, settings)
        products = held.hvp(tangents), over, held.diagonal, *held.curvatures(tangents)
        return [torch.tensor(held.value), held.gradient, *products, *both]

    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            results.append(everything())
    finally:
        torch.set_num_threads(before)
    assert (results[0][2] == results[0][3]).all()
    assert results[0][2].any() == (settings.pixel != "l1" or settings.ssim_weight > 0)
    for others in results[1:]:
        assert all((one == other).all() for one, other in zip(results[0], others, strict=True))


@each_loss
@pytest.mark.parametrize("size", [(17, 21), (1, 40)], ids=["17x21", "1x40"])
def test_the_diagonal_is_that_of_the_dense_hessian(size, settings):
    expected = truth(size if min(size) > 2 * settings.margin else (40, 11), settings)
    loss, size = CpuViewLoss(expected.target, settings, torch.float64), expected.image.shape[1:]
    held = loss.linearize(loss.padded(expected.image))
    count = expected.image.numel()
    every = [loss.padded(row.view(3, *size)) for row in torch.eye(count, dtype=torch.float64)]
    columns = [loss.cropped(product).reshape(-1) for product in held.hvp(torch.stack(every))]
    dense = torch.stack(columns, dim=1)
    assert relative_error(dense, dense.T) < 1e-12
    assert relative_error(loss.cropped(held.diagonal).reshape(-1), dense.diagonal()) < 1e-12


@each_loss
def test_autograd_reaches_the_kernels_twice(settings):
    image, target = image_and_target((12, 11) if settings.margin else (9, 6))
    image = (target + 0.1 + 0.2 * (image - target).abs()).requires_grad_()  # no kink within the step
    loss = CpuViewLoss(target, settings, torch.float64)
    assert torch.autograd.gradcheck(lambda x: 100 * view_loss(x, loss), (image,))
    assert torch.autograd.gradgradcheck(lambda x: 100 * view_loss(x, loss), (image,))


def test_a_third_derivative_by_the_kernels_is_refused():
    image, target = image_and_target((9, 6))
    x, loss = image.clone().requires_grad_(), CpuViewLoss(target, LossSettings(), torch.float64)
    value = view_loss(x, loss)
    for _ in range(2):
        (gradient,) = torch.autograd.grad(value, x, create_graph=True)
        value = (gradient**2).sum()
    with pytest.raises(NotImplementedError, match="expected at most two derivatives of the kernels, got a third"):
        torch.autograd.grad(value, x)


def consistency(x: Tensor, y: Tensor, settings: LossSettings) -> tuple[Tensor, Tensor, Tensor]:
    """The loss of two images by the kernels, and its gradients in both."""
    loss = backend_of(x).image_loss(x, settings)
    value, (in_x, in_y) = loss.consistency(loss.padded(x), loss.padded(y))
    return value, loss.cropped(in_x), loss.cropped(in_y)


@cache
def truth_of_both(size: tuple[int, int], settings: LossSettings) -> tuple[Tensor, Tensor, Tensor]:
    """The specification's value and its gradients in both images."""
    x, y = (picture.requires_grad_() for picture in image_and_target(size))
    value = photometric_loss(x, y, settings)
    in_x, in_y = torch.autograd.grad(value, (x, y))
    return value.detach(), in_x, in_y


@each_dtype
@each_case
def test_consistency_has_the_specifications_value_and_gradients(size, settings, dtype):
    value, *gradients = truth_of_both(size, settings)
    x, y = (picture.to(dtype) for picture in image_and_target(size))
    found, *both = consistency(x, y, settings)
    assert found.item() == pytest.approx(value.item(), rel=IMAGE[dtype], abs=IMAGE[dtype])
    for got, expected in zip(both, gradients, strict=True):
        assert got.dtype == dtype and relative_error(got, expected) < DERIVATIVE[dtype]


@each_dtype
@each_loss
def test_consistency_is_symmetric_to_the_bit(settings, dtype):
    x, y = (picture.to(dtype) for picture in image_and_target((37, 53)))
    (one, in_x, in_y), (other, of_x, of_y) = consistency(x, y, settings), consistency(y, x, settings)
    assert one == other and torch.equal(in_x, of_y) and torch.equal(in_y, of_x) and in_x.any() and in_y.any()


@each_loss
def test_consistency_reads_no_padding_and_leaves_0_in_its_own(settings):
    x, y = image_and_target((37, 53))
    loss = backend_of(x).image_loss(x, settings)
    planes = [loss.padded(x), loss.padded(y)]
    expected = loss.consistency(*planes)
    for plane in planes:
        plane[:, 37:], plane[..., 53:] = 0.7, 0.3
    value, gradients = loss.consistency(*planes)
    assert value == expected[0] and torch.equal(gradients, expected[1])
    assert not gradients[:, :, 37:].any() and not gradients[..., 53:].any() and gradients.shape[-2:] != (37, 53)


def test_l1_has_no_slope_at_its_kink():
    image, target = image_and_target((8, 8))
    loss = CpuViewLoss(target, LossSettings("l1", ssim_weight=0), torch.float64)
    gradient = loss.cropped(loss.linearize(loss.padded(image)).gradient)
    assert ((gradient == 0) == (image == target)).all() and (image == target).any()
    assert torch.equal(gradient, torch.sign(image - target) / image.numel())


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"pixel": "l3"}, "'pixel': expected 'l1' or 'charbonnier' or 'l2', got 'l3'"),
        ({"ssim_weight": 1.5}, "'ssim_weight': expected float <= 1"),
        ({"eps": 0.0}, "'eps': expected float > 0"),
    ],
)
def test_wrong_settings_are_refused(wrong, message):
    refused(message, LossSettings, **wrong)
