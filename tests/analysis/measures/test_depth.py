"""Positions along and across the rays, against the specification's dense derivatives and renders one by one."""

from dataclasses import replace
from math import erf, inf, sqrt

import pytest
import torch
from torch import Tensor

from analysis.measures.depth import KINDS, DepthSplit, _directions, _signs, depth_rises, depth_split, gradient_ratio
from analysis.records.schema import Rise
from landscape.results import t_quantile
from landscape.traces.estimate import TraceEstimate
from landscape.traces.trace import TraceSettings
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from tests.splat.held_scenes import BACKGROUND, gradient_and_products, two_views
from tests.splat.random_scenes import random_gaussians

PIXELWISE = LossSettings("charbonnier", ssim_weight=0)


def objective_of(gaussians: Gaussians, loss: LossSettings = PIXELWISE, views: int = 2) -> SceneObjective:
    return SceneObjective(gaussians, two_views()[:views], loss, BACKGROUND)


@pytest.fixture(scope="module")
def objective() -> SceneObjective:
    return objective_of(random_gaussians(8, sh_degree=1, seed=4, logit=1.0))


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def by_specification(objective: SceneObjective, loss: LossSettings) -> tuple[Tensor, Tensor]:
    """|g . v|, |g - (g . v) v| of every pair, and both traces, from a dense Hessian a view."""
    n, rows = len(objective.active), objective.blocks["means"]
    U = torch.eye(objective.active.flat.numel(), dtype=torch.float64)[:, rows]
    pairs, traces = [], torch.zeros(2, dtype=torch.float64)
    for view in objective.views:
        gradient, HU = gradient_and_products(objective.active, [view], loss, U)
        offsets = objective.active.means - view.camera.centre
        v = offsets / offsets.norm(dim=1, keepdim=True)
        g, H = gradient[rows].view(n, 3), HU[rows].view(n, 3, n, 3)
        for i in range(n):
            depth = float(g[i] @ v[i])
            pairs.append([abs(depth), sqrt(float(g[i] @ g[i]) - depth**2)])
            along = float(v[i] @ H[i, :, i] @ v[i])
            both = [along, float(H[i, :, i].trace()) - along]
            traces += torch.tensor(both, dtype=torch.float64) / len(objective.views)
    return torch.tensor(pairs, dtype=torch.float64), traces


def test_gradients_and_traces_are_those_of_each_views_dense_derivatives(objective):
    pairs, traces = by_specification(objective, PIXELWISE)
    split, n = depth_split(objective, generator()), len(objective.active)
    assert gradient_ratio(objective) == pytest.approx(split.gradient_ratio)
    expected, order = pairs[pairs.any(dim=1)].sort(dim=0).values, split.components.sort(dim=0).values
    assert order.shape == expected.shape and torch.allclose(order, expected, rtol=1e-7, atol=1e-7 * float(pairs.max()))
    assert (split.depth.reason, split.depth.dim, split.lateral.dim) == ("exact", n, 2 * n)
    assert [split.depth.value, split.lateral.value] == pytest.approx(traces.tolist(), rel=1e-9)
    depth, lateral = pairs.square().sum(dim=0)
    assert split.gradient_ratio == pytest.approx(float((2 * depth / lateral).sqrt()), rel=1e-9)


def test_with_ssim_both_traces_are_within_their_errors_over_many_seeds():
    loss, seeds = LossSettings(), 60
    objective = objective_of(random_gaussians(8, sh_degree=1, seed=4, logit=1.0), loss)
    _, traces = by_specification(objective, loss)
    found = [depth_split(objective, generator(seed), TraceSettings.fixed(12)) for seed in range(seeds)]
    exact = depth_split(objective, generator(), exact=True)
    assert [exact.depth.value, exact.lateral.value] == pytest.approx(traces.tolist(), rel=1e-9)
    assert exact.depth.reason == exact.lateral.reason == "exact"
    for name, truth in zip(KINDS, traces.tolist(), strict=True):
        estimates = [getattr(split, name) for split in found]
        z = torch.tensor([(estimate.value - truth) / estimate.standard_error for estimate in estimates])
        # Student's t with 11 degrees of freedom has variance 11 / 9; the mean of 60 is then known to sqrt(11 / 9 / 60)
        assert abs(float(z.mean())) < 4 * sqrt(11 / 9 / seeds), name
        assert float(z.square().mean()) < 3, name


def test_ratios_are_per_lateral_direction_and_brackets_hold_both_intervals():
    depth, lateral = (TraceEstimate.exact(name, 1, value, 0.95) for name, value in (("depth", 3.0), ("lateral", 12.0)))
    split = DepthSplit(torch.tensor([[3.0, 4.0], [0.0, 4.0], [1.0, 1.0]]), depth, lateral)
    assert split.gradient_ratio == pytest.approx(sqrt(2 * 10 / 33))
    assert split.median_ratio == pytest.approx(sqrt(2) * 0.75)
    wide = replace(split, depth=replace(depth, low=-1.0, high=4.0), lateral=replace(lateral, low=10.0, high=20.0))
    assert wide.curvature_ratio.value == 0.5 and (wide.curvature_ratio.low, wide.curvature_ratio.high) == (-0.2, 0.8)
    unknown = replace(split, lateral=replace(lateral, low=0.0)).curvature_ratio
    assert unknown.value is None and (unknown.low, unknown.high) == (-inf, inf) and "undetermined" in unknown.note


def test_steps_are_along_the_rays_or_across_them_and_as_long_as_a_pixel(objective):
    for index, view in enumerate(objective.views):
        along, across = _directions(objective, index, generator())
        offsets = objective.active.means - view.camera.centre
        length = offsets.norm(dim=1) / view.camera.fx
        assert torch.allclose(along.norm(dim=1), length, rtol=1e-12)
        assert torch.allclose(across.norm(dim=1), length, rtol=1e-12)
        assert float(torch.linalg.cross(along, offsets).norm()) < 1e-12
        assert float((across * offsets).sum(dim=1).abs().max()) < 1e-12
        assert along.shape == across.shape == objective.active.means.shape
        assert 0 < int(((along * offsets).sum(dim=1) > 0).sum()) < len(along)  # both signs


def test_probes_have_signs_along_the_rays_or_across_them(objective):
    rays = [objective.rays(index) for index in range(2)]
    for index, ray in enumerate(rays):
        U = _signs(objective, index, [generator(0), generator(1)], KINDS)
        means, others = U[objective.blocks["means"]].view(-1, 3, 2, 2), U[objective.blocks["means"].stop :]
        along = torch.einsum("nc,ncks->nks", ray, means)
        assert torch.allclose(along[:, 0].abs(), torch.ones(()).double()) and float(along[:, 1].abs().max()) < 1e-12
        assert torch.allclose(means[:, :, 0], ray[:, :, None] * along[:, None, 0])
        # signs in space have the squared length 3
        across = means[:, :, 1].square().sum(dim=1)
        assert (across <= 3 + 1e-12).all() and float(across.std()) > 0 and not others.any()
        assert not torch.equal(means[..., 0], means[..., 1])


def by_kind(rises: list[Rise], suffix: str = "") -> torch.Tensor:
    """A row for each length of steps, a column for each of KINDS."""
    rows = [[getattr(rise, f"{kind}{suffix}") for kind in KINDS] for rise in rises]
    return torch.tensor(rows, dtype=torch.float64)


def test_rises_are_those_of_the_loss_of_each_view():
    loss = LossSettings()
    objective = objective_of(random_gaussians(8, sh_degree=1, seed=4, logit=1.0), loss)
    steps, draws = (0.5, 5.0), 3
    found = depth_rises(objective, generator(), steps, draws)
    seeds = torch.randint(2**62, (draws,), generator=generator()).tolist()
    rises = torch.zeros(2, 2, 2, draws, dtype=torch.float64)
    for index in range(2):
        alone = SceneObjective(objective.active, [objective.views[index]], loss, BACKGROUND, keep_unseen=True)
        center = alone.active.flat
        for draw, seed in enumerate(seeds):
            for kind, direction in enumerate(_directions(objective, index, generator(seed + index))):
                u = torch.zeros_like(center)
                u[alone.blocks["means"]] = direction.reshape(-1)
                for s, step in enumerate(steps):
                    ends = alone.loss(center + step * u) + alone.loss(center - step * u)
                    rises[s, kind, index, draw] = ends / 2 - alone.loss(center)
    values, errors = by_kind(found), by_kind(found, "_error")
    # the views' own rises are no error; Student's factor at one standard error, for two views' 2 x 2 degrees of freedom
    student = t_quantile(4, erf(sqrt(2))) / 2
    assert torch.allclose(values, rises.mean(dim=(2, 3)), rtol=1e-9, atol=1e-15)
    assert torch.allclose(errors, student * (rises.var(dim=3).sum(dim=2) / 3).sqrt() / 2, rtol=1e-9, atol=1e-15)
    assert tuple(rise.pixels for rise in found) == steps
    for rise, (depth, lateral), relative in zip(found, values.tolist(), (errors / values).square().sum(dim=1).tolist()):
        assert rise.ratio == pytest.approx(depth / lateral)
        assert rise.ratio_error == pytest.approx(abs(depth / lateral) * sqrt(relative))
    assert depth_rises(objective, generator(), steps, draws) == found


def test_small_steps_rise_as_the_curvature_says(objective):
    """The mean over all signs of d . H d / 2: what the Gaussians do to one another has the mean 0."""
    pixels = 1e-3
    found = depth_rises(objective, generator(), (pixels,), draws=60)
    n, rows, expected = len(objective.active), objective.blocks["means"], torch.zeros(2, dtype=torch.float64)
    U = torch.eye(objective.active.flat.numel(), dtype=torch.float64)[:, rows]
    for view in objective.views:
        _, HU = gradient_and_products(objective.active, [view], PIXELWISE, U)
        offsets = objective.active.means - view.camera.centre
        v, lengths = offsets / offsets.norm(dim=1, keepdim=True), pixels * offsets.norm(dim=1) / view.camera.fx
        own = torch.einsum("iaib->iab", HU[rows].view(n, 3, n, 3))
        depth = torch.einsum("ia,iab,ib->i", v, own, v)
        both = torch.stack([depth, (own.diagonal(dim1=1, dim2=2).sum(dim=1) - depth) / 2])
        expected += (both * lengths.square()).sum(dim=1) / 2 / len(objective.views)
    values, errors = by_kind(found)[0], by_kind(found, "_error")[0]
    assert ((values - expected).abs() < 4 * errors).all()
    assert (errors < 0.1 * expected.abs()).all()


def test_a_step_along_the_rays_that_swaps_two_gaussians_is_seen():
    """Two at nearly the same depth: a pixel's length along the rays swaps them where their signs differ, across them never."""
    gaussians = random_gaussians(2, sh_degree=0, seed=1, logit=1.0)
    camera = two_views()[0].camera
    ray = torch.nn.functional.normalize(gaussians.means[0] - camera.centre, dim=0)
    gaussians.means[1] = gaussians.means[0] + 1e-6 * ray
    found = depth_rises(objective_of(gaussians, views=1), generator(), (1e-7, 1.0), draws=8)
    small, large = by_kind(found, "_crossed").tolist()
    assert small == [0, 0] and 0 < large[0] < 1


def test_fewer_than_two_draws_are_refused(objective):
    with pytest.raises(ValueError, match="at least 2 draws, got 1"):
        depth_rises(objective, generator(), draws=1)
