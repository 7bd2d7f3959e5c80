"""What a probe does with the time that it has."""

from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import pytest
import torch

from analysis.bench.accuracy.cases import splat_cases
from analysis.console.budget import Share
from analysis.probe import measurement
from analysis.probe.measurement import ProbeSettings, _density, measure
from landscape import CountingOperator, EigenSettings, extreme_eigenpairs
from landscape.operators.operator import DenseOperator
from landscape.spectrum.density import spectral_density
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import random_gaussians

DIM = 50


@pytest.mark.parametrize(
    ("seconds", "room", "shape", "said"),
    [
        (61.0, 1000, (4, 15), []),
        (52.0, 1000, (4, 13), ["52 products instead of 60"]),
        (16.0, 1000, (3, 5), ["16 products instead of 60"]),
        (61.0, 30, (10, 6), []),
        (61.0, 9, (15, 4), []),
        (11.0, 1000, None, ["left out: time and memory allowed 11 products in runs of 200"]),
        (61.0, 6, None, ["left out: time and memory allowed 60 products in runs of 3"]),
    ],
)
def test_time_and_memory_bound_the_products_of_a_density(seconds, room, shape, said):
    operator = CountingOperator(DenseOperator(torch.diag(torch.linspace(-1, 3, DIM, dtype=torch.float64))))
    run, notes = partial(spectral_density, operator), []
    share = Share(seconds, torch.Generator().manual_seed(0), lambda *_: None, notes)
    density = _density(run, room, ProbeSettings(density_matvecs=60), 1.0, share)
    assert (None if density is None else tuple(density.nodes.shape)) == shape
    assert len(notes) == len(said) and all(words in note for words, note in zip(said, notes, strict=True))
    assert operator.matvecs == (shape[0] * shape[1] if shape else 0)  # none for the time alone


def test_kernels_are_compiled_before_the_time_runs_and_blocks_made_once(monkeypatch):
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
    counted(measurement, "Budget")
    objective = SceneObjective(random_gaussians(15, 1, logit=1.0), two_views(), LossSettings(), BACKGROUND)
    settings = replace(ProbeSettings.quick(), slice_points=5, seconds=60.0)
    found = measure(objective, settings, torch.Generator().manual_seed(0), lambda name: nullcontext(lambda *_: None))
    first = calls[: calls.index("Budget")]
    assert {"block_diagonal", "evaluate", "check_against_gradient"} <= {*first}
    assert calls.count("block_diagonal") == 1 and calls.count("gauss_newton") == 1
    assert found.value == pytest.approx(objective.loss(objective.active.flat))
    assert found.plane is not None  # the two axes alone
    assert int(found.plane.slice.evaluated.sum()) == 9 and not found.plane.slice.resolved
    assert {trace.probes for trace in found.traces.values()} == {settings.trace_samples}


def test_the_slices_model_has_the_hessian_between_its_directions():
    objective = SceneObjective(
        random_gaussians(15, 1, logit=1.0).to(torch.float64), two_views(), LossSettings(), BACKGROUND.double()
    )
    settings = replace(ProbeSettings.quick(), slice_points=5, seconds=60.0)
    found = measure(objective, settings, torch.Generator().manual_seed(0), lambda name: nullcontext(lambda *_: None))
    assert found.plane is not None and found.plane.slice.curvature is not None
    E = found.ends.largest.vectors[:, :2]
    between = E.T @ SceneHessian(objective).apply(E)
    off = (found.plane.slice.curvature - between).abs().max() / between.abs().max()
    assert off < 1e4 * torch.finfo(torch.float64).eps  # what a probe's checks ask of a product


def test_a_search_begun_with_several_directions_finds_the_ends():
    """The two largest values of this scene are 13% apart."""
    case = splat_cases(0, 2)["far from a fit #2"]()
    assert case.objective is not None
    seeds, loose, fine = range(3), EigenSettings(rtol=0.1), EigenSettings(rtol=1e-6)
    true = extreme_eigenpairs(case.operator, torch.Generator().manual_seed(9), fine)
    own = BlockEigenvectors(case.objective, case.objective.block_diagonal())
    for start, certain in ((own.steepest(1, 1), False), (own.warm_start(), True)):
        found = [extreme_eigenpairs(case.operator, torch.Generator().manual_seed(s), loose, start) for s in seeds]
        errors = [
            abs(float(getattr(run, end).values[0] / getattr(true, end).values[0]) - 1)
            for run in found
            for end in ("largest", "smallest")
        ]
        assert (max(errors) < 0.1) == certain
