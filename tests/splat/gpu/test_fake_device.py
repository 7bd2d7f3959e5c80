"""Nothing of the GPU's path reaches for a tensor on the host, or waits for the device where it need not."""

from collections import Counter
from dataclasses import replace

import pytest
import torch

pytest.importorskip("triton", reason="the kernels for GPUs need triton")

from analysis.measures.depth import depth_rises, depth_split
from analysis.measures.localization import conditions, localize
from analysis.measures.split_control import split_control
from analysis.measures.steepest import heaviest, kink_curvature
from landscape.eigen.lanczos import lanczos
from landscape.operators.operator import DenseOperator
from landscape.traces.trace import TraceSettings
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.training.loop import train
from splat.training.methods.corgs import _pruned, confirmed
from splat.training.methods.depth import FSGS, unpool
from splat.training.state import Training
from tests.splat.gpu.fake_device import FakeDevice
from tests.splat.gpu.interpreted import emulate
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import random_gaussians, random_like
from tests.splat.tiny import EXTENT, tiny_config, tiny_gaussians, tiny_views

pytestmark = [
    pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU, where a wrong device raises an error"),
    pytest.mark.usefixtures("emulator"),
]


def test_what_is_on_the_wrong_side_is_noted(monkeypatch):
    fake = FakeDevice(monkeypatch)
    with fake:
        there, here = fake.on_gpu(torch.ones(3)), torch.ones(3)
        _ = there * 2.0 + there.new_zeros(3) + here.to(there, non_blocking=True), there[torch.tensor([0])]
        assert not +fake.mixed and +fake.waits == Counter({"index": 1})
        fake.waits.clear()
        there[there > 0] = here
        _ = there + here, there.sum() + here, there.numpy(), float(there.sum()), here.to(there), there.nonzero()
    assert +fake.mixed == Counter({"add": 2, "numpy": 1, "index_put_": 1})
    assert +fake.waits == Counter({"_local_scalar_dense": 1, "to": 1, "nonzero": 1, "index_put_": 1})
    assert +fake.brought == Counter({"to": 2, "index": 1})


def put_on_gpu(training: Training, fake: FakeDevice) -> None:
    training.gaussians = training.gaussians.with_flat(fake.on_gpu(training.gaussians.flat))
    for name in ("first", "second"):
        moment = getattr(training.adam, name)
        setattr(training.adam, name, moment.with_flat(fake.on_gpu(moment.flat)))
    sums = training.screen_gradients
    sums.total, sums.renders = fake.on_gpu(sums.total), fake.on_gpu(sums.renders)


def test_a_training_step_stays_on_the_device_and_waits_six_times(monkeypatch):
    views = tiny_views()
    config = replace(tiny_config(), random_background=False)  # which would compare with another picture every step
    training = Training.start(tiny_gaussians(6), EXTENT, config)
    fake = FakeDevice(monkeypatch)
    emulate(monkeypatch)
    with fake:
        put_on_gpu(training, fake)
        steps = train(training, views)
        next(steps)
        # whether the parameters are finite, the largest scale, how many strips and entries, the loss, the sum of the gradient
        # and once, before the first step, whether a view draws any
        assert +fake.waits == Counter({"_local_scalar_dense": 5, "cpu": 2})
        next(steps)  # with density control
    assert not +fake.mixed


@pytest.mark.parametrize("method", ["fsgs", "cor-gs"])
def test_what_the_host_finds_out_about_neighbours_is_brought_back(monkeypatch, method):
    training = Training.start(tiny_gaussians(12), EXTENT, tiny_config())
    fake = FakeDevice(monkeypatch)
    with fake:
        put_on_gpu(training, fake)
        there = training.gaussians
        if method == "fsgs":
            change = unpool(there, EXTENT, FSGS(threshold=0.2, large=0.1))
        else:
            change = _pruned(there, confirmed(there, there.select(torch.arange(3)), 0.3))
        assert 0 < len(change.gaussians) != len(there)
        training.replace_gaussians(change)
        _ = change.fresh & (change.gaussians.opacity_logits > 0)  # that it is there, too
    assert not +fake.mixed


def test_products_of_a_scene_stay_on_the_device_and_do_not_wait(monkeypatch):
    gaussians = random_gaussians(4, 0, logit=1.0, spread=0.4)
    fake = FakeDevice(monkeypatch)
    emulate(monkeypatch)
    with fake:
        flat = fake.on_gpu(gaussians.flat)
        views = two_views(16, 5)[:1]
        objective = SceneObjective(gaussians.with_flat(flat), views, LossSettings(), BACKGROUND, memory=2**30)
        hessian = SceneHessian(objective)
        V = fake.on_gpu(random_like((hessian.dim, 2), 1))
        hessian.apply(V)
        fake.waits.clear()
        fake.brought.clear()
        hessian.apply(V)
        assert not +fake.waits and not +fake.brought  # the host runs ahead
        _ = objective.gradient, objective.block_diagonal(approximate=True), objective.loss(flat)
        known = BlockEigenvectors(objective, *objective.approximate_blocks)
        known.steepest(1, 1)
        localize(V[:, 0], objective.active, conditions(objective.active, [views[0].camera]))
        split_control(objective.active, [views[0].camera])
        depth_split(objective, torch.Generator().manual_seed(0), TraceSettings.fixed(8))
        kink_curvature(objective, V[:, 0])
        assert heaviest(objective, [V[:, 0]], torch.Generator().manual_seed(0))[0].outline
        depth_rises(objective, torch.Generator().manual_seed(0), steps=(1.0,), draws=2)
    assert not +fake.mixed


def test_lanczos_waits_three_times_a_step_and_brings_nothing_to_the_device(monkeypatch):
    A = random_like((20, 20), 1)
    fake = FakeDevice(monkeypatch)
    with fake:
        operator, starts = DenseOperator(fake.on_gpu(A + A.T)), fake.on_gpu(random_like((20, 1), 2))
        waits = []
        for steps in (2, 3):
            fake.waits.clear()
            lanczos(operator, starts, steps)
            waits.append(+fake.waits)
    assert waits[1] - waits[0] == Counter({"_local_scalar_dense": 2, "cpu": 1})  # two lengths, and a row of T
    assert not +fake.mixed and not +fake.brought
