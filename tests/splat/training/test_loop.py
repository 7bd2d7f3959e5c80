"""The training loop: schedules, determinism, and what a saved training resumes to."""

from dataclasses import replace
from itertools import pairwise
from math import sqrt

import pytest
import torch

from landscape.errors import InputError
from splat.backend.cpu.adam import EPS
from splat.losses.reference import LossSettings
from splat.model.settings import RenderSettings
from splat.projection.antialias import sampling_widths
from splat.render.forward import background_of
from splat.render.loss_and_gradient import loss_and_gradient
from splat.render.render import render
from splat.scenes.scene import load_scene
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.view import Photograph, View
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint, save_checkpoint
from splat.training.densify import DensifySettings, densify
from splat.training.loop import prepare, train, with_background
from splat.training.score.evaluate import evaluate
from splat.training.state import LearningRates, TrainConfig, Training, learning_rates, position_rate
from tests.refusals import refused
from tests.splat.photometric import photometric_loss
from tests.splat.tiny import EXTENT, REFERENCE, ended, tiny_config, tiny_gaussians, tiny_views, trained

ONLY_ADAM = DensifySettings(enabled=False)


def test_mip_splattings_filter_is_renewed_when_its_training_does_and_resumes(monkeypatch, tmp_path):
    monkeypatch.setattr("splat.training.state.FILTER_EVERY", 2)
    config = replace(tiny_config(16), render=RenderSettings(antialias="mip-splatting", blur=0.1))
    views, saved = tiny_views(), tmp_path / "saved.pt"
    cameras = [view.camera for view in views]
    training = Training.start(tiny_gaussians(), EXTENT, config)
    prepare(training, views)
    widths, renewed = training.gaussians.filter_widths, []
    torch.testing.assert_close(widths, sampling_widths(training.gaussians, cameras))
    for done in train(training, views):
        now = training.gaussians.filter_widths
        assert now is not None and widths is not None
        if not torch.equal(now, widths):
            torch.testing.assert_close(now, sampling_widths(training.gaussians, cameras))
            renewed.append(done.step)
        widths = now
        if done.step == 9:
            save_checkpoint(saved, training, REFERENCE)
    assert renewed == [6, 8, 10, 12]  # clones and splits until 10, and once more between there and the end
    resumed = load_checkpoint(saved).training
    assert list(train(resumed, views)) and torch.equal(resumed.gaussians.flat, training.gaussians.flat)
    assert resumed.gaussians.filter_widths is not None and widths is not None
    assert torch.equal(resumed.gaussians.filter_widths, widths)


@pytest.mark.parametrize("loss", [LossSettings(), LossSettings(opacity_reg=0.3, scale_reg=0.5)], ids=["3DGS", "MCMC"])
def test_training_equals_a_plain_loop_with_torch_adam_over_all_bands(loss):
    config = TrainConfig(10, seed=3, sh_degree=1, sh_degree_every=4, densify=ONLY_ADAM, loss=loss)
    training = Training.start(tiny_gaussians(dtype=torch.float64), EXTENT, config)
    progress = list(train(training, tiny_views(torch.float64)))

    views = {view.name: view for view in tiny_views(torch.float64)}
    gaussians = tiny_gaussians(dtype=torch.float64).select(torch.arange(12), sh_degree=1)
    leaves = {name: value.clone().requires_grad_() for name, value in gaussians.attributes.items() if name != "sh"}
    constant, higher = (part.clone().requires_grad_() for part in gaussians.sh.split([1, 3], dim=1))
    rates = {"means": 0.0, "log_scales": 5e-3, "quats": 1e-3, "opacity_logits": 0.05}
    groups = [{"params": [leaves[name]], "lr": rate} for name, rate in rates.items()]
    groups += [{"params": [constant], "lr": 2.5e-3}, {"params": [higher], "lr": 1.25e-4}]
    adam = torch.optim.Adam(groups, eps=EPS)
    for done in progress:
        adam.param_groups[0]["lr"] = EXTENT * 1.6e-4 * 0.01 ** (done.step / 10)
        mask = 0.0 if done.step <= 4 else 1.0
        model = gaussians.pack({**leaves, "sh": torch.cat([constant, mask * higher], dim=1)})
        view = views[done.view]
        value = photometric_loss(render(model, view.camera).image, view.image, loss)
        value = value + loss.opacity_reg * leaves["opacity_logits"].sigmoid().mean()
        value = value + loss.scale_reg * leaves["log_scales"].exp().mean()
        adam.zero_grad()
        value.backward()
        adam.step()
        assert abs(done.loss - value.item()) < 1e-12
    expected = gaussians.pack({**leaves, "sh": torch.cat([constant, higher], dim=1)}).flat
    assert training.gaussians.sh_degree == 1
    assert (training.gaussians.flat - expected).abs().max() < 1e-12


def test_pictures_and_losses_that_do_not_fit_are_made_anew_and_change_nothing(monkeypatch, tmp_path):
    made = synthetic_scene(SyntheticSettings(gaussians=50, views=4, width=16, height=12))
    write_transforms_scene(made.scene, tmp_path / "scene")
    loaded, found = load_scene(tmp_path / "scene"), []
    for memory in (1 << 40, 4 * 6 * 16 * 12 * 4, 0):
        for module in ("splat.scenes.scene", "splat.training.state"):
            monkeypatch.setattr(f"{module}.free_memory", lambda device, memory=memory: memory)
        views = loaded.load()
        assert isinstance(views[0], Photograph) == (memory < 1 << 40)
        training = Training.start(made.truth, EXTENT, TrainConfig(6))
        assert len(list(train(training, views))) == 6
        found.append(training.gaussians.flat)
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


def test_the_position_rate_is_held_for_its_first_steps_and_decays_exponentially_to_its_final_value():
    for hold, held in ((0, [0]), (100, [1, 50, 100])):
        rates = LearningRates(position_hold=hold)
        assert [position_rate(rates, 3.0, at, 700) for at in held] == pytest.approx([3 * 1.6e-4] * len(held), rel=1e-14)
        middle = sqrt(rates.position * rates.position_final)
        assert position_rate(rates, 1.0, (hold + 700) // 2, 700) == pytest.approx(middle, rel=1e-14)
        assert position_rate(rates, 3.0, 700, 700) == pytest.approx(3.0 * rates.position_final, rel=1e-14)
    assert position_rate(LearningRates(position_hold=900), 1.0, 700, 700) == rates.position


def test_a_clamped_image_has_no_gradient_where_it_is_outside():
    views, gaussians = tiny_views(torch.float64), tiny_gaussians(dtype=torch.float64)
    gaussians.sh[:, 0] += 3.0  # too bright
    camera, background = views[0].camera, torch.zeros(3, dtype=torch.float64)
    flat = gaussians.flat.clone().requires_grad_()
    image = render(gaussians.with_flat(flat), camera, background, backend="reference").image
    assert 0 < (image > 1).sum() < image.numel()
    expected = photometric_loss(image.clamp(0, 1), views[0].image)
    (gradient,) = torch.autograd.grad(expected, flat)
    for clamp in (True, False):
        loss = TrainConfig(clamp_image=clamp).loss_against(views[0].image, gaussians.flat)
        got = loss_and_gradient(gaussians, camera, loss, background)
        same = abs(got.loss - expected.item()) < 1e-10, (got.gradient - gradient).norm() < 1e-8 * gradient.norm()
        assert same == (clamp, clamp)


def test_every_parameter_has_the_rate_of_its_attribute_and_band():
    gaussians = tiny_gaussians(sh_degree=3)
    rates = LearningRates(log_scales=1.0, quats=2.0, opacity_logits=3.0, sh_constant=4.0, sh_higher=5.0)
    each = gaussians.with_flat(learning_rates(gaussians, rates, 6.0)).attributes
    assert (each["means"] == 6).all() and (each["log_scales"] == 1).all() and (each["quats"] == 2).all()
    assert (each["opacity_logits"] == 3).all() and (each["sh"][:, 0] == 4).all() and (each["sh"][:, 1:] == 5).all()


def test_the_vector_of_rates_is_kept_until_the_gaussians_or_their_rates_are_others():
    training, kept = Training.start(tiny_gaussians(), EXTENT, tiny_config()), []
    for step in range(1, 6):
        training.raise_sh_degree(step // 3)
        config = training.config = replace(training.config, rates=LearningRates(quats=1e-3 * (step // 5 + 1)))
        rates = training.rates(step)
        position = position_rate(config.rates, EXTENT, step, config.iterations)
        assert torch.equal(rates, learning_rates(training.gaussians, config.rates, position))
        kept.append(rates)
    assert [one is other for one, other in pairwise(kept)] == [True, False, True, False]


def test_a_band_joins_after_every_so_many_steps_until_the_highest():
    config = TrainConfig(9, sh_degree=2, sh_degree_every=2, densify=ONLY_ADAM)
    training = Training.start(tiny_gaussians(), EXTENT, config)
    degrees = [training.gaussians.sh_degree for _ in train(training, tiny_views())]
    assert degrees == [0, 0, 1, 1, 2, 2, 2, 2, 2]


def test_every_epoch_shows_each_view_once_in_a_new_order():
    progress = list(train(Training.start(tiny_gaussians(), EXTENT, TrainConfig(30, densify=ONLY_ADAM)), tiny_views()))
    epochs = [tuple(done.view for done in progress[i : i + 3]) for i in range(0, 30, 3)]
    assert all(sorted(epoch) == ["view0", "view1", "view2"] for epoch in epochs)
    assert len(set(epochs)) > 1


def test_the_tiny_run_clones_splits_prunes_resets_and_raises_the_degree(monkeypatch):
    changes, highest_opacity = [], []
    cloned, split, removed = set(), set(), set()

    def recorded(gaussians, *arguments, **settings):
        changes.append(change := densify(gaussians, *arguments, **settings))
        kept, fresh = (set(change.parents[chosen].tolist()) for chosen in (~change.fresh, change.fresh))
        cloned.update(kept & fresh)
        split.update(fresh - kept)
        removed.update(set(range(len(gaussians))) - kept - fresh)
        return change

    monkeypatch.setattr("splat.training.state.densify", recorded)
    training = Training.start(tiny_gaussians(), EXTENT, tiny_config())
    for done in train(training, tiny_views()):
        assert done.gaussians == len(training.gaussians)
        highest_opacity.append(training.gaussians.opacity_logits.sigmoid().max().item())
        moments = training.adam.second
        if changes and training.gaussians is changes[-1].gaussians and not training.screen_gradients.renders.any():
            assert not moments.select(changes[-1].fresh).flat.any()
        assert bool(moments.opacity_logits.any()) == (done.step != 5)
        assert moments.means.any()
    assert cloned and split and removed
    assert highest_opacity[4] <= 0.010001 < highest_opacity[3]
    assert training.gaussians.sh_degree == 2


@pytest.mark.parametrize(("blue", "drawn", "resets"), [(1.0, False, [3, 5]), (1.0, True, [5]), (0.9, False, [5])])
def test_on_white_opacities_are_also_reset_before_density_control(blue, drawn, resets):
    config = replace(tiny_config(), background=(1.0, 1.0, blue), random_background=drawn)
    training = Training.start(tiny_gaussians(), EXTENT, config)
    highest = [training.gaussians.opacity_logits.sigmoid().max().item() for _ in train(training, tiny_views())]
    lowered = [step for step, opacity in enumerate(highest, 1) if opacity <= 0.010001]
    assert lowered == resets  # the next update lifts some again


def test_a_training_saved_after_any_step_continues_to_the_same_bits_and_another_seed_to_others(tmp_path):
    training, kept = Training.start(tiny_gaussians(), EXTENT, tiny_config()), []
    for done in train(training, tiny_views()):
        kept.append(tmp_path / f"{done.step}.pt")
        save_checkpoint(kept[-1], training, REFERENCE)
    end = kept[-1].read_bytes()
    for path in kept[:-1]:
        save_checkpoint(path, ended(load_checkpoint(path).training), REFERENCE)
        assert path.read_bytes() == end
    save_checkpoint(path, trained(tiny_config()), REFERENCE)
    assert path.read_bytes() == end
    assert not torch.equal(trained(tiny_config(seed=1)).gaussians.flat, training.gaussians.flat)


def test_training_brings_the_views_closer():
    training = trained(TrainConfig(60, sh_degree=0, densify=ONLY_ADAM))
    before, after = (evaluate(gaussians, tiny_views()) for gaussians in (tiny_gaussians(), training.gaussians))
    assert after.psnr > before.psnr + 3 and after.ssim > before.ssim


def test_a_training_does_not_touch_the_gaussians_that_it_starts_from():
    start = tiny_gaussians()
    before = start.flat.clone()
    trained(TrainConfig(2), start)
    assert torch.equal(start.flat, before)


def test_random_backgrounds_show_through_views_as_through_renders():
    black, colour = torch.zeros(3), torch.tensor([0.2, 0.5, 0.9])
    truth, camera = tiny_gaussians(seed=1), tiny_views()[0].camera
    over_black, over_colour = render(truth, camera, black), render(truth, camera, colour)
    view = View("view", camera, over_black.image, over_black.alpha)
    torch.testing.assert_close(with_background(view, black, colour), over_colour.image, rtol=0, atol=1e-6)
    back = View("view", camera, over_colour.image, over_colour.alpha)
    torch.testing.assert_close(with_background(back, colour, black), over_black.image, rtol=0, atol=1e-6)
    opaque = tiny_views()[0]
    assert with_background(opaque, black, colour) is opaque.image


def test_a_random_background_is_drawn_anew_at_each_step(monkeypatch):
    colours = []

    def recorded(gaussians, background):
        colours.append(tuple(background.tolist()))
        return background_of(gaussians, background)

    monkeypatch.setattr("splat.render.loss_and_gradient.background_of", recorded)
    trained(TrainConfig(4, random_background=True))
    assert len(set(colours)) == 4
    colours.clear()
    trained(TrainConfig(4, background=(0.25, 0.5, 1.0)))
    assert set(colours) == {(0.25, 0.5, 1.0)}


def test_a_start_that_cannot_be_trained_is_refused():
    config = TrainConfig(1, sh_degree=1)
    refused("at least one Gaussian", Training.start, tiny_gaussians(0), EXTENT, config)
    refused("at most the training's SH degree 1, got 2", Training.start, tiny_gaussians(sh_degree=2), EXTENT, config)
    refused("extent", Training.start, tiny_gaussians(), 0.0, config)
    broken = tiny_gaussians()
    broken.quats[3, 1] = torch.nan
    refused(r"finite quats.*Gaussian 3", Training.start, broken, EXTENT, config)
    refused("at least one view", next, train(Training.start(tiny_gaussians(), EXTENT, config), []))


def test_a_training_that_loses_every_gaussian_says_so():
    nothing_stays = DensifySettings(every=1, start_share=0.1, reset_opacity=0.9999, min_opacity=0.9998)
    with pytest.raises(ValueError, match="every Gaussian became transparent or too large by step 2"):
        trained(replace(tiny_config(), densify=nothing_stays))


def test_a_loss_that_is_not_finite_names_the_step_and_the_view():
    views = tiny_views()
    for view in views:
        view.image[:] = torch.inf
    training = Training.start(tiny_gaussians(), EXTENT, TrainConfig(1, loss=LossSettings(ssim_weight=0.0)))
    refused(r"finite loss, got inf at step 1 on view view\d", next, train(training, views))


def test_a_gradient_that_is_not_finite_is_refused_before_it_is_used(monkeypatch):
    training, views = Training.start(tiny_gaussians(), EXTENT, tiny_config()), tiny_views()
    steps = train(training, views)
    next(steps)
    before = [each.flat.clone() for each in (training.gaussians, training.adam.first, training.adam.second)]

    def broken(_step, base):
        gradient = base.gradient.clone()
        gradient[5] = torch.nan
        return replace(base, gradient=gradient)

    monkeypatch.setattr(training.method, "gradient", broken)
    refused(r"finite gradient, got nan at step 2 on view view\d; lower the rates", next, steps)
    after = [each.flat for each in (training.gaussians, training.adam.first, training.adam.second)]
    assert all(map(torch.equal, after, before)) and training.step == training.adam.updates == 1


def test_gaussians_that_no_view_shows_are_left_alone():
    start, hidden = tiny_gaussians(), [2, 5]
    start.means[hidden, 2] = -3.0
    training = Training.start(start, EXTENT, TrainConfig(3, densify=ONLY_ADAM))
    assert len(list(train(training, tiny_views()))) == 3
    for name, value in training.gaussians.attributes.items():
        assert torch.equal(value[hidden], start.attributes[name][hidden]), name
    assert not torch.equal(training.gaussians.means, start.means)


def test_gaussians_nearer_than_the_near_plane_are_refused_before_a_step():
    gaussians, views = tiny_gaussians(), tiny_views()
    gaussians.means.mul_(1e-3)
    small = [replace(view, camera=replace(view.camera, centre=view.camera.centre * 1e-3)) for view in views]
    training = Training.start(gaussians, EXTENT, tiny_config(16))
    refused(r"got 12 that none of 3 views draws; up to [1-9]\d* lie nearer", prepare, training, small)
    gaussians.means.fill_(1e6)  # neither near nor in an image
    with pytest.raises(InputError, match=r"up to 0 lie nearer than the near plane at 0\.2"):
        prepare(Training.start(gaussians, EXTENT, tiny_config(16)), small)


def test_a_gradient_of_0_ends_a_training_after_a_look_at_each_view():
    gaussians, views = tiny_gaussians(), tiny_views()
    gaussians.opacity_logits.fill_(-20.0)  # in sight, below what is drawn
    with pytest.raises(InputError, match=f"exactly 0 in the first {len(views)} steps"):
        list(train(Training.start(gaussians, EXTENT, tiny_config(16)), views))


def test_gaussians_that_density_control_cannot_use_or_makes_end_a_training_with_a_sentence():
    training = Training.start(tiny_gaussians(), EXTENT, tiny_config(16))
    settings, gradients = DensifySettings(), torch.ones(len(training.gaussians))
    training.gaussians.log_scales.fill_(100.0)  # finite, but not the places that are drawn from them
    change = densify(training.gaussians, gradients, EXTENT, settings, training.generator, prune_large=False)
    refused("expected finite means, got", training.replace_gaussians, change)
    far, view = Training.start(tiny_gaussians(), EXTENT, tiny_config(16)), tiny_views()[0]
    loss = far.config.loss_against(view.image, far.gaussians.flat)
    base = loss_and_gradient(far.gaussians, view.camera, loss, torch.zeros(3))
    far.gaussians.means[0] = float("inf")
    schedule = far.config.densify
    step = next(n for n in range(1, 16) if schedule.densifies(n, 16))
    refused(r"expected finite means, got .*inf", far.control_density, step, view.camera, base)
