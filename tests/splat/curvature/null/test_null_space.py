"""What is projected out of the operators is exactly flat, and nothing else is projected out."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from landscape.operators.operator import DenseOperator
from landscape.spectrum.absolute_sum import absolute_sum
from landscape.spectrum.density import ActiveSpace, spectral_density
from splat.curvature.hessian import SceneHessian
from splat.curvature.null.active_spaces import projector_of, seen_parameters
from splat.curvature.null.colour_space import ColourSpace, seen_colours
from splat.curvature.null.row_space import CHUNK, TOLERANCE, RowSpace, row_space
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.model.camera import Camera
from splat.model.settings import Antialias
from splat.scenes.view import View
from tests.splat.held_scenes import BACKGROUND, gradient_and_products, two_views
from tests.splat.random_scenes import ANTIALIASED, MODES, filtered, random_camera, random_gaussians

LOSSES = [LossSettings(), LossSettings("l2"), LossSettings("charbonnier")]
NULL = torch.finfo(torch.float64).eps  # of H's largest eigenvalue: rounding leaves less of a zero


def objective_of(views: int, sh_degree: int, n: int = 7, mode: Antialias = "none") -> SceneObjective:
    gaussians, generator = filtered(random_gaussians(n, sh_degree, seed=2), mode), torch.Generator().manual_seed(4)
    cameras = [random_camera(32, 28, seed=seed, focal=34.0) for seed in range(views)]
    pictures = [torch.rand(3, 28, 32, generator=generator) for _ in cameras]
    seen = [View(str(i), camera, picture) for i, (camera, picture) in enumerate(zip(cameras, pictures, strict=True))]
    return SceneObjective(gaussians, seen, LossSettings("l2"), settings=MODES[mode])


def scattered(seed: int, views: int, sh_degree: int, n: int, loss: LossSettings, lightness: float) -> SceneObjective:
    """Gaussians that cameras on all sides see, or some of them, in colours that views clamp."""
    gaussians, draw = random_gaussians(n, sh_degree, seed=seed, logit=1.0), np.random.default_rng(seed)
    gaussians.sh.mul_(2)[:, 0] += lightness
    seen, generator, ahead = [], torch.Generator().manual_seed(seed), np.array([0.0, 0.0, 4.0])
    for i in range(views):
        turn = Rotation.from_rotvec(draw.normal(size=3) * 0.5).as_matrix()
        centre = ahead - turn.T @ ahead + draw.normal(size=3) * 0.2
        camera = Camera(torch.tensor(turn), torch.tensor(centre), 24.0, 21.6, 13.8, 10.1, 26, 22)
        seen.append(View(str(i), camera, torch.rand(3, 22, 26, generator=generator)))
    return SceneObjective(gaussians, seen, loss)


def random_scene(seed: int) -> SceneObjective:
    draw = np.random.default_rng([seed])
    views, sh_degree, n = (int(draw.integers(low, high)) for low, high in ((1, 9), (0, 4), (5, 15)))
    return scattered(seed, views, sh_degree, n, LOSSES[seed % 3], draw.uniform(-0.5, 1.0))


def dense(operator: SceneHessian) -> Tensor:
    return operator.apply(torch.eye(operator.dim, dtype=torch.float64))


def without_lengths(H: Tensor, objective: SceneObjective) -> Tensor:
    """H at right angles to the quaternions' lengths."""
    Q, quats = torch.zeros(len(H), len(objective.active), dtype=torch.float64), objective.active.quats
    Q[objective.blocks["quats"]] = torch.block_diag(*quats[:, :, None])
    P = torch.eye(len(H), dtype=torch.float64) - Q @ Q.T
    return P @ ((H + H.T) / 2) @ P


def spectrum(H: Tensor, rows: slice = slice(None)) -> Tensor:
    """The eigenvalues of H, or of its block of these rows, that are not 0, ascending."""
    values, size = torch.linalg.eigvalsh(H[rows, rows]), torch.linalg.matrix_norm(H, 2)
    return values[values.abs() > NULL * size]


each_case = pytest.mark.parametrize(
    ("views", "sh_degree", "mode"),
    [(1, 3, "none"), (2, 3, "none"), (3, 1, "none"), (5, 3, "none"), *((3, 1, mode) for mode in ANTIALIASED)],
)


@each_case
def test_gauss_newton_loses_nothing_by_the_projection(views: int, sh_degree: int, mode: Antialias) -> None:
    objective = objective_of(views, sh_degree, mode=mode)
    plain = dense(SceneHessian(objective, gauss_newton=True, keep_null=True))
    projected = dense(SceneHessian(objective, gauss_newton=True))
    assert float((plain - projected).norm() / plain.norm()) < 1e-10


@each_case
def test_the_rank_is_that_of_the_stacked_jacobians_and_within_bounds(views: int, sh_degree: int, mode: Antialias):
    objective = objective_of(views, sh_degree, mode=mode)
    operator, n, k = SceneHessian(objective, gauss_newton=True), len(objective.active), (sh_degree + 1) ** 2
    total = 0
    for i in range(n):
        own = torch.cat([torch.arange(rows.start, rows.stop).view(n, -1)[i] for rows in objective.blocks.values()])
        unit = torch.zeros(operator.dim, len(own), dtype=torch.float64)
        unit[own, torch.arange(len(own))] = 1
        stacked = torch.cat([view._projection.jvp(unit)[i].T for view in objective.linearized])
        total += int(
            torch.linalg.matrix_rank(stacked / stacked.norm(dim=1, keepdim=True).clamp_min(1e-300), rtol=1e-11)
        )
    assert operator.rank == total
    assert operator.rank <= n * min(9 * views, 10 + 3 * min(views, k))


def test_the_hessian_is_zero_along_the_harmonics_that_no_view_sees() -> None:
    objective = objective_of(2, 3)
    operator, H = SceneHessian(objective), dense(SceneHessian(objective, keep_null=True))
    V = torch.randn(operator.dim, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    unseen, rows = torch.zeros_like(V), objective.blocks["sh"]
    unseen[rows] = (V - operator.project(V))[rows]
    assert float(unseen.norm()) > 0.1 * float(V[rows].norm())
    assert float((H @ unseen).norm()) < 1e-10 * float(H.norm() * unseen.norm())
    lit = torch.zeros(len(objective.active), 2, 3)
    for m, view in enumerate(objective.linearized):
        lit[torch.as_tensor(view.jacobian.index), m] = torch.as_tensor(view.jacobian.visible).float()
    # a view sees the harmonics in one direction, and slopes along the two directions across it; both views together three
    slopes = (2 * lit.any(dim=2).sum(dim=1)).clamp_max(3)
    assert operator.rank == 10 * len(objective.active) + int(lit.sum() + slopes.sum())


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
@pytest.mark.parametrize("views", [1, 2, 3, 5, 8])
def test_ranks_are_those_of_dense_hessians(views: int, sh_degree: int) -> None:
    objective = scattered(views, views, sh_degree, 7, LOSSES[views % 3], lightness=0.2)
    operator, single = SceneHessian(objective), projector_of(objective, single=True)
    H = without_lengths(dense(SceneHessian(objective, keep_null=True)), objective)
    colours = objective.blocks["sh"]
    assert operator.rank == len(spectrum(H))
    assert single.rank == 10 * len(objective.active) + len(spectrum(H, colours))
    assert float((dense(operator) - H).norm()) < 1e-13 * float(H.norm())
    projected = single.apply(single.apply(H).T)
    assert float((projected - H)[colours, colours].norm()) < 1e-13 * float(H[colours, colours].norm())


def test_dense_scenes_have_unseen_gaussians_and_clamped_channels() -> None:
    objective = scattered(8, 8, 2, 7, LOSSES[0], lightness=0.2)
    views = list(objective.linearized)
    assert len({len(view.jacobian.index) for view in views}) > 1
    assert sum(int((torch.as_tensor(view.jacobian.visible) == 0).sum()) for view in views) > 0


def test_the_rank_is_that_of_the_specifications_hessian() -> None:
    gaussians = random_gaussians(4, 2, seed=5, logit=1.0)
    gaussians.quats.div_(gaussians.quats.norm(dim=1, keepdim=True))
    views = two_views(20, 16)
    objective = SceneObjective(gaussians, views, LossSettings("l2"), BACKGROUND)
    assert len(objective.active) == 4
    eye = torch.eye(gaussians.flat.numel(), dtype=torch.float64)
    _, H = gradient_and_products(gaussians, views, LossSettings("l2"), eye)
    assert SceneHessian(objective).rank == len(spectrum(without_lengths(H, objective))) < 0.6 * len(H)


def test_a_view_does_not_see_gaussians_in_its_tiles_but_in_no_pixel() -> None:
    gaussians, camera = random_gaussians(5, 1, seed=1, logit=1.0, spread=0.3), random_camera(26, 22, focal=24.0)
    column, row = 13.0, 11.0  # the corner of a pixel, not between tiles, whether they are 4 or 8 pixels wide
    corner = torch.tensor([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, 1.0], dtype=torch.float64)
    gaussians.means[0], gaussians.log_scales[0] = camera.centre + camera.rotation.T @ (2 * corner), -4.0
    gaussians.opacity_logits[0] = -5.0  # an alpha above 1 / 255 in the middle, but not half a pixel off
    pictures = torch.rand(2, 3, 22, 26, generator=torch.Generator().manual_seed(0))
    cameras = [camera, replace(camera, cx=camera.cx + 0.5, cy=camera.cy + 0.5)]
    views = [View(str(i), *pair) for i, pair in enumerate(zip(cameras, pictures, strict=True))]
    objective = SceneObjective(gaussians, views, LossSettings("l2"))
    first, second = objective.linearized
    assert len(objective.active) == first.touched == 5
    assert 0 not in first.jacobian.index and 0 in second.jacobian.index
    H = dense(SceneHessian(objective, keep_null=True))
    assert projector_of(objective, single=True).rank == 10 * 5 + len(spectrum(H, objective.blocks["sh"]))


def test_the_rank_is_the_same_in_single_precision() -> None:
    for seed in range(6):
        objective = random_scene(seed)
        views = [replace(view, image=view.image.float()) for view in objective.views]
        single = SceneObjective(objective.active.to(torch.float32), views, LOSSES[seed % 3])
        for gauss_newton in (False, True):
            ranks = [SceneHessian(scene, gauss_newton=gauss_newton).rank for scene in (objective, single)]
            assert ranks[0] == ranks[1]


def test_rank_and_sum_of_magnitudes_of_random_scenes_are_dense_ones() -> None:
    missed = 0
    for seed in range(8):
        objective = random_scene(seed)
        operator = SceneHessian(objective)
        true = spectrum(without_lengths(dense(SceneHessian(objective, keep_null=True)), objective))
        assert operator.rank == len(true)
        active = ActiveSpace(operator.project, operator.rank)
        density = spectral_density(DenseOperator(dense(operator)), torch.Generator().manual_seed(seed), active=active)
        total = absolute_sum(density)
        missed += not total.low <= float(true.abs().sum()) <= total.high
    assert missed <= 1  # of 8 brackets of 95% two or more miss with a probability of 6%


@pytest.mark.parametrize("gauss_newton", [False, True])
def test_the_projector_is_orthogonal(gauss_newton: bool) -> None:
    operator = SceneHessian(objective_of(2, 2), gauss_newton=gauss_newton)
    P = operator.project(torch.eye(operator.dim, dtype=torch.float64))
    assert float((P - P.T).abs().max()) < 1e-10
    assert float((P @ P - P).abs().max()) < 1e-10
    assert float(P.diagonal().sum()) == pytest.approx(operator.rank, abs=1e-6)


def test_what_is_seen_whole_is_left_as_it_is_bit_for_bit() -> None:
    rows = torch.randn(5, 3, 3, generator=torch.Generator().manual_seed(0))
    rows[1, 2], rows[4, 1:] = 0.0, 0.0  # two that are seen in part
    basis = torch.linalg.qr(rows.mT).Q.mT * (rows.norm(dim=2, keepdim=True) > 0)
    space = RowSpace(basis, (basis.norm(dim=2) > 0.5).sum(dim=1))
    x = torch.randn(5, 3, 2, generator=torch.Generator().manual_seed(1))
    kept = space.project(x)
    assert torch.equal(kept[[0, 2, 3]], x[[0, 2, 3]])
    assert torch.allclose(kept, basis.mT @ (basis @ x), atol=1e-6)
    assert all(float((kept[i] - x[i]).norm()) > 0.1 for i in (1, 4))


@pytest.mark.parametrize(("rows", "columns", "copies"), [(8, 16, 0), (36, 16, 0), (40, 35, 1)])
def test_a_gpu_takes_no_large_matrices_apart(monkeypatch: pytest.MonkeyPatch, rows: int, columns: int, copies: int):
    generator = torch.Generator().manual_seed(0)
    A = torch.randn(CHUNK + 3, rows, 5, generator=generator, dtype=torch.float64)
    A = A @ torch.randn(CHUNK + 3, 5, columns, generator=generator, dtype=torch.float64)  # of rank 5
    plain, sizes, brought, svd, cpu = row_space(A, TOLERANCE[A.dtype]), [], [], torch.linalg.svd, torch.Tensor.cpu
    monkeypatch.setattr(torch.Tensor, "is_cuda", property(lambda tensor: not brought))
    monkeypatch.setattr(torch.Tensor, "cpu", lambda tensor: brought.append(tensor.shape) or cpu(tensor))
    monkeypatch.setattr(torch.linalg, "svd", lambda A, **options: sizes.append(A.shape) or svd(A, **options))
    found = row_space(A, TOLERANCE[A.dtype])
    assert len(brought) == copies and max(size[0] for size in sizes) <= CHUNK
    assert copies or all(size[1] <= 16 for size in sizes)
    assert torch.equal(found.rank, plain.rank) and int(found.rank.max()) == int(found.rank.min()) == 5
    assert torch.allclose(found.basis.mT @ found.basis, plain.basis.mT @ plain.basis, atol=1e-12)


def test_row_spaces_are_the_same_on_any_number_of_threads() -> None:
    objective, before, found = objective_of(3, 1, n=70), torch.get_num_threads(), []
    held = [view.jacobian for view in objective.linearized]
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found.append((seen_parameters(held, len(objective.active), 4), seen_colours(held, 3, objective.active)))
    finally:
        torch.set_num_threads(before)
    spaces = [(whole, colours.harmonics, colours.slopes) for whole, colours in found]
    for one, three in zip(*spaces, strict=True):
        assert torch.equal(one.basis, three.basis) and torch.equal(one.rank, three.rank)


def test_colours_seen_channel_by_channel_are_seen_as_all_at_once() -> None:
    objective = scattered(3, 3, 2, 40, LOSSES[0], lightness=-0.2)
    found = projector_of(objective).seen
    assert isinstance(found, ColourSpace) and len(found.harmonics.rank) > len(found.rank)
    wide = found.scaled(torch.ones(len(found.rank), 27, dtype=torch.float64))
    x = torch.randn(len(found.rank), 27, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.equal(wide.rank, found.rank)
    whole = wide.basis.mT @ (wide.basis @ x)
    assert torch.allclose(found.project(x), whole, atol=1e-13)
    assert torch.allclose(found._by_products(x), whole, atol=1e-13)  # as on a GPU
