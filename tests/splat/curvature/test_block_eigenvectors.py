"""The steepest directions of single Gaussians: their curvatures are the scene's, and lead to its ends."""

from dataclasses import replace
from math import nan, pi

import pytest
import torch

from landscape import ScaledOperator
from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from splat.curvature.block_eigenvectors import BlockEigenvectors, blurred_share, eigendecomposed
from splat.curvature.gaussian_blocks import GEOMETRY_COLUMNS, PerGaussianBlocks
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.losses.reference import SIGMA, LossSettings
from splat.projection.reference import project
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import random_gaussians, random_like


@pytest.fixture(scope="module")
def objective() -> SceneObjective:
    return SceneObjective(random_gaussians(40, 1, logit=1.0), two_views(), LossSettings(ssim_weight=0.0), BACKGROUND)


def test_curvature_along_them_is_the_extreme_of_single_gaussians(objective):
    H = SceneHessian(objective)
    dense, n = H.apply(torch.eye(H.dim, dtype=H.dtype)), len(objective.active)
    # of one Gaussian: rows of its mean, log-scales, quaternion and logit
    widths = {"means": 3, "log_scales": 3, "quats": 4, "opacity_logits": 1}
    values = []
    for i in range(n):
        rows = torch.cat([torch.arange(k) + objective.blocks[name].start + i * k for name, k in widths.items()])
        values.append(torch.linalg.eigvalsh(dense[rows][:, rows]))
    values = torch.cat(values).sort().values
    V = BlockEigenvectors(objective, *objective.approximate_blocks).steepest(3, 2)
    assert torch.allclose(V.norm(dim=0), torch.ones(5, dtype=V.dtype))
    assert torch.allclose(H.project(V), V, atol=1e-12)
    found = (V * H.apply(V)).sum(dim=0)
    expected = torch.cat([values[-3:].flip(0), values[:2]])
    assert torch.allclose(found, expected, rtol=1e-8, atol=1e-10 * float(values.abs().max()))


@pytest.mark.parametrize("ssim_weight", [0.0, 0.2])
def test_blocks_hold_the_share_of_their_pixelwise_part_that_ssim_leaves(ssim_weight):
    far, near = two_views()
    near = replace(near, camera=replace(near.camera, centre=near.camera.centre + 4 * near.camera.rotation[2]))
    gaussians, loss = random_gaussians(12, 1, logit=1.0), LossSettings(ssim_weight=ssim_weight)
    objective = SceneObjective(gaussians, [far, near], loss, BACKGROUND)
    own, pixelwise = objective.approximate_blocks
    known, n = BlockEigenvectors(objective, own, pixelwise), len(objective.active)
    values, vectors = known.pairs(torch.arange(n))
    found = vectors.double() * values[:, None] @ vectors.double().mT
    single = (4 * pi * SIGMA**2) ** -1  # the square of a Gaussian, added up over the pixels
    splats = [project(objective.active, view.camera) for view in (far, near)]
    rho = (
        torch.stack([torch.where(each.drawn, blurred_share(each.conics), nan) for each in splats])
        .nanmean(dim=0)
        .detach()
    )
    assert splats[0].drawn.all() and 0 < splats[1].drawn.sum() < n  # some are behind the second camera
    left_out = 1 - (1 - rho) / (1 - single)
    for i in range(n):
        block = own.geometry[i].double().clone()
        if pixelwise is not None:
            block -= left_out[i] * pixelwise.geometry[i].double()
        P, turns = torch.eye(11, dtype=torch.float64), GEOMETRY_COLUMNS["quats"]
        P[turns, turns] -= torch.outer(objective.active.quats[i], objective.active.quats[i]).double()
        assert torch.allclose(found[i], P @ block @ P, rtol=1e-6, atol=1e-6 * float(block.abs().max()))


@pytest.mark.parametrize("conic", [(0.05, 0.0, 0.05), (0.9, 0.3, 0.4), (3.0, 0.2, 0.02)])
def test_the_blurred_share_of_a_moved_splat_is_that_of_its_image_on_a_grid(conic):
    """On a grid so fine and wide that sums over it are integrals, blurred by Fourier transform."""
    n, spacing = 512, 0.25
    at = (torch.arange(n, dtype=torch.float64) - n // 2) * spacing
    a, b, c = conic
    x, y = at[None, :], at[:, None]
    across = torch.linalg.eigh(torch.tensor([[a, b], [b, c]], dtype=torch.float64)).eigenvectors[:, -1]
    slope = (across[0] * x + across[1] * y) * torch.exp(-(a * x**2 + 2 * b * x * y + c * y**2) / 2)
    squared = (2 * pi * torch.fft.fftfreq(n, spacing, dtype=torch.float64)) ** 2
    blurred = torch.fft.fft2(slope) * torch.exp(-(SIGMA**2) * (squared[None, :] + squared[:, None]) / 2)
    expected = float(blurred.abs().square().sum() / torch.fft.fft2(slope).abs().square().sum())
    assert float(blurred_share(torch.tensor([conic], dtype=torch.float64))) == pytest.approx(expected, rel=1e-6)


def test_near_a_fit_values_are_five_times_closer_than_pixel_by_pixel():
    made = synthetic_scene(SyntheticSettings(60, 2, 24, 18, sh_degree=0))
    near = made.truth.with_flat(made.truth.flat + 0.02 * random_like(made.truth.flat.shape, 0).to(made.truth.flat))
    objective = SceneObjective(near, made.scene.load())
    H, (own, pixelwise) = SceneHessian(objective), objective.approximate_blocks
    errors = []
    for known in (BlockEigenvectors(objective, own, pixelwise), BlockEigenvectors(objective, own)):
        V, values = known.steepest(6, 6), known.pairs(torch.arange(60))[0].flatten().sort().values
        true = (V * H.apply(V)).sum(dim=0)
        found = torch.cat([values[-6:].flip(0), values[:6]])
        errors.append(float((found - true).abs().mean() / true.abs().max()))
    assert errors[0] < errors[1] / 5


@pytest.mark.parametrize("attribute", [None, "means", "log_scales", "quats", "opacity_logits"])
def test_scaled_or_of_one_attribute_they_are_those_of_the_dense_blocks(attribute):
    loss = LossSettings("l2", ssim_weight=0.0)  # which does not couple pixels
    objective = SceneObjective(random_gaussians(20, 1, logit=1.0), two_views(), loss, BACKGROUND)
    scale = random_like(tuple(objective.active.flat.shape), 3).to(objective.active.flat).exp()
    H, n = ScaledOperator(SceneHessian(objective), scale), len(objective.active)
    owner = objective.active.with_flat(torch.arange(H.dim, dtype=H.dtype) + n)  # of colours, every row
    for name in GEOMETRY_COLUMNS:
        getattr(owner, name).view(n, -1).copy_(torch.arange(n)[:, None])
    own = torch.where(owner.flat[:, None] == owner.flat, H.apply(torch.eye(H.dim, dtype=H.dtype)), 0.0)
    rows = slice(0, H.dim) if attribute is None else objective.blocks[attribute]
    own, size = own[rows, rows], float(own[rows, rows].abs().max())
    known = BlockEigenvectors(objective, *objective.approximate_blocks, attribute, scale)
    of_geometry = owner.flat[rows] < n
    expected = torch.linalg.eigvalsh(own[of_geometry][:, of_geometry])
    assert torch.allclose(known.pairs(torch.arange(n))[0].flatten().sort().values, expected, atol=1e-10 * size)
    start = known.steepest(2, 1)
    assert torch.allclose(start.norm(dim=0), torch.ones(3, dtype=start.dtype))
    assert torch.allclose(own @ start, start * (start * (own @ start)).sum(dim=0), atol=1e-9 * size)


@pytest.mark.parametrize("ssim_weight", [0.0, 0.2])
def test_a_search_from_the_warm_start_finds_the_same_ends(ssim_weight):
    """On so few Gaussians, all over each other, it needs as many products as from a random vector."""
    loss = LossSettings(ssim_weight=ssim_weight)
    objective = SceneObjective(random_gaussians(40, 1, logit=1.0), two_views(), loss, BACKGROUND)
    H, settings = SceneHessian(objective), EigenSettings(2, 1, rtol=1e-3)
    start = BlockEigenvectors(objective, *objective.approximate_blocks).warm_start()
    led = extreme_eigenpairs(H, torch.Generator().manual_seed(0), settings, start)
    truth = torch.linalg.eigvalsh(H.apply(torch.eye(H.dim, dtype=H.dtype)).double())
    for pairs, true in ((led.largest, truth[-2:].flip(0)), (led.smallest, truth[:1])):
        assert pairs.reason == "tolerance" and torch.allclose(pairs.values, true, rtol=2e-3)


def test_no_more_blocks_are_eigendecomposed_at_once_than_a_gpu_takes(monkeypatch):
    sizes, eigh, n = [], torch.linalg.eigh, 40_000
    monkeypatch.setattr(torch.linalg, "eigh", lambda blocks: sizes.append(len(blocks)) or eigh(blocks))
    blocks = torch.diag_embed(torch.arange(2.0 * n, dtype=torch.float64).view(n, 2))
    values, _ = eigendecomposed(blocks, blocks.new_zeros(n, 2), blocks.new_ones(n, 2))
    assert torch.equal(values, blocks.diagonal(dim1=1, dim2=2))
    assert sum(sizes) == n and max(sizes) <= 8192


def test_positive_definite_blocks_give_no_direction_along_a_quaternion(objective):
    n, k = len(objective.active), objective.active.sh.shape[1]
    flat = objective.active.flat
    eye = torch.eye(11, dtype=flat.dtype).repeat(n, 1, 1)
    known = BlockEigenvectors(objective, PerGaussianBlocks(eye, flat.new_ones(n, k, 3)))
    V = known.steepest(2, 3)
    assert torch.allclose(V.norm(dim=0), torch.ones(5, dtype=V.dtype))
    assert torch.allclose(SceneHessian(objective).project(V), V, atol=1e-12)


@pytest.mark.parametrize(("low", "others"), [(-3.0, -1.0), (-1.2, -1.0), (0.1, 1.0)])
def test_few_blocks_are_eigendecomposed_and_every_end_is_among_them(monkeypatch, low, others):
    """Ten blocks are larger than the one that has the least eigenvalue; where none is beneath zero no block may be left out."""
    gaussians = random_gaussians(90, 0, logit=1.0)
    objective = SceneObjective(gaussians, two_views(), LossSettings("l2", ssim_weight=0.0), BACKGROUND)
    n = len(objective.active)
    values = objective.active.flat.new_full((n, 11), 0.2)
    values[10:20], values[10:20, 6], values[15, 2], values[40, 1] = 2.0, others, 2.5, low
    turns = torch.linalg.qr(random_like((n, 11, 11), 5).to(values)).Q
    taken, plain = [], BlockEigenvectors.pairs

    def counted(self, gaussians):
        taken.append(len(gaussians))
        return plain(self, gaussians)

    monkeypatch.setattr(BlockEigenvectors, "pairs", counted)
    known = BlockEigenvectors(
        objective, PerGaussianBlocks(turns @ torch.diag_embed(values) @ turns.mT, values.new_zeros(n, 1, 3))
    )
    found = {}
    for few in (8, n):
        monkeypatch.setattr("splat.curvature.block_eigenvectors.FEW", few)
        found[few] = known.steepest(1, 1)
    assert torch.allclose((found[8] * found[n]).sum(dim=0).abs(), torch.ones(2, dtype=values.dtype))
    assert taken == [8, 11 if others < 0 else n, n]
