"""No number depends on how many threads made it."""

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import pytest
import torch

from splat.backend.cpu import threads as threads_module
from splat.backend.cpu.threads import ALIGNED, over_batch, over_range, single_threaded, thread_count
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.render.render import render
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import random_gaussians, random_like
from tests.splat.tolerances import DTYPES


@pytest.fixture
def threads() -> Iterator[None]:
    """The number of threads is put back after the test."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])
def test_every_result_is_the_same_to_the_last_bit_on_one_two_and_five_threads(dtype):
    gaussians, views = random_gaussians(100, 1, logit=2.0).to(dtype), two_views(45, 37)
    U = random_like((gaussians.flat.numel(), 3), 1).to(dtype)
    results = []
    for count in (1, 2, 5):
        torch.set_num_threads(count)
        flat = gaussians.flat.clone().requires_grad_()
        shown = render(gaussians.with_flat(flat), views[0].camera, BACKGROUND, depth=True)
        assert shown.depth is not None
        (gradient,) = torch.autograd.grad(shown.image.sum() + shown.depth.sum(), flat)
        scene = SceneObjective(gaussians, views, LossSettings("charbonnier"), BACKGROUND)
        rows = U[: scene.active.flat.numel()]
        hessian, gauss_newton = SceneHessian(scene), SceneHessian(scene, gauss_newton=True, keep_null=True)
        own = scene.block_diagonal()
        results.append(
            [
                shown.image.detach(), shown.alpha.detach(), shown.depth.detach(), gradient, scene.gradient,
                torch.tensor(scene.loss(scene.active.flat)), hessian.apply(rows), hessian.apply(rows[:, :1]),
                gauss_newton.apply(rows), own.geometry, own.sh,
            ]
        )  # fmt: skip
    for other in results[1:]:
        assert all(torch.equal(one, two) for one, two in zip(results[0], other, strict=True))


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("size", [0, 1, 2, 3, 100])
def test_a_range_is_covered_once_in_contiguous_parts(size):
    def count(start: int, stop: int, visits: np.ndarray, lengths: list[int]) -> None:
        visits[start:stop] += 1
        lengths.append(stop - start)

    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        for least in (1, 4):
            visits, lengths = np.zeros(size, np.int64), []
            over_range(size, count, visits, lengths, least=least)
            assert (visits == 1).all() and len(lengths) == min(threads, max(size // least, 1))


@pytest.mark.usefixtures("threads")
def test_an_error_in_another_thread_is_not_swallowed():
    def fail_late(start: int, stop: int) -> None:
        if start > 0:
            raise ArithmeticError(f"part {start}..{stop}")

    torch.set_num_threads(2)
    with pytest.raises(ArithmeticError, match=r"part 5\.\.10"):
        over_range(10, fail_late)


@pytest.mark.usefixtures("threads")
def test_a_thread_that_asks_for_it_works_alone_and_only_that_one():
    torch.set_num_threads(2)
    with single_threaded(), ThreadPoolExecutor(1) as other:
        assert thread_count() == 1
        with single_threaded():
            pass
        assert thread_count() == 1
        assert other.submit(thread_count).result() == torch.get_num_threads()
    assert thread_count() == 2


def test_a_batch_is_divided_among_threads_on_the_cpu_alone():
    size = 5 * ALIGNED + 3
    for device, parts in (("cpu", min(thread_count(), 6)), ("meta", 1)):
        seen = []
        over_batch(size, lambda start, stop, seen=seen: seen.append((start, stop)), torch.device(device))
        assert len(seen) == parts and sorted(i for part in seen for i in range(*part)) == list(range(size))


@pytest.mark.usefixtures("threads")
def test_a_batch_is_taken_apart_to_the_same_bits_on_one_two_and_five_threads():
    # an odd number of entries: every other matrix begins beside a boundary of 16 bytes
    matrices = torch.randn(103, 27, 23, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    whole = torch.linalg.svd(matrices, full_matrices=False).Vh
    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        found = torch.empty_like(whole)

        def decompose(start: int, stop: int, found: torch.Tensor = found) -> None:
            found[start:stop] = torch.linalg.svd(matrices[start:stop], full_matrices=False).Vh

        over_batch(len(matrices), decompose, matrices.device)
        assert torch.equal(found, whole)


@pytest.mark.usefixtures("threads")
def test_parts_that_no_thread_begins_are_done_where_they_are_waited_for(monkeypatch):
    class Dead:  # as a pool whose threads could not be made, or died
        def submit(self, *_: object) -> Future:
            return Future()

    monkeypatch.setattr(threads_module, "_pool", lambda _: Dead())
    torch.set_num_threads(3)
    found = np.zeros(10)

    def fill(start: int, stop: int) -> None:
        found[start:stop] = range(start, stop)

    over_range(10, fill)
    assert found.tolist() == list(range(10))
