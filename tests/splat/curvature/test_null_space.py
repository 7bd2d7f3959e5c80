"""What is projected out of the operators is exactly flat, and nothing else is projected out."""

import pytest
import torch
from torch import Tensor

from splat.curvature.hessian import SceneHessian
from splat.curvature.null_space import CHUNK, RowSpace, _row_space, seen_parameters
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.scenes.view import View
from tests.splat.random_scenes import random_camera, random_gaussians


def objective_of(views: int, sh_degree: int, n: int = 14) -> SceneObjective:
    gaussians, generator = random_gaussians(n, sh_degree, seed=2), torch.Generator().manual_seed(4)
    cameras = [random_camera(32, 28, seed=seed, focal=34.0) for seed in range(views)]
    pictures = [torch.rand(3, 28, 32, generator=generator) for _ in cameras]
    seen = [View(str(i), camera, picture) for i, (camera, picture) in enumerate(zip(cameras, pictures, strict=True))]
    return SceneObjective(gaussians, seen, LossSettings("l2"))


def dense(operator: SceneHessian) -> Tensor:
    return operator.apply(torch.eye(operator.dim, dtype=torch.float64))


@pytest.mark.parametrize(("views", "sh_degree"), [(1, 3), (2, 3), (3, 1), (5, 3)])
def test_gauss_newton_loses_nothing_by_the_projection(views: int, sh_degree: int) -> None:
    objective = objective_of(views, sh_degree)
    plain = dense(SceneHessian(objective, gauss_newton=True, keep_null=True))
    projected = dense(SceneHessian(objective, gauss_newton=True))
    assert float((plain - projected).norm() / plain.norm()) < 1e-10


@pytest.mark.parametrize(("views", "sh_degree"), [(1, 3), (2, 3), (3, 1), (5, 3)])
def test_the_rank_is_that_of_the_stacked_jacobians_and_within_its_bound(views: int, sh_degree: int) -> None:
    objective = objective_of(views, sh_degree)
    operator, n, k = SceneHessian(objective, gauss_newton=True), len(objective.active), (sh_degree + 1) ** 2
    total = 0
    for i in range(n):
        own = torch.cat([torch.arange(rows.start, rows.stop).view(n, -1)[i] for rows in objective.blocks.values()])
        unit = torch.zeros(operator.dim, len(own), dtype=torch.float64)
        unit[own, torch.arange(len(own))] = 1
        stacked = torch.cat(
            [torch.from_numpy(view._projection.jvp(unit.numpy())[i].T) for view in objective.linearized]
        )
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
    # a view sees the harmonics at one direction and their slope along the two directions across it: 3 of 16
    sightings = sum(view.touched for view in objective.linearized)
    assert operator.rank == 10 * len(objective.active) + 3 * 3 * sightings


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
def test_a_gpu_takes_no_large_matrices_apart(
    monkeypatch: pytest.MonkeyPatch, rows: int, columns: int, copies: int
) -> None:
    generator = torch.Generator().manual_seed(0)
    A = torch.randn(CHUNK + 3, rows, 5, generator=generator, dtype=torch.float64)
    A = A @ torch.randn(CHUNK + 3, 5, columns, generator=generator, dtype=torch.float64)  # of rank 5
    plain, sizes, brought, svd, cpu = _row_space(A, A.dtype), [], [], torch.linalg.svd, torch.Tensor.cpu
    monkeypatch.setattr(torch.Tensor, "is_cuda", property(lambda tensor: not brought))
    monkeypatch.setattr(torch.Tensor, "cpu", lambda tensor: brought.append(tensor.shape) or cpu(tensor))
    monkeypatch.setattr(torch.linalg, "svd", lambda A, **options: sizes.append(A.shape) or svd(A, **options))
    found = _row_space(A, A.dtype)
    assert len(brought) == copies and max(size[0] for size in sizes) <= CHUNK
    assert copies or all(size[1] <= 16 for size in sizes)
    assert torch.equal(found.rank, plain.rank) and int(found.rank.max()) == int(found.rank.min()) == 5
    assert torch.allclose(found.basis.mT @ found.basis, plain.basis.mT @ plain.basis, atol=1e-12)


def test_row_spaces_are_the_same_on_any_number_of_threads() -> None:
    objective, before, found = objective_of(3, 1, n=70), torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found.append(seen_parameters([view.held for view in objective.linearized], len(objective.active), 4))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(found[0].basis, found[1].basis) and torch.equal(found[0].rank, found[1].rank)
