"""StableGS on the loop: its gradient against one autograd expression, what it leaves out, and resuming."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from splat.losses.cpu.loss import ViewLoss
from splat.losses.reference import photometric_loss
from splat.render.loss_and_gradient import loss_and_gradient
from splat.render.render import render
from splat.training.checkpoint import load_checkpoint, save_checkpoint
from splat.training.densify import DensifySettings
from splat.training.loop import train
from splat.training.methods.stablegs import stablegs
from splat.training.methods.stablegs.attribute_probe import Caps, Constants, ProbeSettings
from splat.training.methods.stablegs.stablegs import StableGS
from splat.training.methods.stablegs.viewpoint_probe import ViewpointSettings
from splat.training.state import Step, TrainConfig, Training
from tests.splat.tiny import EXTENT, REFERENCE, tiny_config, tiny_gaussians, tiny_views
from tests.splat.training.methods.stablegs.test_attribute_probe import probed_again

SMALL = Caps(0.01, 0.05, 0.05, 0.05, 0.05)  # so that no splat crosses another between the two derivatives
PROBE = ProbeSettings(caps=SMALL)


def first_step(settings: StableGS, **others) -> Step:
    views = tiny_views(torch.float64)
    gaussians = tiny_gaussians(sh_degree=1, dtype=torch.float64)
    config = TrainConfig(5, method=settings, **others)
    training = Training.start(gaussians, EXTENT, config)
    training.regularizer.begin(training, views)
    background = config.background_colour(torch.float64)
    loss = ViewLoss.of(views[1].image, config.loss, torch.float64)
    return Step(settings.warm_up + 1, training, training.gaussians, views, 1, background, loss)


def base_of(step: Step):
    return loss_and_gradient(step.gaussians, step.camera, step.loss, step.background)


@pytest.mark.parametrize("viewpoints", ["one", "all"])
def test_the_gradient_is_that_of_the_total_loss_with_the_probes_held_constant(monkeypatch, viewpoints):
    settings = StableGS(warm_up=0, asp_weight=0.7, vsp_weight=0.3, viewpoints=viewpoints, probe=PROBE)
    step, probes, poses = first_step(settings, background=(0.2, 0.4, 0.1)), [], []
    probing, posing = stablegs.probe_attributes, stablegs.composite_pose
    monkeypatch.setattr(stablegs, "probe_attributes", lambda *a: probes.append(probing(*a)) or probes[-1])
    monkeypatch.setattr(stablegs, "composite_pose", lambda *a, **k: poses.append(posing(*a, **k)) or poses[-1])
    gradient = step.training.regularizer.gradient(step, base_of(step))
    assert len(probes) == 1 and len(poses) == {"one": 1, "all": 3}[viewpoints]

    flat = step.gaussians.flat.detach().requires_grad_()
    gaussians = step.gaussians.with_flat(flat)
    probed = probed_again(probes[0], step.gaussians, gaussians)

    def image(these, camera):
        return render(these, camera, step.background, backend="reference").image

    def agreement(pose):
        return photometric_loss(image(gaussians, pose), image(probed, pose), step.config.loss)

    target = step.views[1].image
    total = photometric_loss(image(gaussians, step.camera), target, step.config.loss)
    total = total + 0.7 * photometric_loss(image(probed, step.camera), target, step.config.loss)
    total = total + 0.3 * sum(agreement(pose) for pose in poses) / len(poses)
    (expected,) = torch.autograd.grad(total, flat)
    assert (gradient - expected).norm() < 1e-10 * expected.norm()


def test_nothing_is_probed_before_the_warm_up_is_over():
    method = StableGS(warm_up=6, every=3, probe=PROBE)
    runs = {}
    for name, config in {"3dgs": tiny_config(), "stablegs": replace(tiny_config(), method=method)}.items():
        training = Training.start(tiny_gaussians(), EXTENT, config)
        runs[name] = [training.gaussians.flat.clone() for _ in train(training, tiny_views())]
        if name == "stablegs":
            assert sorted({row["step"] for row in training.regularizer.history}) == [7, 10]
    same = [torch.equal(*pair) for pair in zip(runs["3dgs"], runs["stablegs"], strict=True)]
    assert same == [True] * 6 + [False] * 6


def test_a_probe_of_no_attribute_weighs_the_photometric_gradient_alone(monkeypatch):
    def never(*_, **__):
        raise AssertionError("was worked out for nothing")

    for name in ("loss_and_gradient", "exact_traces", "render"):
        monkeypatch.setattr(stablegs, name, never)
    settings = StableGS(warm_up=0, probe=ProbeSettings(attributes=()), viewpoint=ViewpointSettings(edge_rotation=False))
    step = first_step(settings)
    base = base_of(step)
    torch.testing.assert_close(step.training.regularizer.gradient(step, base), 2 * base.gradient, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("weights", "renders"), [((1.0, 0.0), (1, 0)), ((0.0, 0.5), (0, 6)), ((0.0, 0.0), (0, 0)), ((1.0, 0.5), (1, 6))]
)
def test_a_loss_of_weight_0_is_not_rendered(monkeypatch, weights, renders):
    calls = {"loss_and_gradient": 0, "render": 0}

    def counted(name, function):
        def call(*arguments, **settings):
            calls[name] += 1
            return function(*arguments, **settings)

        return call

    for name in calls:
        monkeypatch.setattr(stablegs, name, counted(name, getattr(stablegs, name)))
    asp, vsp = weights
    viewpoint = ViewpointSettings(edge_rotation=False)
    step = first_step(StableGS(warm_up=0, asp_weight=asp, vsp_weight=vsp, probe=PROBE, viewpoint=viewpoint))
    base = base_of(step)
    gradient = step.training.regularizer.gradient(step, base)
    assert tuple(calls.values()) == renders
    assert torch.equal(gradient, base.gradient) == (weights == (0.0, 0.0))


def test_a_viewpoint_that_sees_nothing_adds_nothing(monkeypatch):
    step = first_step(StableGS(warm_up=0, asp_weight=0.0, probe=PROBE))
    away = replace(step.camera, centre=torch.tensor([0.0, 0.0, 50.0], dtype=torch.float64))
    monkeypatch.setattr(stablegs, "composite_pose", lambda *_, **__: away)
    monkeypatch.setattr(stablegs, "consistency_loss", None)
    base = base_of(step)
    assert torch.equal(step.training.regularizer.gradient(step, base), base.gradient)


def test_a_viewpoint_that_sees_nothing_is_counted_in_the_history_until_the_next_diagnosis(monkeypatch):
    config = replace(tiny_config(), method=StableGS(warm_up=3, every=4, probe=PROBE))
    posing = stablegs.composite_pose

    def away(cameras, m, *others, **settings):
        pose = posing(cameras, m, *others, **settings)
        return replace(pose, centre=pose.centre + 50 * pose.forward) if m else pose

    monkeypatch.setattr(stablegs, "composite_pose", away)
    training = Training.start(tiny_gaussians(), EXTENT, config)
    for _ in train(training, tiny_views()):
        pass
    notes = [row for row in training.regularizer.history if "note" in row]
    # two of three views, at the steps 4 to 7, 8 to 11, and 12
    note = "probed viewpoints without a Gaussian in sight, until the next diagnosis"
    assert notes == [{"step": step, "note": note, "count": count} for step, count in ((4, 8), (8, 8), (12, 2))]


def looking_away(gaussians):
    """What the tiny views do not see; undone by a second call."""
    gaussians.means[:, 2] *= -1


def test_a_diagnosis_without_a_gaussian_in_sight_keeps_the_magnitudes_and_says_so():
    method = StableGS(warm_up=2, every=2, probe=PROBE)
    config = replace(tiny_config(iterations=8), method=method, densify=DensifySettings(enabled=False))
    training = Training.start(tiny_gaussians(), EXTENT, config)
    regularizer, kept = training.regularizer, []
    assert isinstance(regularizer, stablegs.StableRegularizer)
    looking_away(training.gaussians)
    for done in train(training, tiny_views()):
        kept.append(dict(regularizer.magnitudes))
        if done.step in (4, 6):  # in sight for the steps 5 and 6, with the diagnosis of step 5
            looking_away(training.gaussians)
    assert not any(kept[:4]) and kept[4] and all(magnitudes == kept[4] for magnitudes in kept[4:])
    found = {row["step"]: row.get("note", "") for row in regularizer.history if "count" not in row}
    assert found == {step: "" if step == 5 else "no Gaussian in sight: magnitudes kept" for step in (3, 5, 7)}


def test_the_history_says_what_was_negative_and_what_was_capped():
    constants = Constants(means=1e-9, opacity_logits=0.0)
    step = first_step(StableGS(warm_up=0, probe=ProbeSettings(c=constants)))
    regularizer = step.training.regularizer
    regularizer.gradient(step, base_of(step))
    rows = {row["attribute"]: row for row in regularizer.history}
    assert set(rows) == {"means", "log_scales", "quats", "sh"}
    for row in rows.values():
        assert row["step"] == 1 and row["standard_error"] > 0
        assert row["negative"] == (row["trace"] < 0)
        assert row["capped"] == (row["rho"] < row["uncapped"])
    assert not rows["means"]["capped"] and any(row["capped"] for row in rows.values())


def test_the_papers_samples_and_the_exact_traces_estimate_the_same():
    values = {}
    for traces in ("exact", "paper"):
        step = first_step(StableGS(warm_up=0, traces=traces))
        step.training.regularizer.gradient(step, base_of(step))
        values[traces] = {row["attribute"]: row for row in step.training.regularizer.history}
    for name, exact in values["exact"].items():
        paper = values["paper"][name]
        assert paper["trace"] != exact["trace"]
        error = (paper["standard_error"] ** 2 + exact["standard_error"] ** 2) ** 0.5
        assert abs(paper["trace"] - exact["trace"]) < 5 * error  # ten samples: their standard error is itself rough


def test_a_stablegs_run_continues_from_a_checkpoint_to_the_same_bits(tmp_path: Path):
    config = replace(tiny_config(), method=StableGS(warm_up=3, every=4))
    whole = Training.start(tiny_gaussians(), EXTENT, config)
    for _ in train(whole, tiny_views()):
        pass
    part, path = Training.start(tiny_gaussians(), EXTENT, config), tmp_path / "checkpoint.pt"
    for done in train(part, tiny_views()):
        if done.step == 6:
            break
    save_checkpoint(path, part, REFERENCE)
    resumed = load_checkpoint(path).training
    assert resumed.config == config
    for _ in train(resumed, tiny_views()):
        pass
    assert torch.equal(resumed.gaussians.flat, whole.gaussians.flat)
    assert resumed.regularizer.history == whole.regularizer.history


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"warm_up": -1}, "warm_up >= 0"),
        ({"every": 0}, "every >= 1"),
        ({"asp_weight": -1.0}, "weights of at least 0"),
        ({"vsp_weight": float("nan")}, "weights of at least 0"),
        ({"traces": "guess"}, "'exact' or 'paper'"),
        ({"viewpoints": "some"}, "'all' or 'one'"),
    ],
)
def test_settings_of_stablegs_that_make_no_sense_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        StableGS(**settings)
