"""What a probe does with the time that it has."""

from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch

from analysis import measurement
from analysis.measurement import ProbeSettings, _density, _within, measure
from landscape import CountingOperator
from landscape.density import ActiveSpace
from landscape.operator import DenseOperator
from splat.curvature import SceneHessian, SceneObjective
from splat.losses import LossSettings
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import random_gaussians

DIM = 50


@pytest.mark.parametrize(
    ("seconds", "shape", "said"),
    [
        (40.0, (4, 10), []),
        (16.0, (4, 4), ["4 steps instead of 10"]),
        (15.0, (3, 5), ["3 start vectors instead of 4", "5 steps instead of 10"]),
        (11.0, None, ["left out: time and memory allowed 3 steps for each of 3"]),
    ],
)
def test_a_density_has_fewer_start_vectors_before_it_has_too_few_steps(seconds, shape, said):
    operator = CountingOperator(DenseOperator(torch.diag(torch.linspace(-1, 3, DIM, dtype=torch.float64))))
    everything, notes = ActiveSpace(lambda V: V, DIM), []
    generator, settings = torch.Generator().manual_seed(0), ProbeSettings(density_steps=10)
    density = _density(operator, everything, generator, settings, seconds, 1.0, lambda *_: None, notes)
    assert (None if density is None else tuple(density.nodes.shape)) == shape
    assert len(notes) == len(said) and all(words in note for words, note in zip(said, notes, strict=True))
    assert operator.matvecs == (shape[0] * shape[1] if shape else 0)  # none for the time alone


def test_a_quick_slice_is_judged_by_few_points_whatever_the_time():
    settings = ProbeSettings.quick()
    holdouts = [_within(settings, seconds, each=0.5, workers=2).holdout for seconds in (50.0, 40.0, 2.0)]
    assert holdouts == [settings.slice_holdout, settings.slice_holdout, 5]


def test_every_kernel_has_worked_before_the_time_runs_and_own_blocks_are_made_once(monkeypatch):
    """The clock is read for the budget after the first product, render, block and float64 gradient."""
    calls: list[str] = []

    def counted(owner, name):
        whole = getattr(owner, name)

        def call(*args, **options):
            calls.append("gauss_newton" if options.get("gauss_newton") else name)
            return whole(*args, **options)

        monkeypatch.setattr(owner, name, call)

    for name in ("block_diagonal", "evaluate"):
        counted(SceneObjective, name)
    counted(measurement, "check_against_gradient")
    counted(measurement, "_Budget")
    objective = SceneObjective(random_gaussians(15, 1, logit=1.0), two_views(), LossSettings(), BACKGROUND)
    settings = replace(ProbeSettings.quick(), slice_points=5, seconds=60.0)
    found = measure(
        objective, LossSettings(), settings, torch.Generator().manual_seed(0), lambda name: nullcontext(lambda *_: None)
    )
    first = calls[: calls.index("_Budget")]
    assert {"block_diagonal", "evaluate", "check_against_gradient"} <= {*first}
    assert calls.count("block_diagonal") == 1 and calls.count("gauss_newton") == 1
    assert found.value == pytest.approx(objective.loss(objective.active.flat))
    assert {trace.probes for trace in found.traces.values()} == {settings.trace_samples}


@pytest.mark.parametrize(("renders", "held_out", "batch"), [(100, 30, 32), (80, 20, 20), (4, 5, 5)])
def test_a_slice_with_little_time_keeps_its_points_and_judges_them_by_fewer(renders, held_out, batch):
    allowed = _within(ProbeSettings(), seconds=0.5 * renders, each=0.5, workers=2)
    assert (allowed.holdout, allowed.batch, allowed.workers) == (held_out, batch, 2)
    assert allowed.max_seconds == 0.5 * renders and allowed.tolerance == ProbeSettings().slice_tolerance


def test_the_slices_model_has_the_hessians_curvature_between_its_directions():
    objective = SceneObjective(
        random_gaussians(15, 1, logit=1.0).to(torch.float64), two_views(), LossSettings(), BACKGROUND.double()
    )
    settings = replace(ProbeSettings.quick(), slice_points=5, seconds=60.0)
    found = measure(
        objective, LossSettings(), settings, torch.Generator().manual_seed(0), lambda name: nullcontext(lambda *_: None)
    )
    assert found.plane is not None and found.plane.slice.curvature is not None
    E = found.ends.largest.vectors[:, :2]
    between = E.T @ SceneHessian(objective).apply(E)
    off = (found.plane.slice.curvature - between).abs().max() / between.abs().max()
    assert off < 1e4 * torch.finfo(torch.float64).eps  # what a probe's checks ask of a product
