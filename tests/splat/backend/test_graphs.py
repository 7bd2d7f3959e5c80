"""Products that are recorded: when they are, what they give, and what happens where they cannot be."""

import inspect
import warnings
from collections.abc import Callable
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from splat.backend import graphs as recording
from splat.backend.graphs import CALLS, CudaGraphCache, CudaGraphs
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import random_gaussians, random_like


def triple(V: Tensor) -> Tensor:
    return 3 * V


class Fake:
    """A capture whose replay makes the call once more."""

    def __init__(self) -> None:
        self.captures, self.replays = 0, 0

    def __call__(self, call: Callable[[], Tensor]) -> tuple[Tensor, Callable[[], None]]:
        self.captures += 1
        result = call()

        def replay() -> None:
            self.replays += 1
            result.copy_(call())

        return result, replay


def test_a_product_is_recorded_once_for_each_frequent_number_of_vectors():
    fake = Fake()
    recordings = CudaGraphCache(fake)
    found = {k: [recordings(triple, torch.full((4, k), float(i))) for i in range(CALLS + 2)] for k in (1, 2)}
    assert (fake.captures, fake.replays) == (2, 2 * 3)
    recordings(triple, torch.ones(4, 3))
    assert fake.captures == 2
    for k, results in found.items():  # none is overwritten by the next
        assert all(torch.equal(result, torch.full((4, k), 3.0 * i)) for i, result in enumerate(results))


def test_a_failed_recording_warns_once_and_products_go_on():
    tried = []

    def fail(call: Callable[[], Tensor]) -> tuple[Tensor, Callable[[], None]]:
        tried.append(call())
        raise RuntimeError("operation not permitted")

    recordings = CudaGraphCache(fail)
    with pytest.warns(UserWarning, match=r"kernel by kernel.*\(operation not permitted\)") as caught:
        found = [recordings(triple, torch.full((4, k), float(i))) for k in (1, 2) for i in range(CALLS + 1)]
    assert len(caught) == len(tried) == 1
    assert [float(each[0, 0]) for each in found] == [0.0, 3.0, 6.0, 9.0] * 2


def test_captures_share_memory_and_stream_and_leave_it_when_they_fail(monkeypatch):
    """By stand-ins for torch's, with torch's own signature of `graph`."""
    noted, current, failing = [], ["default"], []
    signature = inspect.signature(torch.cuda.graph)

    class Graph:
        def pool(self) -> str:
            return f"pool of {noted[0]['cuda_graph'] is self}"

        def replay(self) -> None:
            noted.append({"replay": self})

    @contextmanager
    def graph(*arguments, **options):
        given = signature.bind(*arguments, **options).arguments
        noted.append(given)
        current.append(given["stream"])
        yield
        if failing:
            raise RuntimeError("invalid capture")  # and torch does not leave the stream
        current.pop()

    @contextmanager
    def stream(given):
        before = list(current)
        try:
            yield
        finally:
            current[:] = before

    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "graph", graph)
    monkeypatch.setattr(torch.cuda, "stream", stream)
    monkeypatch.setattr(torch.cuda, "device", nullcontext)
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: f"stream of {device}")
    capture = CudaGraphs(torch.device("cuda", 1))
    for i in range(2):
        result, replay = capture(lambda i=i: torch.full((1,), float(i)))
        assert result == i
    replay()
    first, second, replayed = noted
    assert first["stream"] == second["stream"] == "stream of cuda:1"
    assert (first["pool"], second["pool"]) == (None, "pool of True") and first["capture_error_mode"] == "thread_local"
    assert replayed["replay"] is second["cuda_graph"] and current == ["default"]
    failing.append(True)
    with pytest.raises(RuntimeError, match="invalid capture"):
        capture(lambda: torch.ones(1))
    assert current == ["default"]


def objective(device: torch.device, views: int, memory: int = 2**30) -> SceneObjective:
    """For a machine without a GPU: one tile a view, and a loss without SSIM."""
    gaussians = random_gaussians(4, 0, logit=1.0, spread=0.4)
    gaussians = gaussians.with_flat(gaussians.flat.to(device))
    loss = LossSettings("charbonnier", 0.0)
    return SceneObjective(gaussians, two_views(12, 8)[:views], loss, BACKGROUND, memory=memory)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="only a GPU records")
@pytest.mark.parametrize("gauss_newton", [False, True])
def test_recorded_products_of_a_scene_equal_others_to_the_last_bit(device, monkeypatch, gauss_newton):
    monkeypatch.setattr(recording, "CALLS", 1)
    hessian = SceneHessian(objective(device, 1), gauss_newton=gauss_newton)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        for seed in (1, 2):
            V = random_like((hessian.dim, 2), seed).to(device)
            product = hessian.views.apply(hessian.projector.without_lengths(V))
            assert torch.equal(hessian.apply(V), hessian.project(product))


def test_products_on_the_cpu_and_of_large_or_unkept_views_are_not_recorded(monkeypatch):
    here, few = (SceneHessian(objective(torch.device("cpu"), 2, memory)) for memory in (2**30, 1))
    views = here.objective.linearized
    assert (views.kept, few.objective.linearized.kept) == (2, 1)
    assert not here.recordable(1)
    for hessian in (here, few):
        vars(hessian.objective)["active"] = SimpleNamespace(flat=SimpleNamespace(device=torch.device("cuda")))
    assert here.recordable(1) and not few.recordable(1)
    monkeypatch.setattr("splat.curvature.hessian.MOST_RECORDED", views.workspace(8))
    assert here.recordable(8) and here.recordable(9)  # nine take the memory of eight
    monkeypatch.setattr("splat.curvature.hessian.MOST_RECORDED", views.workspace(8) - 1)
    assert here.recordable(7) and not here.recordable(8)
