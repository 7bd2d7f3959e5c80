"""Projection on the GPU (without one, by Triton's interpreter), against the specification and the CPU's tests' own truth."""

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="the kernels for GPUs need triton")

from splat.gpu.projection import CudaProjection, convert, project, project_adjoint
from splat.model.gaussians import Gaussians
from splat.model.settings import Antialias, RenderSettings
from splat.projection import cpu
from splat.projection.formulas import lens_of
from splat.projection.reference import project as specified
from splat.projection.whitening import COEFFICIENTS, MOMENTS, PLAIN_GRADIENT, PLAIN_TANGENT
from tests.splat.projection.test_projection import SPLAT_BLOCKS, N, camera_and_gaussians, settings_of, truth
from tests.splat.random_scenes import ANTIALIASED, MODES, random_camera, random_gaussians, random_like
from tests.splat.tolerances import DERIVATIVE, DTYPES, IMAGE, errors_by_block, relative_error

each_dtype = pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])


def on(device: torch.device, degree: int, dtype: torch.dtype, mode: Antialias = "none") -> tuple[Gaussians, tuple]:
    camera, gaussians = camera_and_gaussians(degree, mode)
    gaussians = gaussians.with_flat(gaussians.flat.to(device, dtype))
    lens = lens_of(camera, settings_of(mode))
    return gaussians, (lens, *project(gaussians, lens))


@pytest.mark.parametrize(
    ("degree", "dtype", "mode"),
    [
        *((3, torch.float64, mode) for mode in reversed(ANTIALIASED)),  # the first has all: bands, filters, factors
        *((degree, dtype, "none") for degree in range(4) for dtype in DTYPES),
        (3, torch.float32, "mip-splatting"),
    ],
)
def test_splats_and_their_adjoint_are_those_of_the_specification(degree, dtype, mode, device):
    gaussians, (lens, splats, depths, drawn) = on(device, degree, dtype, mode)
    expected, (camera, given) = truth(degree, mode), camera_and_gaussians(degree, mode)
    errors = errors_by_block(splats.T.cpu(), expected.splats.T, SPLAT_BLOCKS)
    assert max(errors.values()) < IMAGE[dtype]
    whole = specified(given, camera, settings_of(mode))
    assert torch.equal(drawn.cpu(), whole.drawn) and depths.dtype == dtype
    assert relative_error(depths.cpu()[whole.drawn], whole.depths[whole.drawn]) < IMAGE[dtype]
    gradient = project_adjoint(gaussians, lens, splats, drawn, expected.bar.to(device))
    assert max(errors_by_block(gradient.cpu(), expected.gradient, gaussians.blocks).values()) < DERIVATIVE[dtype]


def linearized(
    device: torch.device, degree: int, dtype: torch.dtype, mode: Antialias = "none"
) -> tuple[CudaProjection, Gaussians, Tensor]:
    """The projection at the truth's adjoint, its Gaussians, and the splats."""
    gaussians, (lens, splats, _, drawn) = on(device, degree, dtype, mode)
    moments = convert(MOMENTS, splats, truth(degree, mode).bar.detach().to(device)).to(dtype)
    return CudaProjection(gaussians, lens, splats, moments, drawn.nonzero()[:, 0]), gaussians, splats


def each_converted(way: int, splats: Tensor, numbers: Tensor) -> Tensor:
    """Tangents or adjoints (n, k, 9) in other coordinates."""
    return torch.stack([convert(way, splats, each.contiguous()) for each in numbers.unbind(1)], dim=1)


@pytest.mark.parametrize(
    ("degree", "dtype", "mode"),
    [
        *((1, torch.float64, mode) for mode in reversed(MODES)),
        (3, torch.float32, "none"),
        (3, torch.float64, "none"),
        (1, torch.float32, "mip-splatting"),
    ],
)
def test_products_and_blocks_are_those_of_the_specification(degree, dtype, mode, device):
    projection, gaussians, splats = linearized(device, degree, dtype, mode)
    expected = truth(degree, mode)
    U, C = expected.U.to(device, dtype), each_converted(MOMENTS, splats, expected.C.to(device)).to(dtype)
    pushed, pulled = projection.jvp(U), projection.vjp(C, U).cpu()
    plain = each_converted(PLAIN_TANGENT, splats, pushed).cpu()
    errors = errors_by_block(plain.permute(2, 0, 1), expected.pushed.permute(2, 0, 1), SPLAT_BLOCKS)
    assert max(errors.values()) < DERIVATIVE[dtype], errors
    assert max(errors_by_block(pulled, expected.pulled, gaussians.blocks).values()) < DERIVATIVE[dtype]
    there, back = (pushed * C).double(), (projection.vjp(C) * U).double()
    assert abs(float(there.sum() - back.sum())) < 30 * torch.finfo(dtype).eps * float(there.norm() + back.norm())
    blocks_agree_with_products(projection, gaussians, dtype, device)


@pytest.mark.parametrize("way", [COEFFICIENTS, PLAIN_TANGENT, MOMENTS, PLAIN_GRADIENT])
def test_coordinates_of_splats_are_those_of_the_cpu(way, device):
    _, (_, splats, _, _) = on(device, 0, torch.float64)
    numbers = random_like(splats.shape, 8)
    expected = np.empty(splats.shape)
    cpu.convert(0, len(splats), way, splats.cpu().numpy(), numbers.numpy(), expected)
    np.testing.assert_allclose(convert(way, splats, numbers.to(device)).cpu(), expected, rtol=1e-12)


def blocks_agree_with_products(
    projection: CudaProjection, gaussians: Gaussians, dtype: torch.dtype, device: torch.device
) -> None:
    """P'^T own P' + bar . P'' applied by its blocks, and by pushing forward, own, and pulling back."""
    index = projection.jacobian.index
    own = random_like((len(index), 9, 9), 5).to(device)
    own = own + own.mT
    own[:, 6:, 6:] = torch.diag_embed(own[:, 6:, 6:].diagonal(dim1=1, dim2=2))
    geometry, _ = projection.blocks(own, second_order=True)
    U = torch.zeros(gaussians.flat.numel(), 1, dtype=dtype, device=device)
    rows = torch.cat([torch.arange(len(gaussians.flat))[r].view(N, -1) for r in list(gaussians.blocks.values())[:4]], 1)
    U[rows.to(device)] = random_like((*rows.shape, 1), 6).to(device, dtype)
    moved = projection.jvp(U).double()
    cotangents = torch.zeros_like(moved)
    cotangents[index] = (own @ moved[index].mT).mT
    expected = projection.vjp(cotangents.to(dtype), U)[rows.to(device)]
    found = geometry @ U[rows.to(device)]
    assert relative_error(found.cpu(), expected.cpu()) < DERIVATIVE[dtype]


def test_the_diagonal_of_the_colours_blocks_is_that_of_products(device):
    projection, gaussians, _ = linearized(device, 1, torch.float64)
    index = projection.jacobian.index
    own = random_like((len(index), 9, 9), 5).to(device)
    _, sh = projection.blocks(own, second_order=False)
    everywhere = torch.zeros(N, 9, 9, dtype=torch.float64, device=device).index_copy(0, index, own)
    start = gaussians.blocks["sh"].start
    for b, c in ((0, 0), (2, 1), (3, 2)):
        rows = start + (torch.arange(N, device=device) * 4 + b) * 3 + c
        U = torch.zeros(gaussians.flat.numel(), 1, dtype=torch.float64, device=device)
        U[rows] = 1.0
        back = projection.vjp((everywhere @ projection.jvp(U).mT).mT)
        assert relative_error(sh[:, b, c].cpu(), back[rows, 0].cpu()) < 1e-12


def test_more_vectors_than_a_program_takes_are_pushed_and_pulled_alike(device):
    projection, gaussians, _ = linearized(device, 0, torch.float64)
    U, C = (random_like(shape, 7).to(device) for shape in ((gaussians.flat.numel(), 11), (N, 11, 9)))
    pushed, pulled = projection.jvp(U), projection.vjp(C, U)
    for k in (0, 7, 8, 10):
        assert torch.equal(pushed[:, k], projection.jvp(U[:, k : k + 1])[:, 0])
        assert torch.equal(pulled[:, k], projection.vjp(C[:, k : k + 1], U[:, k : k + 1])[:, 0])


def test_a_splat_too_large_for_its_derivatives_is_named_on_the_gpu(device):
    camera, gaussians = random_camera(focal=50.0), random_gaussians(5).to(torch.float32)
    gaussians.log_scales[3, 1] = 40.0
    gaussians.means[3] = torch.tensor([0.0, 0.0, 4.0])
    moved = Gaussians(gaussians.flat.to(device), 0)
    with pytest.raises(ValueError, match=r"expected log_scales of at most 3\d\.\d at depth .* at Gaussian 3 \(1 of 5"):
        project(moved, lens_of(camera, RenderSettings()))


def needles(n: int) -> Tensor:
    gaussians = random_gaussians(n, spread=0.3)
    length = torch.linspace(-4, 2.8, n, dtype=torch.float64)
    gaussians.log_scales[:] = torch.stack([length, torch.full_like(length, -7), torch.full_like(length, -6)], dim=1)
    return gaussians.flat.float()


def test_conics_of_needles_in_float32_are_those_of_float64(device):
    flat, lens = needles(200).to(device), lens_of(random_camera(504, 378, focal=400.0), RenderSettings())
    single, double = (project(Gaussians(flat.to(dtype), 0), lens)[0] for dtype in DTYPES)
    a, b, c = (double - single)[:, 2:5].abs().T / torch.stack(
        [double[:, 2], (double[:, 2] * double[:, 4]).sqrt(), double[:, 4]]
    )
    assert max(float(part.max()) for part in (a, b, c)) < 1e-6
