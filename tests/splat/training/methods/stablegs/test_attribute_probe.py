"""Attribute-space probes: every formula against a second derivation."""

from collections.abc import Mapping
from dataclasses import replace
from math import inf, nan

import kornia
import numpy as np
import pytest
import torch
from kornia.geometry.conversions import axis_angle_to_quaternion, quaternion_to_rotation_matrix
from kornia.geometry.quaternion import Quaternion
from scipy.stats import kstest

from splat.model.gaussians import ATTRIBUTES, Gaussians
from splat.projection.reference import project, rotation_matrices
from splat.training.methods.stablegs.attribute_probe import (
    Caps,
    Constants,
    Magnitude,
    Probed,
    ProbeSettings,
    draw_seeds,
    draw_steps,
    exponential,
    hamilton,
    magnitudes,
    probe_attributes,
)
from tests.oracles import splat_of_gaussian
from tests.splat.random_scenes import random_camera, random_gaussians, random_like

DEFAULTS = ProbeSettings()
EXTENT = 3.0
TRACES = {"means": 5.0, "log_scales": 2.0, "quats": 7.0, "opacity_logits": 0.5, "sh": 11.0}
UNCAPPED = Caps(*[inf] * 5)
RHO = {"means": 0.2, "log_scales": 0.1, "quats": 0.4, "opacity_logits": 0.3, "sh": 0.07}
CAMERA = random_camera(seed=3)
ROUND_OFF = 1e-14  # a dozen operations in double precision on numbers near 1


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def magnitudes_of(rho: Mapping[str, float]) -> dict[str, Magnitude]:
    return {name: Magnitude(1.0, 1.0, value, value) for name, value in rho.items()}


def scene(n: int = 40, sh_degree: int = 2) -> tuple[Gaussians, torch.Tensor]:
    """Gaussians of all shapes, some behind the camera and off its image, and a gradient that is 0 where they are unseen."""
    gaussians = random_gaussians(n, sh_degree, spread=2.0)
    gaussians.log_scales[:, 0] -= 3
    gaussians.means[:5, 2] -= 20
    gradient = random_like(gaussians.flat.shape, 1)
    for value in gaussians.with_flat(gradient).attributes.values():
        value[:5] = 0
    return gaussians, gradient


def probe(
    gaussians: Gaussians,
    gradient: torch.Tensor,
    rho: Mapping[str, float] = RHO,
    settings: ProbeSettings = DEFAULTS,
    seed: int = 0,
    sign: float = 1.0,
) -> Probed:
    splats, draws = project(gaussians, CAMERA), draw_steps(gaussians, rho, draw_seeds(generator(seed)))
    return probe_attributes(gaussians, gradient, CAMERA, splats, magnitudes_of(rho), settings, draws, sign)


def step_of(probed: Probed, gaussians: Gaussians) -> Gaussians:
    """What was added to the stored parameters, to round-off."""
    return gaussians.with_flat(probed.gaussians.flat - gaussians.flat)


def probed_again(probed: Probed, base: Gaussians, gaussians: Gaussians) -> Gaussians:
    """The same step from other Gaussians (Eq. (14)), differentiable in them."""
    step = step_of(probed, base).attributes
    moved = {name: value + step[name] for name, value in gaussians.attributes.items()}
    return Gaussians.pack({**moved, "quats": hamilton(gaussians.quats, probed.turns)})


def test_rho_is_c_over_the_root_of_the_mean_curvature():
    settings = ProbeSettings(caps=UNCAPPED, c=Constants(0.01, 0.02, 0.03, 0.04, 0.05), dimension="active")
    found = magnitudes(TRACES, active=6, sh_degree=1, extent=EXTENT, settings=settings)
    sizes = {"means": 18, "log_scales": 18, "quats": 18, "opacity_logits": 6, "sh": 72}
    assert list(found) == list(ATTRIBUTES)
    for c, (name, magnitude) in zip((0.01, 0.02, 0.03, 0.04, 0.05), found.items()):
        spectrum = np.random.default_rng(0).uniform(0, 1, sizes[name])
        spectrum *= TRACES[name] / spectrum.sum()  # any eigenvalues with this sum
        assert magnitude.tau == pytest.approx(np.sqrt(spectrum.mean()), rel=1e-12)
        assert magnitude.rho == pytest.approx(c / (np.sqrt(spectrum.mean()) + 1e-6), rel=1e-12)
        assert magnitude.trace == TRACES[name] and not magnitude.capped and not magnitude.negative


def test_the_papers_dimension_makes_rho_smaller_by_the_root_of_n():
    wide = ProbeSettings(caps=UNCAPPED, eps=1e-30, dimension="active")
    ours = magnitudes(TRACES, 100, 2, EXTENT, wide)
    papers = magnitudes(TRACES, 100, 2, EXTENT, replace(wide, dimension="attribute"))
    for name in ATTRIBUTES:
        assert papers[name].rho * 10 == pytest.approx(ours[name].rho, rel=1e-12)


@pytest.mark.parametrize("trace", [0.0, -3.0])
def test_a_trace_that_is_not_positive_gives_the_cap_and_says_so(trace):
    caps = Caps(0.1, 0.2, 0.3, 0.4, 0.5)
    found = magnitudes(dict.fromkeys(ATTRIBUTES, trace), 6, 1, EXTENT, ProbeSettings(caps=caps, eps=1e-6))
    assert [m.rho for m in found.values()] == [0.1 * EXTENT, 0.2, 0.3, 0.4, 0.5]
    for magnitude in found.values():
        assert magnitude.uncapped == 0.01 / 1e-6 and magnitude.tau == 0
        assert magnitude.capped and magnitude.negative == (trace < 0) and magnitude.trace == trace


def test_the_position_probe_scales_with_the_world():
    """L(x) in units u times as small is L(x / u): its gradients shrink by u, its traces by u^2."""
    u, settings = 1000.0, ProbeSettings(eps=1e-30)
    for trace in (5.0, -5.0):
        here = magnitudes({"means": trace}, 6, 0, EXTENT, replace(settings, attributes=("means",)))["means"]
        there = magnitudes({"means": trace / u**2}, 6, 0, EXTENT * u, replace(settings, attributes=("means",)))["means"]
        assert there.rho == pytest.approx(u * here.rho, rel=1e-12)


def test_attributes_left_out_or_without_a_weight_need_no_trace():
    settings = ProbeSettings(attributes=("quats", "sh"), c=Constants(sh=0))
    assert settings.on == ("quats",)
    assert list(magnitudes({"quats": 1.0}, 6, 1, EXTENT, settings)) == ["quats"]


@pytest.mark.parametrize("gamma", [0.7, 0.5, 1.0])
def test_the_position_probe_is_the_tilted_gradient_of_length_rho(gamma):
    """In a frame along the ray, Eqs. (7), (8) weigh coordinates: diag(1 - gamma, 1 - gamma, gamma)."""
    gaussians, gradient = scene()
    step = step_of(probe(gaussians, gradient, settings=ProbeSettings(gamma=gamma)), gaussians).means
    for mean, g, got in zip(gaussians.means[5:], gaussians.with_flat(gradient).means[5:], step[5:], strict=True):
        ray = (mean - CAMERA.centre).numpy()
        frame, _ = np.linalg.qr(np.column_stack([ray, np.eye(3)[:, :2]]))  # its first axis lies along the ray
        weighed = frame @ np.diag([gamma, 1 - gamma, 1 - gamma]) @ frame.T @ g.numpy()
        assert np.allclose(got, RHO["means"] * weighed / np.linalg.norm(weighed), rtol=0, atol=ROUND_OFF)
    assert not step[:5].any()


def test_gradients_of_any_size_give_probes_of_length_rho():
    gaussians, gradient = scene()
    single = gaussians.to(torch.float32)
    for size in (1e-37, 1e-20, 1e30):
        step = step_of(probe(single, (gradient * size).float()), single).means[5:]
        # means of up to 16 in single precision: 1e-6 in each coordinate
        assert torch.allclose(step.norm(dim=1), torch.tensor(RHO["means"]), rtol=0, atol=2e-6)
    for size in (1e-160, 1e-170, 1e-300):  # whose squares underflow in double precision
        step = step_of(probe(gaussians, gradient * size), gaussians).means
        assert (step.norm(dim=1) < RHO["means"] + ROUND_OFF).all()


def test_quaternions_turn_by_the_exponential_map_of_rotations():
    omega = random_like((50, 3), 0) * torch.logspace(-9, 1, 50, dtype=torch.float64)[:, None]
    assert torch.allclose(exponential(omega), axis_angle_to_quaternion(omega), rtol=0, atol=ROUND_OFF)
    still = exponential(torch.zeros(1, 3, dtype=torch.float64))
    assert still.tolist() == [[1, 0, 0, 0]]
    skew = kornia.geometry.vector_to_skew_symmetric_matrix(omega)
    assert torch.allclose(rotation_matrices(exponential(omega)), torch.linalg.matrix_exp(skew), atol=1e-12)


def test_the_product_of_quaternions_is_hamiltons_in_the_gaussians_frame():
    p, q = random_like((50, 4), 0), random_like((50, 4), 1)
    product = hamilton(p, q)
    # entries up to 20
    assert torch.allclose(product, (Quaternion(p) * Quaternion(q)).data, rtol=0, atol=20 * ROUND_OFF)
    both = quaternion_to_rotation_matrix(p) @ quaternion_to_rotation_matrix(q)
    assert torch.allclose(rotation_matrices(product), both, rtol=0, atol=ROUND_OFF)


def test_quaternions_turn_about_the_gaussians_axes_and_keep_their_length():
    gaussians, gradient = scene()
    moved = probe(gaussians, gradient)
    omega = kornia.geometry.quaternion_to_axis_angle(moved.turns)
    after = moved.gaussians.quats
    expected = rotation_matrices(gaussians.quats) @ kornia.geometry.axis_angle_to_rotation_matrix(omega)
    assert torch.allclose(rotation_matrices(after), expected, rtol=0, atol=1e-12)
    assert torch.allclose(after.norm(dim=1), gaussians.quats.norm(dim=1), rtol=ROUND_OFF)
    assert float(omega.norm(dim=1).max()) > 0.1


def test_turns_grow_with_the_condition_number_of_the_splat():
    """With a tiny kappa_full the same draw turns by all of rho: the ratio is min((kappa - 1) / 100, 1)."""
    gaussians, gradient = scene(200)
    gaussians.log_scales[:, 0] += torch.linspace(-2, 8, 200, dtype=torch.float64)
    small = {"quats": 1e-3}  # so that every turn is far from half a turn, where omega folds
    full = probe(gaussians, gradient, small, ProbeSettings(kappa_full=1e-9)).turns
    turns = probe(gaussians, gradient, small).turns
    drawn, got = (kornia.geometry.quaternion_to_axis_angle(turn).numpy() for turn in (full, turns))
    pinhole, clamp = _pinhole()
    shares = []
    for i in range(5, len(gaussians)):
        mean, log_scale, quat, sh = (gaussians.attributes[k][i].numpy() for k in ("means", "log_scales", "quats", "sh"))
        centre, covariance, _, depth = splat_of_gaussian(
            mean, log_scale, quat, sh, CAMERA.rotation.numpy(), CAMERA.centre.numpy(), pinhole, clamp, 0.3
        )
        reach = 3 * np.sqrt(np.diag(covariance))
        size = np.array([CAMERA.width, CAMERA.height])
        visible = depth > 0.2 and (centre + reach > 0).all() and (centre - reach < size).all()
        shares.append(min((np.linalg.cond(covariance) - 1) / 100, 1) if visible else 0)
        assert np.allclose(got[i], shares[-1] * drawn[i], rtol=1e-11, atol=0)
    assert min(shares) == 0 and max(shares) == 1 and sum(0 < share < 1 for share in shares) > 50
    assert not got[:5].any()


def _pinhole() -> tuple[tuple[float, float, float, float], tuple[float, float]]:
    clamp = 1.3 * CAMERA.width / (2 * CAMERA.fx), 1.3 * CAMERA.height / (2 * CAMERA.fy)
    return (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy), clamp


def test_random_probes_are_normal_with_the_deviation_of_their_band():
    """Kolmogorov and Smirnov's test at a level of 1e-3 for each of 5 samples; seeds are fixed."""
    gaussians, gradient = scene(2000, sh_degree=2)
    moved = probe(gaussians, gradient)
    full = probe(gaussians, gradient, {"quats": 0.1}, ProbeSettings(kappa_full=1e-9))
    omega = kornia.geometry.quaternion_to_axis_angle(full.turns)
    samples = {
        "scales": step_of(moved, gaussians).log_scales / RHO["log_scales"],
        "turns": omega[omega.any(dim=1)] / 0.1,
        **{
            f"band {l}": step_of(moved, gaussians).sh[:, l**2 : (l + 1) ** 2] / RHO["sh"] / (1 + l / 2)
            for l in range(3)
        },
    }
    for name, sample in samples.items():
        assert sample.numel() > 1000 and kstest(sample.flatten().numpy(), "norm").pvalue > 1e-3, name


def test_draws_of_axes_and_channels_are_independent():
    gaussians, gradient = scene(2000, sh_degree=1)
    moved = step_of(probe(gaussians, gradient), gaussians)
    for step in (moved.log_scales, moved.sh.flatten(1)):
        correlations = torch.corrcoef(step.T) - torch.eye(step.shape[1], dtype=torch.float64)
        assert correlations.abs().max() < 5 / 2000**0.5  # 5 standard errors, of at most 66 pairs


@pytest.mark.parametrize(("sh_degree", "weights"), [(0, [1]), (1, [1, 2]), (3, [1, 4 / 3, 5 / 3, 2])])
def test_the_highest_band_is_probed_twice_as_far_as_the_lowest(sh_degree, weights):
    gaussians, gradient = scene(3000, sh_degree)
    step = step_of(probe(gaussians, gradient, {"sh": RHO["sh"]}), gaussians).sh
    for l, weight in enumerate(weights):
        band = step[:, l**2 : (l + 1) ** 2] / RHO["sh"]
        assert float(band.std()) == pytest.approx(weight, rel=4 / (2 * band.numel()) ** 0.5)  # 4 standard errors


def test_opacities_step_uphill_by_rho_and_stay_where_the_gradient_is_zero():
    gaussians, gradient = scene()
    step = step_of(probe(gaussians, gradient), gaussians).opacity_logits
    g = gaussians.with_flat(gradient).opacity_logits
    assert torch.allclose(step[5:], RHO["opacity_logits"] * g[5:].sign(), rtol=0, atol=ROUND_OFF)
    assert g[5:].all() and not step[:5].any()


def test_what_the_view_does_not_show_keeps_its_place_turn_and_opacity():
    gaussians, gradient = scene()
    moved = probe(gaussians, gradient)
    unseen = moved.gaussians.select(torch.arange(5))
    before = gaussians.select(torch.arange(5))
    for name in ("means", "quats", "opacity_logits"):
        assert torch.equal(unseen.attributes[name], before.attributes[name])
    assert (unseen.log_scales != before.log_scales).all() and (unseen.sh != before.sh).all()


@pytest.mark.parametrize("name", ATTRIBUTES)
def test_an_axis_alone_is_probed_as_among_all_and_leaves_the_others(name):
    gaussians, gradient = scene()
    alone, together = (probe(gaussians, gradient, rho).gaussians for rho in ({name: RHO[name]}, RHO))
    for other in ATTRIBUTES:
        expected = together if other == name else gaussians
        assert torch.equal(alone.attributes[other], expected.attributes[other]), other
    assert not torch.equal(alone.attributes[name], gaussians.attributes[name])


def test_the_same_seed_gives_the_same_probe_and_another_one_another():
    gaussians, gradient = scene()
    one, again, other = (step_of(probe(gaussians, gradient, seed=seed), gaussians) for seed in (1, 1, 2))
    assert torch.equal(one.flat, again.flat) and not torch.equal(one.sh, other.sh)


def test_the_opposite_probe_steps_back_along_every_random_direction_and_on_along_the_gradient():
    gaussians, gradient = scene()
    there, back = (step_of(probe(gaussians, gradient, sign=sign), gaussians).attributes for sign in (1.0, -1.0))
    for name in ("log_scales", "sh"):
        assert torch.allclose(back[name], -there[name], rtol=0, atol=10 * ROUND_OFF) and there[name].any()
    for name in ("means", "opacity_logits"):
        assert torch.equal(back[name], there[name])
    turns, returns = (probe(gaussians, gradient, sign=sign).turns for sign in (1.0, -1.0))
    assert torch.equal(returns, turns * torch.tensor([1, -1, -1, -1])) and turns[:, 1:].any()


def test_a_quaternion_unit_is_two_radians():
    radian, quaternion = (
        magnitudes(TRACES, 6, 1, EXTENT, ProbeSettings(caps=UNCAPPED, rotation_unit=unit))
        for unit in ("radian", "quaternion")
    )
    assert quaternion.pop("quats").rho == 2 * radian.pop("quats").rho and quaternion == radian


@pytest.mark.parametrize("unit", ["radian", "quaternion"])
def test_an_equal_dose_is_an_equal_rise_of_a_quadratic_loss(unit):
    """z H z / 2 over random steps of rho, with any H of the trace; a turn by omega moves a unit quaternion by omega / 2."""
    settings = ProbeSettings(caps=UNCAPPED, eps=1e-30, rotation_unit=unit, c=Constants(0.01, 0.02, 0.03, 0.04, 0.05))
    dims = {"means": 3, "log_scales": 3, "quats": 3, "opacity_logits": 1, "sh": 12}
    own, equal = (magnitudes(TRACES, 6, 1, EXTENT, replace(settings, dose=dose)) for dose in ("constants", "equal"))
    rises = {}
    for dose, found in (("own", own), ("equal", equal)):
        lengths = {name: found[name].rho / (2 if name == "quats" else 1) for name in found}
        rises[dose] = np.array([lengths[name] ** 2 * TRACES[name] / 2 for name in lengths])
    assert np.allclose(rises["equal"], rises["own"].mean(), rtol=1e-12)
    turn = 1 if unit == "quaternion" else 0.5
    c = {"means": 0.01, "log_scales": 0.02, "quats": 0.03 * turn, "opacity_logits": 0.04, "sh": 0.05}
    assert np.allclose(rises["own"], [c[name] ** 2 * dims[name] / 2 for name in c], rtol=1e-12)
    two = ProbeSettings(caps=UNCAPPED, attributes=("means", "log_scales"), dose="equal")
    alike = magnitudes(TRACES, 6, 1, EXTENT, two)
    assert alike["means"].rho == pytest.approx(0.01 / (alike["means"].tau + 1e-6), rel=1e-12)  # equal already


def test_the_gradient_is_pulled_back_as_autograd_does():
    gaussians, gradient = scene()
    moved, weights = probe(gaussians, gradient), random_like(gaussians.flat.shape, 2)
    flat = gaussians.flat.clone().requires_grad_()
    after = probed_again(moved, gaussians, gaussians.with_flat(flat)).flat
    value = (weights * after).sum() + (after**3).sum() / 3
    (expected,) = torch.autograd.grad(value, flat)
    before = weights + after.detach() ** 2
    # quats: sums of terms up to 100
    assert torch.allclose(moved.pull(before), expected, rtol=1e-13, atol=100 * ROUND_OFF)


def test_the_step_is_a_constant():
    gaussians, gradient = scene()
    flat = gaussians.flat.clone().requires_grad_()
    alive = gaussians.with_flat(flat)
    moved = probe_attributes(
        alive, gradient, CAMERA, project(alive, CAMERA), magnitudes_of(RHO), DEFAULTS,
        draw_steps(alive, RHO, draw_seeds(generator())),
    )  # fmt: skip
    assert not moved.gaussians.flat.requires_grad and not moved.turns.requires_grad


def test_single_precision_in_single_precision_out():
    gaussians, gradient = scene()
    moved = probe(gaussians.to(torch.float32), gradient.float())
    assert moved.gaussians.flat.dtype == moved.turns.dtype == torch.float32


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda: ProbeSettings(attributes=("means", "means")), "each of the attributes once"),
        (lambda: magnitudes(TRACES, 0, 1, EXTENT), "at least 1 active"),
        (lambda: magnitudes(TRACES, 1, 1, inf), "finite extent"),
        (lambda: magnitudes({**TRACES, "sh": nan}, 1, 1, EXTENT), "finite trace of sh, got nan"),
        (lambda: magnitudes({"means": 1.0}, 1, 1, EXTENT), "finite trace of log_scales, got None"),
    ],
)
def test_settings_and_traces_that_mean_nothing_are_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        wrong()
