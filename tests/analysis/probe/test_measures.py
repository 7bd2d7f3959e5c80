"""What --measures adds to a probe: the same as its functions give, in the record, the report and a sweep's table."""

import torch

from analysis.commands.cli import main
from analysis.measures.split_control import split_in_two
from analysis.probe.measures import measures, sharpness_of_adam
from analysis.records.records import ProbeRecord, read_record
from analysis.records.tables import columns_of, number_rows
from splat import open_subject
from splat.curvature.scores.field_sharpness import field_sharpness
from splat.training.state import Training
from tests.splat.curvature.scores.test_new_poses import DOUBLE, objective, poses, seeded
from tests.splat.tiny import EXTENT, ended, tiny_config, tiny_gaussians, tiny_views


def test_splitting_every_gaussian_in_two_changes_its_sharpness_by_less_than_the_error():
    whole = tiny_gaussians(dtype=DOUBLE)
    whole.opacity_logits.sub_(1.0)
    found, split = (
        field_sharpness(each, objective(each), poses(), 0.3, seeded(), draws=8) for each in (whole, split_in_two(whole))
    )
    for one, other in zip(found, split, strict=True):
        assert abs(other.value - one.value) < one.error < 0.5 * one.value


def test_the_update_of_critical_sharpness_lowers_the_loss_whatever_the_momentum_is():
    training, views = Training.start(tiny_gaussians(), EXTENT, tiny_config(4)), tiny_views()
    ended(training, views)
    objective = training.config.objective(training.gaussians, views)
    first = training.adam.first
    found = []
    for momentum in (first, first.with_flat(-100 * first.flat)):
        training.adam.first = momentum
        found.append(sharpness_of_adam(objective, training, seeded()))
    assert found[0] == found[1] and found[0]["critical_sharpness"].value > 0


def test_the_sharpness_of_adam_is_that_of_the_dense_hessian_at_the_stored_quaternions():
    training, views = Training.start(tiny_gaussians(dtype=DOUBLE), EXTENT, tiny_config(6)), tiny_views(DOUBLE)
    ended(training, views)
    training.gaussians.quats.mul_(1.7)
    objective = training.config.objective(training.gaussians, views)
    active, second = (each.select(objective.mask).flat for each in (training.gaussians, training.adam.second))
    at = [objective.linearizer(training.gaussians.select(objective.mask))(index) for index in range(3)]
    H = sum(view.hvp(torch.eye(len(active), dtype=DOUBLE)) for view in at) / 3
    gradient, updates = sum(view.gradient for view in at) / 3, training.adam.updates + 1
    v = (0.999 * second + 0.001 * gradient**2) / (1 - 0.999**updates)
    rates = training.gaussians.with_flat(training.rates(training.step)).select(objective.mask).flat
    D = torch.where(v > 0, (rates / (v.sqrt() + 1e-15)).sqrt(), 0.0)
    expected = float(torch.linalg.eigvalsh(D[:, None] * H * D)[-1])
    found = sharpness_of_adam(objective, training, seeded())["adam_sharpness"]
    assert abs(found.value - expected) <= found.error + 1e-9 * expected and found.error <= 0.01 * expected


def test_the_record_the_report_and_a_table_have_them(run, no_pictures, tmp_path):
    out = tmp_path / "probe"
    assert main(["probe", str(run), "--quick", "--measures", "--out", str(out)]) == 0
    data = read_record(out, ProbeRecord).data
    found = data.measures or {}
    subject = open_subject(run)
    assert found == measures(subject, subject.objective())
    names = ["order_fragility", "order_fragility_new", "field_sharpness", "field_sharpness_new"]
    assert list(found) == [*names, "critical_sharpness", "adam_sharpness", "open_curvature", "open_ratio"]
    assert all(value and value > 0 for value, _ in found.values())
    rows = number_rows(data)["Beyond derivatives at the training views"]
    assert len(rows) == 8 and "new poses" in rows[1][2]
    row = columns_of(found)
    single = {"open_ratio_error", "open_curvature_error"}  # one view was held out
    assert row.keys() == {*found, *(f"{name}_error" for name in found)} - single
    assert row["field_sharpness_error"] == found["field_sharpness"][1]


def test_without_held_out_views_and_moments_what_needs_them_is_absent_or_not_known(run):
    subject = open_subject(run / "double.pt")
    subject.checkpoint.scene.test.clear()
    assert subject.checkpoint.training.adam.updates == 0
    found = measures(subject, subject.objective())
    assert list(found) == ["order_fragility", "field_sharpness", "critical_sharpness", "adam_sharpness"]
    assert (
        found["critical_sharpness"] == found["adam_sharpness"] == (None, None)
        and (found["field_sharpness"][0] or 0) > 0
    )
