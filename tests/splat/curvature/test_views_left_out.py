"""What is said of training views that were left out: the parts of single views, and the error of their mean."""

from collections.abc import Iterable

import pytest
import torch

from landscape.results import sampling_error
from splat import SceneObjective, SyntheticSettings, synthetic_scene
from splat.curvature.hessian import SceneHessian
from splat.curvature.traces import block_traces, exact_traces

VIEWS = 5
MADE = synthetic_scene(SyntheticSettings(gaussians=60, views=VIEWS, width=24, height=16))


def objective(views: Iterable[int] = range(VIEWS)) -> SceneObjective:
    gaussians = MADE.truth.select(torch.arange(len(MADE.truth)), 1)
    gaussians.sh.add_(0.1 * torch.randn(gaussians.sh.shape, generator=torch.Generator().manual_seed(0)))
    loaded = MADE.scene.load()
    return SceneObjective(gaussians, [loaded[i] for i in views])


@pytest.mark.parametrize(
    "options", [{}, {"gauss_newton": True}, {"ssim_window": False}, {"indices": range(2)}], ids=str
)
def test_the_curvature_along_a_vector_is_the_mean_of_those_in_single_views(options):
    whole, generator = objective(), torch.Generator().manual_seed(1)
    V = torch.linalg.qr(torch.randn(len(whole.active.flat), 2, generator=generator))[0]
    hessian = SceneHessian(whole, **options)
    forms, curvatures = hessian.by_view(V), (hessian.project(V).double() * hessian.apply(V)).sum(dim=0)
    torch.testing.assert_close(forms.mean(dim=0), curvatures, rtol=1e-4, atol=1e-7)


def test_traces_and_losses_are_the_means_of_those_of_single_views():
    whole, generator = objective(), torch.Generator().manual_seed(1)
    assert float(whole.losses.mean()) == pytest.approx(whole.loss(whole.active.flat), rel=1e-6)
    exact = block_traces(whole)
    for name, sampled in exact_traces(whole, generator, samples=16).items():
        known, terms = exact[name], sampled.terms
        assert known.terms is not None and terms is not None
        assert float(known.terms.mean()) == pytest.approx(known.value, rel=1e-5, abs=1e-9)
        for view in range(VIEWS):
            alone = block_traces(objective([view]))[name]  # Gaussians that it does not see have no curvature in it
            assert float(known.terms[view]) == pytest.approx(alone.value, rel=1e-4, abs=1e-7)
        error = (sampled.samples.std() / 4) * VIEWS  # of a view's term, whose signs are its own
        assert ((terms - known.terms).abs() <= 6 * error + 1e-5 * known.terms.abs()).all()


@pytest.mark.parametrize("m", [2, 3, 4, 8])
def test_twice_the_error_of_views_left_out_holds_for_few_views_as_for_many(m):
    population = torch.randn(2000, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    draws = [torch.randperm(2000, generator=torch.Generator().manual_seed(seed))[:m] for seed in range(4000)]
    errors = torch.tensor([sampling_error(population[draw], 2000) for draw in draws])
    away = torch.stack([population[draw].mean() for draw in draws]) - population.mean()
    assert float((away.abs() <= 2 * errors).double().mean()) == pytest.approx(0.9545, abs=0.013)  # four standard errors


def test_no_error_is_known_of_one_view_and_it_is_0_of_all():
    population = torch.randn(12, generator=torch.Generator().manual_seed(2), dtype=torch.float64).exp()
    assert sampling_error(population, 12) == 0.0 and sampling_error(population[:1], 12) is None
