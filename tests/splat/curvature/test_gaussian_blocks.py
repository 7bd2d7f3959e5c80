"""Every Gaussian's own block of the Hessian, and the traces that build on it, against the dense Hessian in float64."""

from functools import partial
from math import sqrt

import pytest
import torch
from torch import Tensor

from landscape.traces.trace import TraceSettings
from splat.curvature.hessian import SceneHessian
from splat.curvature.linearize import VECTORS, LinearizedView
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import LEAST_SAMPLES, SampledTrace, _signs, controlled, coupling_samples, exact_traces
from splat.losses.cpu.loss import CpuViewLoss
from splat.losses.reference import LossSettings
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.render import render
from splat.scenes.view import View
from tests.splat.random_scenes import ANTIALIASED, MODES, filtered, random_camera, random_gaussians, random_like

GEOMETRY = ("means", "log_scales", "quats", "opacity_logits")
PIXEL_SUMS = [LossSettings(kind, ssim_weight=0) for kind in ("l1", "charbonnier", "l2")]
WITH_SSIM = [LossSettings(), LossSettings("charbonnier", ssim_weight=0.5), LossSettings("l2", ssim_weight=1.0)]


def awkward_gaussians(sh_degree: int = 1) -> Gaussians:
    """Clamped by the cap, stopped behind opaque ones, a needle, one across the image's edge, two at the same place, black."""
    gaussians = random_gaussians(24, sh_degree=sh_degree, seed=3, logit=1.0, spread=0.8)
    gaussians.opacity_logits[:8] = 7.0  # the cap holds near their centres, and pixels stop behind several of them
    gaussians.log_scales[:8] = -0.5
    gaussians.log_scales[8] = torch.tensor([1.0, -6.0, -6.0])
    gaussians.means[9] = torch.tensor([1.9, 0.0, 4.0])
    gaussians.means[10] = gaussians.means[11]
    gaussians.sh[12, 0] = torch.tensor([-3.0, 0.5, 0.5])  # one colour is clamped at 0
    gaussians.means[13] = torch.tensor([9.0, 0.0, 4.0])  # off the screen
    return gaussians


def objective_of(
    gaussians: Gaussians,
    loss: LossSettings,
    noise: float,
    size: tuple[int, int] = (32, 28),
    settings: RenderSettings = RenderSettings(),
) -> SceneObjective:
    """Two views whose targets are the renders themselves plus noise: small noise is a good fit."""
    generator, views = torch.Generator().manual_seed(5), []
    for seed in (0, 1):
        camera: Camera = random_camera(*size, seed=seed, focal=34.0)
        image = render(gaussians, camera, BACKGROUND, settings).image
        target = image + noise * torch.randn(image.shape, generator=generator, dtype=image.dtype)
        views.append(View(str(seed), camera, target.float()))
    return SceneObjective(gaussians, views, loss, BACKGROUND, settings)


BACKGROUND = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)


def dense(operator: SceneHessian) -> Tensor:
    return operator.apply(torch.eye(operator.dim, dtype=torch.float64))


def geometry_rows(objective: SceneObjective) -> Tensor:
    """Where each Gaussian's geometry and opacity lie among all parameters, (n, 11)."""
    each = [
        torch.arange(rows.stop)[rows].view(len(objective.active), -1)
        for rows in (objective.blocks[name] for name in GEOMETRY)
    ]
    return torch.cat(each, dim=1)


@pytest.mark.parametrize(
    ("loss", "sh_degree", "mode"),
    [
        *((loss, 1, "none") for loss in PIXEL_SUMS + WITH_SSIM),
        *((WITH_SSIM[1], degree, "none") for degree in (0, 2, 3)),
        *((loss, 1, mode) for mode in ANTIALIASED for loss in (PIXEL_SUMS[2], WITH_SSIM[1])),
    ],
    ids=str,
)
@pytest.mark.parametrize("gauss_newton", [False, True])
def test_own_blocks_are_those_of_the_dense_hessian(loss, sh_degree, mode, gauss_newton):
    gaussians = filtered(awkward_gaussians(sh_degree), mode)
    objective = objective_of(gaussians, loss, noise=0.3, size=(33, 27), settings=MODES[mode])
    own = objective.block_diagonal(gauss_newton=gauss_newton)
    H = dense(SceneHessian(objective, gauss_newton=gauss_newton, keep_null=True))
    expected = torch.stack([H[index][:, index] for index in geometry_rows(objective)])
    scale = 1e-10 * float(H.diagonal().abs().max())
    assert float((own.geometry - expected).abs().max()) <= scale
    assert float((own.sh.reshape(-1) - H.diagonal()[objective.blocks["sh"]]).abs().max()) <= scale
    traces = own.traces()
    for name, block in objective.blocks.items():
        assert abs(traces[name] - float(H.diagonal()[block].sum())) <= 1e-10 * float(H.diagonal()[block].abs().sum())


def test_own_blocks_with_ssim_are_differences_of_gradients() -> None:
    objective, step = objective_of(random_gaussians(20, sh_degree=1, seed=7), WITH_SSIM[1], noise=0.1), 1e-5
    own, flat = objective.block_diagonal().geometry, objective.active.flat
    for gaussian, rows in enumerate(geometry_rows(objective)[:3]):
        columns = []
        for row in rows:
            ends = []
            for sign in (1, -1):
                moved = flat.clone()
                moved[row] += sign * step
                views = list(map(objective.linearizer(objective.active.with_flat(moved)), range(2)))
                ends.append((views[0].gradient + views[1].gradient)[rows] / 2)
            columns.append((ends[0] - ends[1]) / (2 * step))
        # the truncation is step^2 / 6 times a third derivative: one more factor of some 1 / (a splat's size) each
        assert float((torch.stack(columns) - own[gaussian]).abs().max() / own[gaussian].abs().max()) < 1e-6


def test_splats_that_are_looked_at_together_change_no_bit(monkeypatch) -> None:
    objective = objective_of(awkward_gaussians(), WITH_SSIM[0], noise=0.3)
    whole = objective.block_diagonal().geometry
    monkeypatch.setattr("splat.render.cpu.raster.FOOTPRINT_BYTES", 1)
    assert torch.equal(objective.block_diagonal().geometry, whole)


def test_traces_of_exact_blocks_are_within_the_error_of_sampled_ones() -> None:
    objective = objective_of(awkward_gaussians(), WITH_SSIM[0], noise=0.05)
    sampled = exact_traces(objective, torch.Generator().manual_seed(0), samples=64)
    exact = objective.block_diagonal().traces(objective.active.quats)
    approximate = objective.block_diagonal(approximate=True).traces(objective.active.quats)
    for name, estimate in sampled.items():
        assert abs(exact[name] - estimate.value) < 4 * estimate.standard_error
    assert any(abs(approximate[name] - found.value) > 4 * found.standard_error for name, found in sampled.items())


def test_memory_decides_which_views_are_kept_and_changes_no_bit(monkeypatch) -> None:
    gaussians, loss, widths, hvp = awkward_gaussians(), LossSettings(), [], LinearizedView.hvp
    monkeypatch.setattr(
        LinearizedView, "hvp", lambda view, U, *total, **how: widths.append(U.shape[1]) or hvp(view, U, *total, **how)
    )
    roomy = objective_of(gaussians, loss, noise=0.3)
    tight = SceneObjective(gaussians, roomy.views, loss, BACKGROUND, memory=0)
    assert (tight.linearized.kept, roomy.linearized.kept) == (1, 2)
    V = random_like((SceneHessian(roomy).dim, VECTORS + 3), 0)
    assert torch.equal(SceneHessian(roomy).apply(V), SceneHessian(tight).apply(V))
    assert widths == [VECTORS, 3] * 4  # of two views, each time


def test_under_l1_alone_the_appearance_has_no_curvature() -> None:
    own = objective_of(awkward_gaussians(), PIXEL_SUMS[0], noise=0.3).block_diagonal()
    assert own.traces()["sh"] == 0


def test_traces_leave_the_radial_directions_of_the_quaternions_out() -> None:
    objective = objective_of(awkward_gaussians(), PIXEL_SUMS[2], noise=0.3)
    H = dense(SceneHessian(objective))  # projected
    expected = float(H.diagonal()[objective.blocks["quats"]].sum())
    assert objective.block_diagonal().traces(objective.active.quats)["quats"] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("kind", ["l1", "charbonnier", "l2"])
def test_the_pixel_diagonal_of_the_loss_is_that_of_its_dense_hessian(kind) -> None:
    target, generator = torch.rand(3, 9, 13, dtype=torch.float64), torch.Generator().manual_seed(0)
    image = target + 0.1 * torch.randn(3, 9, 13, generator=generator, dtype=torch.float64)
    loss = CpuViewLoss(target, LossSettings(kind), torch.float64)
    linear = loss.linearize(loss.padded(image))
    units = torch.eye(image.numel(), dtype=torch.float64).view(-1, 3, 9, 13)
    columns = [loss.cropped(linear.hvp(loss.padded(unit)[None])[0]).reshape(-1) for unit in units]
    expected = torch.stack(columns).diagonal()
    got = loss.cropped(linear.diagonal).reshape(-1)
    assert float((got - expected).norm() / expected.norm()) < 1e-12


def units_of(objective: SceneObjective) -> Tensor:
    """Of every row its own, above 0."""
    return random_like(tuple(objective.active.flat.shape), 9).to(objective.active.flat).exp()


@pytest.mark.parametrize("loss", PIXEL_SUMS[1:], ids=lambda loss: loss.pixel)
@pytest.mark.parametrize("gauss_newton", [False, True])
@pytest.mark.parametrize("scaled", [False, True])
def test_traces_of_sums_over_pixels_are_exact(loss: LossSettings, gauss_newton: bool, scaled: bool) -> None:
    objective = objective_of(awkward_gaussians(), loss, noise=0.1)
    H, scale = dense(SceneHessian(objective, gauss_newton=gauss_newton)), units_of(objective) if scaled else None
    if scale is not None:
        H = scale[:, None] * H * scale
    found = exact_traces(objective, torch.Generator().manual_seed(0), gauss_newton=gauss_newton, scale=scale)
    for name, estimate in found.items():
        diagonal = H.diagonal()[objective.blocks[name]]
        assert estimate.reason == "exact" and estimate.standard_error == 0
        assert abs(estimate.value - float(diagonal.sum())) <= 1e-9 * float(diagonal.abs().sum())


@pytest.mark.parametrize(
    ("noise", "gauss_newton", "scaled"),
    [(0.02, False, False), (0.5, False, False), (0.5, False, True), (0.5, True, False), (0.02, True, True)],
    ids=["near a fit", "far from a fit", "in units", "Gauss-Newton", "Gauss-Newton, in units"],
)
def test_traces_with_ssim_are_within_their_errors_over_many_seeds(noise: float, gauss_newton: bool, scaled: bool):
    objective = objective_of(random_gaussians(20, sh_degree=1, seed=7), LossSettings(), noise, size=(24, 20))
    scale = units_of(objective) if scaled else None
    diagonal = dense(SceneHessian(objective, gauss_newton=gauss_newton)).diagonal()
    diagonal = diagonal if scale is None else diagonal * scale.square()
    seeds, settings = 60, TraceSettings.fixed(12)
    scores = {name: [] for name in objective.blocks}
    for seed in range(seeds):
        generator = torch.Generator().manual_seed(seed)
        found = exact_traces(objective, generator, settings, gauss_newton=gauss_newton, scale=scale)
        for name, estimate in found.items():
            truth = float(diagonal[objective.blocks[name]].sum())
            scores[name].append((estimate.value - truth) / estimate.standard_error)
    for name, values in scores.items():
        z = torch.tensor(values)
        # Student's t with 11 degrees of freedom has variance 11 / 9; the mean of 60 is then known to sqrt(11 / 9 / 60)
        assert abs(float(z.mean())) < 4 * sqrt(11 / 9 / seeds), name
        assert float(z.square().mean()) < 3, name


def samples_of(
    objective: SceneObjective, generator: torch.Generator, names: list[str], count: int
) -> tuple[Tensor, Tensor]:
    x, y = coupling_samples(objective, generator, partial(_signs, objective, None), names, count)
    return x.mean(dim=0), y.mean(dim=0)


@pytest.mark.parametrize("noise", [0.02, 0.5], ids=["near a fit", "far from a fit"])
def test_intervals_of_fixed_and_adaptive_budgets_cover_as_stated(noise: float) -> None:
    """95% intervals: 200 runs of 95% stay within 89.5 to 99% with a probability of 0.9986 (four blocks in a hundred fail)."""
    objective = objective_of(random_gaussians(20, sh_degree=1, seed=7), LossSettings(), noise, size=(24, 20))
    H, names = dense(SceneHessian(objective)), list(objective.blocks)
    truth = {name: float(H.diagonal()[rows].sum()) for name, rows in objective.blocks.items()}
    quats, generator = objective.active.quats, torch.Generator().manual_seed(0)
    known, pixelwise = (
        objective.block_diagonal(gauss_newton=part, approximate=True).traces(quats) for part in (False, True)
    )
    draws = [torch.stack(samples_of(objective, generator, names, 100)) for _ in range(40)]
    pool = torch.stack(draws, dim=2).flatten(2)
    fixed, adaptive = TraceSettings.fixed(8), TraceSettings(rtol=0.05, max_probes=64)
    for settings, first, most in ((fixed, 8, 8), (adaptive, 8, 64), (adaptive, LEAST_SAMPLES, LEAST_SAMPLES)):
        for i, name in enumerate(names):
            covered, at = 0, 0
            for _ in range(200):
                block = SampledTrace(name, 0, known[name], pixelwise[name], settings, first, most)
                while block.open:
                    block.add(*pool[:, i, [at % pool.shape[2]]][:, None])
                    at += 1
                estimate = block.estimate()
                covered += estimate.low <= truth[name] <= estimate.high
            assert 0.895 <= covered / 200 <= 0.99, (name, settings, most, covered)


@pytest.mark.parametrize("fewest", [8, 12])
def test_a_run_may_end_at_its_fewest_samples_and_never_before(fewest: int) -> None:
    objective = objective_of(random_gaussians(20, sh_degree=1, seed=7), LossSettings(), noise=0.1)
    settings = TraceSettings(rtol=0.0, atol=1e9, min_probes=fewest)
    found = exact_traces(objective, torch.Generator().manual_seed(0), settings)
    assert {estimate.probes for estimate in found.values()} == {fewest}


def test_every_view_draws_signs_of_its_own() -> None:
    """The variance of a sum over two views that are alike is that of one view's doubled, not its fourfold."""
    objective = objective_of(random_gaussians(20, sh_degree=1, seed=7), LossSettings(), noise=0.1)
    alone = SceneObjective(objective.active, objective.views[:1], LossSettings())
    twice = SceneObjective(objective.active, objective.views[:1] * 2, LossSettings())
    names, draws = list(objective.blocks), 400
    spread = [samples_of(of, torch.Generator().manual_seed(0), names, draws)[0].var(dim=1) for of in (alone, twice)]
    # of a ratio of two sample variances of near-normal numbers: sqrt(4 / draws) each way, four of them
    assert all(abs(float(ratio) - 0.5) < 0.5 * 4 * sqrt(4 / draws) for ratio in spread[1] / spread[0])


def test_a_number_of_samples_that_is_asked_for_is_the_number_taken() -> None:
    objective = objective_of(random_gaussians(20, sh_degree=1, seed=7), LossSettings(), noise=0.1)
    rough = exact_traces(objective, torch.Generator().manual_seed(0), samples=5, names=["means", "sh"])
    assert {name: estimate.probes for name, estimate in rough.items()} == {"means": 5, "sh": 5}
    with pytest.raises(ValueError, match="at least 4 samples, got 3"):
        exact_traces(objective, torch.Generator(), samples=3)


def test_a_block_that_stops_early_does_not_change_the_samples_of_others() -> None:
    objective = objective_of(random_gaussians(20, sh_degree=1, seed=7), LossSettings(), noise=0.1)
    settings = TraceSettings(rtol=0.02, min_probes=8, max_probes=40)
    adaptive = exact_traces(objective, torch.Generator().manual_seed(0), settings)
    counts = {estimate.probes for estimate in adaptive.values()}
    assert min(counts) < max(counts)
    for count in counts:
        fixed = exact_traces(objective, torch.Generator().manual_seed(0), TraceSettings.fixed(count))
        for name, estimate in adaptive.items():
            if estimate.probes == count:
                assert estimate.value == fixed[name].value and estimate.standard_error == fixed[name].standard_error


def test_the_control_variate_is_unbiased_and_lowers_the_variance() -> None:
    generator, runs, count = torch.Generator().manual_seed(1), 4000, 12
    y = torch.randn(runs, count, generator=generator, dtype=torch.float64) + 3
    x = 2 * y + 0.1 * torch.randn(runs, count, generator=generator, dtype=torch.float64)
    means = torch.stack([controlled(a, b, 3.0).mean() for a, b in zip(x, y, strict=True)])
    assert abs(float(means.mean()) - 6) < 4 * float(means.std()) / sqrt(runs)
    assert float(means.std()) < 0.1 * float(x.mean(dim=1).std())
