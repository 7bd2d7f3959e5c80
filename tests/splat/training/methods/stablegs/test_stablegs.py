"""StableGS on the loop: its gradient against one autograd expression, and what it leaves out."""

from dataclasses import replace

import pytest
import torch

from landscape.errors import InputError
from splat.curvature.traces import exact_traces
from splat.render.render import render
from splat.training import state
from splat.training.densify import DensifySettings
from splat.training.loop import train
from splat.training.methods import agreement
from splat.training.methods.methods import METHODS
from splat.training.methods.stablegs import stablegs
from splat.training.methods.stablegs.attribute_probe import Caps, Constants, ProbeSettings
from splat.training.methods.stablegs.stablegs import StableGS
from splat.training.methods.stablegs.viewpoint_probe import ViewpointSettings
from splat.training.state import TrainConfig, Training
from tests.splat.photometric import photometric_loss
from tests.splat.random_scenes import random_like
from tests.splat.tiny import EXTENT, a_step, both_of, ended, tiny_config, tiny_gaussians, tiny_views, trained
from tests.splat.training.methods.stablegs.test_attribute_probe import probed_again

SMALL = Caps(0.01, 0.05, 0.05, 0.05, 0.05)  # so that no splat crosses another between the two derivatives
PROBE = ProbeSettings(caps=SMALL)


READINGS = [{}, {"asp_views": "all"}, {"viewpoints": "all", "vsp_gradient": "probed"}, {"viewpoints": "all"}]


@pytest.mark.parametrize("reading", [*READINGS, {"vsp_share": 0.9}])
def test_the_gradient_is_that_of_the_total_loss_with_constant_probes(monkeypatch, reading):
    settings = StableGS(warm_up=0, asp_weight=0.7, vsp_weight=0.3, probe=PROBE, **reading)
    step, probes, poses = a_step(settings, background=(0.2, 0.4, 0.1)), [], []
    probing, posing = stablegs.asp.probe_attributes, stablegs.composite_pose
    monkeypatch.setattr(stablegs.asp, "probe_attributes", lambda *a: probes.append(probing(*a)) or probes[-1])
    monkeypatch.setattr(stablegs, "composite_pose", lambda *a, **k: poses.append(posing(*a, **k)) or poses[-1])
    gradient = both_of(step)[1].gradient
    assert len(probes) == 1 and len(poses) == (3 if "viewpoints" in reading else 1)

    flat = step.gaussians.flat.detach().requires_grad_()
    gaussians = step.gaussians.with_flat(flat)
    probed = probed_again(probes[0], step.gaussians, gaussians)

    def image(these, camera):
        return render(these, camera, step.background, backend="reference").image

    def photographed(these, view):
        return photometric_loss(image(these, view.camera), view.image, step.config.loss)

    def agreement(pose):
        base = image(gaussians, pose)
        base = base.detach() if settings.vsp_gradient == "probed" else base
        return photometric_loss(base, image(probed, pose), step.config.loss)

    views = step.views if settings.asp_views == "all" else [step.views[1]]
    total = photographed(gaussians, step.views[1])
    total = total + 0.7 * sum(photographed(probed, view) for view in views) / len(views)
    total = total + 0.3 / settings.vsp_share * sum(agreement(pose) for pose in poses) / len(poses)
    (expected,) = torch.autograd.grad(total, flat)
    assert (gradient - expected).norm() < 1e-10 * expected.norm()


def test_nothing_is_probed_before_the_warm_up_is_over():
    runs = []
    for config in (tiny_config(), replace(tiny_config(), method=StableGS(warm_up=6, every=3, probe=PROBE))):
        training = Training.start(tiny_gaussians(), EXTENT, config)
        runs.append([training.gaussians.flat.clone() for _ in train(training, tiny_views())])
    assert sorted({row["step"] for row in training.method.history}) == [7, 10]
    same = [torch.equal(*pair) for pair in zip(*runs, strict=True)]
    assert same == [True] * 6 + [False] * 6


def test_a_probe_of_no_attribute_weighs_the_photometric_gradient_alone(monkeypatch):
    settings = StableGS(warm_up=0, probe=ProbeSettings(attributes=()), viewpoint=ViewpointSettings(edge_rotation=False))
    step = a_step(settings)
    base = step.loss_and_gradient(step.gaussians)
    for module, name in ((state, "loss_and_gradient"), (stablegs, "exact_traces"), (agreement, "ViewPass")):
        monkeypatch.setattr(module, name, None)  # would be worked out for nothing
    torch.testing.assert_close(step.training.method.gradient(step, base).gradient, 2 * base.gradient, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("weights", "renders"), [((1.0, 0.0), (1, 0)), ((0.0, 0.5), (0, 2)), ((0.0, 0.0), (0, 0)), ((1.0, 0.5), (1, 2))]
)
def test_a_loss_of_weight_0_is_not_rendered(monkeypatch, weights, renders):
    calls = {"loss_and_gradient": 0, "ViewPass": 0}

    def counted(name, function):
        def call(*arguments, **settings):
            calls[name] += 1
            return function(*arguments, **settings)

        return call

    for module, name in ((state, "loss_and_gradient"), (agreement, "ViewPass")):
        monkeypatch.setattr(module, name, counted(name, getattr(module, name)))
    asp, vsp = weights
    viewpoint = ViewpointSettings(edge_rotation=False)
    step = a_step(StableGS(warm_up=0, asp_weight=asp, vsp_weight=vsp, probe=PROBE, viewpoint=viewpoint))
    base, whole = both_of(step)
    calls["loss_and_gradient"] -= 1  # the base
    assert tuple(calls.values()) == renders
    assert torch.equal(whole.gradient, base.gradient) == (weights == (0.0, 0.0))


def test_a_viewpoint_that_sees_nothing_adds_nothing(monkeypatch):
    step = a_step(StableGS(warm_up=0, asp_weight=0.0, probe=PROBE))
    away = replace(step.camera, centre=torch.tensor([0.0, 0.0, 50.0], dtype=torch.float64))
    monkeypatch.setattr(stablegs, "composite_pose", lambda *_, **__: away)
    monkeypatch.setattr(agreement, "backend_of", None)
    base, whole = both_of(step)
    assert torch.equal(whole.gradient, base.gradient)


def test_viewpoints_that_see_nothing_are_counted_for_each_diagnosis(monkeypatch):
    config = replace(tiny_config(), method=StableGS(warm_up=3, every=4, viewpoints="all", probe=PROBE))
    posing = stablegs.composite_pose

    def away(cameras, m, *others, **settings):
        pose = posing(cameras, m, *others, **settings)
        return replace(pose, centre=pose.centre + 50 * pose.forward) if m else pose

    monkeypatch.setattr(stablegs, "composite_pose", away)
    notes = [row for row in trained(config).method.history if "note" in row]
    # two of three views, at the steps 4 to 7, 8 to 11, and 12
    note = "probed viewpoints without a Gaussian in sight, until the next diagnosis"
    assert notes == [{"step": step, "note": note, "count": count} for step, count in ((4, 8), (8, 8), (12, 2))]


def test_without_a_gaussian_in_sight_a_diagnosis_keeps_the_magnitudes():
    method = StableGS(warm_up=2, every=2, probe=PROBE)
    config = replace(tiny_config(iterations=8), method=method, densify=DensifySettings(enabled=False))
    training = Training.start(tiny_gaussians(), EXTENT, config)
    method, kept = training.method, []
    assert isinstance(method, stablegs.StableGSMethod)
    for done in train(training, tiny_views()):
        kept.append(dict(method.magnitudes))
        if done.step in (2, 4, 6):  # out of sight for the diagnoses of steps 3 and 7, in sight for that of step 5
            training.gaussians.means[:, 2] *= -1
    assert not any(kept[:4]) and kept[4] and all(magnitudes == kept[4] for magnitudes in kept[4:])
    found = {row["step"]: row.get("note", "") for row in method.history if "count" not in row}
    assert found == {step: "" if step == 5 else "no Gaussian in sight: magnitudes kept" for step in (3, 5, 7)}


def test_the_history_says_what_was_negative_and_what_was_capped():
    constants = Constants(means=1e-9, opacity_logits=0.0)
    step = a_step(StableGS(warm_up=0, probe=ProbeSettings(c=constants)))
    both_of(step)
    rows = {row["attribute"]: row for row in step.training.method.history}
    assert set(rows) == {"means", "log_scales", "quats", "sh"}
    for row in rows.values():
        assert row["step"] == 1 and row["standard_error"] > 0
        assert row["negative"] == (row["trace"] < 0)
        assert row["capped"] == (row["rho"] < row["uncapped"])
    assert not rows["means"]["capped"] and any(row["capped"] for row in rows.values())


def test_the_papers_samples_and_the_exact_traces_estimate_the_same():
    values = {}
    for traces in ("exact", "paper"):
        both_of(step := a_step(StableGS(warm_up=0, traces=traces)))
        values[traces] = {row["attribute"]: row for row in step.training.method.history}
    for name, exact in values["exact"].items():
        paper = values["paper"][name]
        assert paper["trace"] != exact["trace"]
        error = (paper["standard_error"] ** 2 + exact["standard_error"] ** 2) ** 0.5
        assert abs(paper["trace"] - exact["trace"]) < 5 * error  # ten samples: their standard error is itself rough


def contributions(settings: StableGS, draws: int) -> torch.Tensor:
    """What the method adds to the gradient of one view, (draws, p), after the diagnosis and a pair of probes."""
    step = a_step(settings)
    base, method = step.loss_and_gradient(step.gaussians), step.training.method
    later = replace(step, number=step.number + 1)
    found = [method.gradient(each, base).gradient - base.gradient for each in (step, *[later] * (draws + 1))]
    return torch.stack(found[2:])


def test_what_makes_it_cheaper_leaves_the_expectation_of_the_gradient():
    """The mean over draws along 20 fixed directions, within four standard errors of that without any of it."""
    plain = StableGS(warm_up=0, viewpoints="all", antithetic=False, probe=PROBE)
    directions = random_like((20, a_step(plain).gaussians.flat.numel()), 0).T
    directions /= directions.norm(dim=0)
    means, variances = {}, {}
    cheaper = {"one": {"viewpoints": "one"}, "antithetic": {"antithetic": True}, "share": {"vsp_share": 0.25}}
    for name, changed in {"plain": {}, **cheaper}.items():
        along = contributions(replace(plain, **changed), 100) @ directions
        pairs = (along[::2] + along[1::2]) / 2  # of opposite probes, independent of one another
        means[name], variances[name] = pairs.mean(dim=0), pairs.var(dim=0) / len(pairs)
    assert float((means["plain"].abs() / variances["plain"].sqrt()).max()) > 20  # so that a wrong weight would be seen
    for name in cheaper:
        error = (variances[name] + variances["plain"]).sqrt()
        assert ((means[name] - means["plain"]).abs() < 4 * error).all(), name


def test_two_steps_share_the_numbers_of_a_probe_with_opposite_signs(monkeypatch):
    step, seen, probing = a_step(StableGS(warm_up=0, probe=PROBE)), [], stablegs.asp.probe_attributes
    monkeypatch.setattr(stablegs.asp, "probe_attributes", lambda *a: seen.append(a[-2:]) or probing(*a))
    grown = step.gaussians.select(torch.arange(13) % 12)
    for gaussians in [step.gaussians] * 5 + [grown]:  # of another number the numbers are new
        both_of(replace(step, gaussians=gaussians))
    drawn, signs = zip(*seen, strict=True)
    assert list(signs) == [1, -1, 1, -1, 1, 1]
    assert drawn[0] is drawn[1] and drawn[2] is drawn[3]
    assert not torch.equal(drawn[0]["sh"], drawn[2]["sh"]) and len(drawn[5]["sh"]) == 13


def test_between_the_sampled_diagnoses_the_traces_follow_their_exact_part(monkeypatch):
    sampled, found = [], []
    exact, carried = stablegs.exact_traces, stablegs.carried_traces
    monkeypatch.setattr(stablegs, "exact_traces", lambda *a, **k: sampled.append(exact(*a, **k)) or sampled[-1])
    monkeypatch.setattr(stablegs, "carried_traces", lambda *a: found.append(carried(*a)) or found[-1])
    step = a_step(StableGS(warm_up=0, every=1, sampled_every=3, asp_weight=0.0, vsp_weight=0.1, probe=PROBE))
    for number in range(1, 8):
        both_of(replace(step, number=number))
    assert len(sampled) == 3 and len(found) == 4  # the first of every three
    for name, trace in found[0].items():
        # the Gaussians did not move: the same value and error, to round-off
        assert trace.value == pytest.approx(sampled[0][name].value, rel=1e-9)
        assert trace.standard_error == pytest.approx(sampled[0][name].standard_error, rel=1e-9) and trace.probes == 0
    rows = [row for row in step.training.method.history if row["attribute"] == "sh"]
    assert [row["samples"] > 0 for row in rows] == [True, False, False] * 2 + [True]


def rounds(config: TrainConfig) -> list[int]:
    """The steps that clone, split and prune."""
    schedule = config.method.density_control(config)
    return [step for step in range(1, config.iterations + 1) if schedule.densifies(step, config.iterations)]


@pytest.mark.parametrize("iterations", [60, 1000, 2000, 10_000, 30_000])
def test_every_method_has_the_density_control_of_3dgs_at_any_length(iterations):
    for settings in METHODS.values():
        config = TrainConfig(iterations, method=settings())
        scaled = config.method.scaled(config)
        assert scaled.densify == config.densify == DensifySettings() and rounds(scaled) == rounds(config)


def test_the_warm_up_is_scaled_to_the_length_unless_it_is_set_by_hand():
    lengths = 1, 2000, 10_000, 30_000
    configs = [TrainConfig(iterations, method=StableGS()) for iterations in lengths]
    assert [config.method.scaled(config).method for config in configs] == [
        StableGS(warm_up=warm_up) for warm_up in (0, 200, 1000, 3000)
    ]
    assert configs[1].method.scaled(configs[1], keep=("warm_up",)) == configs[1]


def test_densification_can_wait_for_the_end_of_the_warm_up(monkeypatch):
    config = TrainConfig(10_000, method=StableGS())
    after = replace(config, method=StableGS(densify_after_warm_up=True))
    assert rounds(after) == [step for step in rounds(config) if step > 1000]
    short = replace(tiny_config(), method=StableGS(warm_up=5, every=4, probe=PROBE, densify_after_warm_up=True))
    training, made = Training.start(tiny_gaussians(), EXTENT, short), []
    monkeypatch.setattr(training.method, "on_densify", lambda change: made.append(training.step + 1))
    ended(training)
    assert made == rounds(short) == [6, 8]


def test_a_training_in_which_it_never_acts_is_refused():
    training = Training.start(tiny_gaussians(), EXTENT, replace(tiny_config(), method=StableGS(warm_up=12)))
    with pytest.raises(InputError, match=r"got stablegs which never does in 12 steps \(warm_up = 12\); take more"):
        next(train(training, tiny_views()))
    assert training.step == 0


def test_rho_is_as_accurate_as_was_asked_for():
    config = TrainConfig(5, method=StableGS(warm_up=0))
    objective = config.objective(tiny_gaussians(seed=1), tiny_views())
    truth = exact_traces(objective, torch.Generator().manual_seed(99), samples=1000)
    errors = []
    for seed in range(20):
        method = config.method.create(seed)
        assert isinstance(method, stablegs.StableGSMethod)
        for name, trace in method.traces(objective).items():
            assert trace.reason == "tolerance" and 8 <= trace.probes <= 64
            errors.append(abs((truth[name].value / trace.value) ** 0.5 - 1))
    assert sum(error > 0.05 for error in errors) <= 0.05 * len(errors)


def test_a_trace_that_is_surely_negative_needs_no_more_samples():
    config = TrainConfig(5, method=StableGS(warm_up=0))
    objective = config.objective(tiny_gaussians(seed=0), tiny_views())
    method = config.method.create(0)
    assert isinstance(method, stablegs.StableGSMethod)
    traces = method.traces(objective)
    assert traces["quats"].high < 0 and traces["quats"].probes == 8 < traces["log_scales"].probes
