"""The stages of a probe at a small scene."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from analysis.console.stages import Stages
from analysis.measures.per_attribute import PerAttributeOptions
from analysis.measures.units import optimiser_units
from analysis.probe import measurement
from analysis.probe.command import probe_settings
from analysis.probe.measurement import measure
from analysis.probe.options import ProbeOptions
from analysis.probe.plan import expected_seconds
from analysis.probe.settings import ProbeSettings
from landscape import EigenSettings, TraceSettings, extreme_eigenpairs
from landscape.eigen.power import power_iteration
from notebooks.accuracy.cases import splat_cases
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import block_traces
from splat.losses.reference import LossSettings
from splat.training.state import LearningRates
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import random_gaussians


def steps(objective):
    return optimiser_units(objective, LearningRates(), 1.0)


def test_the_blocks_of_the_gaussians_are_made_once(monkeypatch):
    calls, whole = [], SceneObjective.block_diagonal

    def call(*args, **options):
        calls.append("gauss_newton" if options.get("gauss_newton") else "hessian")
        return whole(*args, **options)

    monkeypatch.setattr(SceneObjective, "block_diagonal", call)
    objective = SceneObjective(random_gaussians(15, 1, logit=1.0), two_views(), LossSettings(), BACKGROUND)
    settings = replace(ProbeSettings.quick(), slice_points=5)
    found = measure(objective, settings, steps(objective), torch.Generator().manual_seed(0), Stages())
    assert sorted(calls) == ["gauss_newton", "hessian"]
    assert found.value == pytest.approx(objective.loss(objective.active.flat))
    assert found.plane is not None  # the two axes alone
    assert int(found.plane.slice.evaluated.sum()) == 9 and not found.plane.slice.resolved
    assert {trace.probes for trace in found.traces.values()} == {settings.trace_samples}


def test_the_slices_model_has_the_hessian_between_its_directions():
    objective = SceneObjective(random_gaussians(15, 1, logit=1.0), two_views(), LossSettings(), BACKGROUND.double())
    settings = replace(ProbeSettings.quick(), slice_points=5)
    found = measure(objective, settings, steps(objective), torch.Generator().manual_seed(0), Stages())
    assert found.plane is not None and found.plane.slice.curvature is not None
    E = found.ends.largest.vectors[:, :2]
    between = E.T @ SceneHessian(objective).apply(E)
    off = (found.plane.slice.curvature - between).abs().max() / between.abs().max()
    assert off < 4e3 * torch.finfo(torch.float64).eps  # what a probe's checks ask of a product


def test_a_search_begun_with_several_directions_finds_the_ends():
    """The two largest values of this scene are 13% apart."""
    case = splat_cases(0, 2)["far from a fit #2"]()
    assert case.objective is not None
    seeds, loose, fine = range(3), EigenSettings(rtol=0.1), EigenSettings(rtol=1e-6)
    true = extreme_eigenpairs(case.operator, torch.Generator().manual_seed(9), fine)
    own = BlockEigenvectors(case.objective, case.objective.approximate_blocks[0])
    for start, certain in ((own.steepest(1, 1), False), (own.warm_start(), True)):
        found = [extreme_eigenpairs(case.operator, torch.Generator().manual_seed(s), loose, start) for s in seeds]
        errors = [
            abs(float(getattr(run, end).values[0] / getattr(true, end).values[0]) - 1)
            for run in found
            for end in ("largest", "smallest")
        ]
        assert (max(errors) < 0.1) == certain


def test_the_paper_s_power_iteration_is_read_from_the_density_without_products():
    objective = SceneObjective(random_gaussians(15, 1, logit=1.0), two_views(), LossSettings(), BACKGROUND.double())
    seen = []
    settings = replace(ProbeSettings(), slice_points=5, traces=TraceSettings(rtol=0.3), depth=None, density_matvecs=48)
    draw = measurement.spectral_density

    def watched(*given, watch, **named):
        return draw(*given, watch=lambda runs: (seen.extend(runs), watch(runs)), **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measurement, "spectral_density", watched)
        found = measure(objective, settings, steps(objective), torch.Generator().manual_seed(0), Stages())
    assert found.power is not None and found.power.matvecs == 0 and len(seen[0].T) >= 8
    starts = [run.Q[:, 0].contiguous() for run in (seen[0], seen[-1])]
    allowed = replace(settings.power, max_matvecs=len(seen[0].T))
    first, _ = power_iteration(SceneHessian(objective), torch.Generator(), allowed, start=starts[0])
    other, _ = power_iteration(
        SceneHessian(objective), torch.Generator(), allowed, float(first.values), start=starts[1]
    )
    size = float(found.ends.largest.values[0].abs())
    for mine, true in zip(
        (found.power.smallest, found.power.largest), sorted((first, other), key=lambda p: float(p.values)), strict=True
    ):
        assert abs(float(mine.values - true.values)) < 1e-9 * size and mine.reason == true.reason
        assert abs(float(mine.residuals - true.residuals)) < 1e-8 * size


def test_a_quick_probe_is_expected_to_take_what_it_makes_alone():
    whole, quick = ProbeSettings(), ProbeSettings.quick()
    seconds = [expected_seconds(settings, 2.0) for settings in (quick, replace(quick, slice_points=41), whole)]
    assert seconds[1] - seconds[0] == pytest.approx(1.5 * 20 * 2.0) and seconds[2] > 2 * seconds[0]
    assert expected_seconds(quick, 2.0, PerAttributeOptions().products) - seconds[0] == pytest.approx(
        4.5 * 2 * 6 * 26 * 2.0
    )


def test_a_point_of_the_slice_renders_all_views_so_many_views_have_fewer_points():
    asked = [ProbeOptions(Path("x")), ProbeOptions(Path("x"), slice_points=31), ProbeOptions(Path("x"), quick=True)]
    sides = [[probe_settings(options, views).slice_points for views in (9, 10)] for options in asked]
    assert sides == [[41, 21], [31, 31], [21, 21]]


def test_traces_are_exact_unless_samples_are_asked_for():
    objective = SceneObjective(random_gaussians(15, 1, logit=1.0), two_views(), LossSettings(), BACKGROUND)
    few = replace(ProbeSettings.quick(), slice_points=5, trace_samples=None)
    for samples in (None, 8):
        settings = replace(few, trace_samples=samples)
        found = measure(objective, settings, steps(objective), torch.Generator().manual_seed(0), Stages()).traces
        assert {(trace.probes, trace.reason == "exact") for trace in found.values()} == {(samples or 0, not samples)}
        for name, exact in block_traces(objective).items():
            assert found[name].value == exact.value or samples
            assert abs(found[name].value - exact.value) <= 6 * found[name].standard_error
