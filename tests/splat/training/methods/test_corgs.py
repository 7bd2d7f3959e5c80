"""CoR-GS: two fields on one loop, what each confirms of the other, and their agreement at pseudo-views."""

from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from splat.model.camera import Camera, capture_geometry
from splat.render.render import render
from splat.training.densify import DensifySettings
from splat.training.loop import train
from splat.training.methods import corgs
from splat.training.methods.corgs import CoRGS, CoRGSMethod, confirmed, pseudo_view
from splat.training.state import Step, TrainConfig, Training
from tests.refusals import refused
from tests.splat.photometric import photometric_loss
from tests.splat.random_scenes import random_camera
from tests.splat.tiny import EXTENT, a_step, both_of, tiny_config, tiny_gaussians, tiny_views

APART = CoRGS(prune_every=1000, prune_start=3, weight=0.0)
TOGETHER = CoRGS(prune_every=4, prune_start=3, distance=0.3, pseudo_start=5)


def trained(config: TrainConfig) -> tuple[Training, CoRGSMethod, list[int]]:
    training = Training.start(tiny_gaussians(), EXTENT, config)
    counts = [done.gaussians for done in train(training, tiny_views())]
    assert isinstance(training.method, CoRGSMethod)
    return training, training.method, counts


def step_of(settings: CoRGS, number: int) -> tuple[Step, Training]:
    """A step at which the partner is another scene."""
    step = a_step(settings, number, background=(0.2, 0.4, 0.1))
    assert isinstance(step.training.method, CoRGSMethod)
    partner = step.training.method.partner
    assert partner is not None
    partner.gaussians = tiny_gaussians(sh_degree=1, seed=3, dtype=torch.float64)
    return step, partner


def test_with_neither_term_the_first_field_is_that_of_3dgs():
    training, _, counts = trained(replace(tiny_config(), method=APART))
    plain = Training.start(tiny_gaussians(), EXTENT, tiny_config())
    assert counts == [done.gaussians for done in train(plain, tiny_views())]
    assert torch.equal(training.gaussians.flat, plain.gaussians.flat)


def test_a_state_whose_partner_is_no_training_is_refused():
    method = CoRGS().create(0)
    method.restore(method.state())
    refused("'partner' is no training", method.restore, {**method.state(), "partner": {"step": 1}})


def test_a_partner_that_was_restored_goes_on_where_the_first_field_is():
    training, method, _ = trained(replace(tiny_config(), method=TOGETHER))
    training.move(torch.device("meta"))
    method.on_start(training, tiny_views())
    partner = method.partner
    assert partner is not None
    flats = partner.gaussians.flat, partner.adam.first.flat, partner.adam.second.flat, partner.screen_gradients.total
    assert all(flat.device.type == "meta" for flat in flats)


def test_the_fields_are_the_same_until_each_draws_its_own_splits():
    training, method, _ = trained(replace(tiny_config(), method=APART, densify=DensifySettings(enabled=False)))
    assert method.partner is not None and method.partner.step == training.step
    assert torch.equal(method.partner.gaussians.flat, training.gaussians.flat)
    training, method, _ = trained(replace(tiny_config(), method=APART))
    assert method.partner is not None
    assert len(method.partner.gaussians) != 12  # it is densified too
    assert len(method.partner.gaussians) != len(training.gaussians) or not torch.equal(
        method.partner.gaussians.flat, training.gaussians.flat
    )


@pytest.mark.parametrize(("number", "weight"), [(5, 0.0), (6, 0.7)])
def test_each_field_descends_its_loss_and_its_disagreement_with_the_other(monkeypatch, number, weight):
    poses, descended = [], []
    posing = corgs.pseudo_view
    monkeypatch.setattr(corgs, "pseudo_view", lambda *a: poses.append(posing(*a)) or poses[-1])
    step, partner = step_of(CoRGS(pseudo_start=5, weight=0.7), number)
    monkeypatch.setattr(partner, "descend", lambda gradient, at: descended.append((gradient, at)))
    own = both_of(step)[1].gradient
    assert len(poses) == (weight > 0) and [at for _, at in descended] == [number]

    fields = step.gaussians, tiny_gaussians(sh_degree=1, seed=3, dtype=torch.float64)
    for got, field, other in [(own, *fields), (descended[0][0], *reversed(fields))]:
        flat = field.flat.detach().requires_grad_()
        mine = field.with_flat(flat)

        def image(these, camera):
            return render(these, camera, step.background, backend="reference").image

        total = photometric_loss(image(mine, step.camera), step.views[1].image)
        for pose in poses:
            total = total + weight * photometric_loss(image(mine, pose), image(other, pose).detach())
        (expected,) = torch.autograd.grad(total, flat)
        assert (got - expected).norm() < 1e-10 * expected.norm()


def test_a_gaussian_is_confirmed_by_the_nearest_one_of_the_other_field():
    one, other = tiny_gaussians(60, seed=1, dtype=torch.float64), tiny_gaussians(40, seed=2, dtype=torch.float64)
    nearest = torch.cdist(one.means, other.means).amin(dim=1)
    distance = nearest.median().item()
    assert torch.equal(confirmed(one, other, distance), nearest <= distance + 1e-12)
    assert 0 < confirmed(one, other, distance).sum() < 60


def test_both_fields_lose_what_the_other_did_not_confirm_before_the_change():
    step, partner = step_of(replace(TOGETHER, distance=0.35), number=8)
    one, other = step.training.gaussians, partner.gaussians
    apart = torch.cdist(one.means, other.means)
    stays = apart.amin(dim=1) <= 0.35, apart.amin(dim=0) <= 0.35
    assert all(0 < each.sum() < 12 for each in stays)
    step.training.method.after_step(step)
    assert torch.equal(step.training.gaussians.flat, one.select(stays[0]).flat)
    assert torch.equal(partner.gaussians.flat, other.select(stays[1]).flat)
    pruned, partner_pruned = (12 - int(each.sum()) for each in stays)
    assert step.training.method.history == [{"step": 8, "pruned": pruned, "partner_pruned": partner_pruned}]


def test_fields_are_pruned_at_every_so_many_steps_after_the_start():
    _, method, _ = trained(replace(tiny_config(), method=replace(TOGETHER, prune_every=3)))
    assert [row["step"] for row in method.history] == [6, 9, 12]
    assert any(row["pruned"] for row in method.history)


def test_fields_that_confirm_nothing_of_each_other_are_an_error():
    step, partner = step_of(replace(TOGETHER, distance=0.01), number=8)
    partner.gaussians.means[:] += 9
    refused(r"within 0.01 of each other, got none at step 8", step.training.method.after_step, step)


def test_a_pseudo_view_is_half_turned_to_the_nearest_camera_and_jittered():
    cameras = [random_camera(seed=seed) for seed in range(4)]
    centres = torch.stack([camera.centre for camera in cameras])
    nearest = torch.cdist(centres, centres).fill_diagonal_(torch.inf).argmin(dim=1).tolist()
    middles = []
    for camera, n in zip(cameras, nearest, strict=True):
        ends = Rotation.from_matrix(torch.stack([camera.rotation, cameras[n].rotation]).numpy())
        middles.append(torch.from_numpy(Slerp([0, 1], ends)(0.5).as_matrix()))
    generator = torch.Generator().manual_seed(0)
    offsets, seen = [], set()
    for _ in range(100):
        pose = pseudo_view(cameras, 0.01, generator)
        m = int(torch.cdist(pose.centre[None], centres).argmin())  # the jitter is far less than they are apart
        assert (pose.rotation - middles[m]).abs().max() < 1e-12
        offsets.append(pose.centre - centres[m])
        seen.add(m)
    assert seen == {0, 1, 2, 3}
    pooled = torch.cat(offsets) / (0.01 * capture_geometry(cameras).radius)
    assert abs(pooled.mean().item()) < 4 / len(pooled) ** 0.5
    assert abs(pooled.std().item() - 1) < 4 / (2 * len(pooled)) ** 0.5


def test_a_single_camera_keeps_its_pose():
    camera = random_camera()
    pose = pseudo_view([camera], 0.5, torch.Generator().manual_seed(0))
    assert isinstance(pose, Camera) and torch.equal(pose.centre, camera.centre)
    assert (pose.rotation - camera.rotation).abs().max() < 1e-15
