"""What a probe measures, against a dense Hessian of the same loss."""

import math

import numpy as np
import pytest
import torch

from analysis.measures.depth import STEPS, depth_split
from analysis.probe.record import paper_index
from analysis.records.tables import number_rows
from landscape import DenseOperator, EigenSettings, PowerSettings, extreme_eigenpairs, power_ends
from splat.curvature.hessian import SceneHessian

ATTRIBUTES = ["means", "log_scales", "quats", "opacity_logits", "sh"]


def rounding(H) -> float:
    """What the kernels' round-off may do to an entry: they agree with the reference to 1e-10 of the largest."""
    return 1e-10 * float(H.abs().max()) * len(H)


def test_traces_are_within_four_standard_errors_of_the_dense_hessian(record, dense):
    objective, H, _, _ = dense
    assert list(record.data.traces) == ATTRIBUTES
    for name, trace in record.data.traces.items():
        rows = objective.blocks[name]
        exact = float(H[rows, rows].trace())
        assert abs(trace.value - exact) <= 4 * trace.standard_error + rounding(H), name
        size = float(H[rows, rows].diagonal().abs().sum())
        assert trace.standard_error < 0.1 * size, name  # so that the line above says something
        each = {"means": 3, "log_scales": 3, "quats": 3, "opacity_logits": 1}
        seen = SceneHessian(objective).projector.seen.rank  # of colours
        assert trace.dim == (int(seen.sum()) if name == "sh" else len(objective.active) * each[name])
        assert trace.tau == math.sqrt(max(trace.value, 0) / trace.dim)
        samples = record.arrays["traces"][name]  # none of an exact trace
        assert not len(samples) or samples.mean() == pytest.approx(trace.value, rel=1e-12)


def test_eigenvalues_are_those_of_the_dense_hessian_within_their_residuals(record, dense):
    _, H, _, _ = dense
    true = torch.linalg.eigvalsh((H + H.T) / 2)
    for name, index in (("max", -1), ("second", -2), ("min", 0)):
        end = getattr(record.data.eigenvalues, name)
        assert abs(end.value - float(true[index])) <= end.residual + rounding(H), name
        assert end.residual <= 1e-3 * abs(end.value) and end.reason == "tolerance"
        assert sum(end.shares.values()) == pytest.approx(1) and list(end.shares) == ATTRIBUTES
    ratio = record.data.anisotropy.negative_ratio
    assert ratio.low <= float(-true[0] / true[-1]) <= ratio.high
    share = record.data.anisotropy.top_mass
    assert share.low <= float(true[-1] / true.abs().sum()) <= share.high


def test_the_eigenvalue_ratio_is_by_power_iteration_where_that_arrived(record, dense):
    _, H, _, _ = dense
    ends, eigenvalue_ratio = record.data.eigenvalues, record.data.anisotropy.eigenvalue_ratio
    true = torch.linalg.eigvalsh((H + H.T) / 2)
    assert eigenvalue_ratio.low <= float(true[-1] / true[0]) <= eigenvalue_ratio.high
    paper = ends.power_max.value / ends.power_min.value
    arrived = eigenvalue_ratio.low <= paper <= eigenvalue_ratio.high
    assert eigenvalue_ratio.value == (paper if arrived else ends.max.value / ends.min.value)
    assert ("did not arrive" in eigenvalue_ratio.note) == (not arrived)


@pytest.mark.parametrize(("steps", "says"), [(2, "by Lanczos"), (2000, "by power iteration")])
def test_a_power_iteration_that_did_not_arrive_gives_no_index(steps, says):
    operator, generator = DenseOperator(torch.diag(torch.linspace(-1, 3, 40, dtype=torch.float64))), torch.Generator()
    power = power_ends(operator, generator.manual_seed(0), PowerSettings(rtol=1e-9, max_matvecs=steps))
    index = paper_index(extreme_eigenpairs(operator, generator), power)
    assert index.value == pytest.approx(-3, rel=1e-2) and index.note.startswith(says)
    assert None not in (index.low, index.value, index.high) and index.low <= index.value <= index.high  # pyright: ignore[reportOptionalOperand, reportOperatorIssue]


def test_in_an_open_bracket_a_power_iteration_that_ran_out_did_not_arrive():
    operator, generator = (
        DenseOperator(torch.diag(torch.linspace(-1e-3, 3, 400, dtype=torch.float64))),
        torch.Generator(),
    )
    ends = extreme_eigenpairs(operator, generator.manual_seed(0), EigenSettings(max_matvecs=7))
    late, arrived = (power_ends(operator, generator, PowerSettings(0.1, atol=1e-2, max_matvecs=n)) for n in (2, 3000))
    index = paper_index(ends, late)
    assert index.high is None and index.note.startswith("by Lanczos: the paper's power iteration did not arrive")
    assert paper_index(ends, arrived).note.startswith("by power iteration")


def test_the_slice_has_true_losses_along_the_two_steepest_directions(record, dense):
    objective, H, value, _ = dense
    about, arrays = record.data.slice, record.arrays["slice"]
    assert arrays["loss"].shape == arrays["model"].shape == arrays["crossed"].shape == (5, 5)
    assert about.center_loss == pytest.approx(value, rel=1e-12)
    assert about.points == 25 and about.evaluated_points == arrays["evaluated"].sum() == about.evaluations - 1
    assert arrays["loss"][2, 2] == about.center_loss == arrays["model"][2, 2] and not arrays["crossed"][2, 2]
    values, vectors = torch.linalg.eigh((H + H.T) / 2)
    for axis, (name, index) in enumerate((("x", -1), ("y", -2))):
        unit = math.sqrt(2 * about.loss_scale / float(values[index]))
        assert about.directions[axis].unit == pytest.approx(unit, rel=1e-4)
        assert arrays[name] == pytest.approx(np.linspace(-3, 3, 5) * unit, rel=1e-4)
    assert about.loss_scale == pytest.approx(1e-3 * value)
    # a vector is known up to its sign and its error: the losses on the axis are those along the dense one
    for sign in (1, -1):
        along = [objective.loss(objective.active.flat + sign * x * vectors[:, -1]) for x in arrays["x"]]
        if along == pytest.approx(arrays["loss"][:, 2].tolist(), rel=1e-4):
            break
    else:
        pytest.fail(f"{along} are not {arrays['loss'][:, 2]}")


def test_the_eigenvectors_are_said_to_live_where_the_dense_ones_do(record, dense):
    objective, H, _, _ = dense
    vectors = torch.linalg.eigh((H + H.T) / 2).eigenvectors
    for name, index in (("max", -1), ("min", 0)):
        where = getattr(record.data.eigenvalues, name).lives_on
        v = objective.active.with_flat(vectors[:, index])
        mass = torch.stack([part.reshape(len(v), -1).square().sum(dim=1) for part in v.attributes.values()]).sum(dim=0)
        assert where.participation == pytest.approx(float(1 / mass.square().sum()), rel=1e-2)
        carrier = getattr(record.data.eigenvalues, name).carrier
        assert carrier.gaussian == int(objective.mask.nonzero()[mass.argmax(), 0])
        assert carrier.share == pytest.approx(float(mass.max()), rel=1e-2)


def test_positions_are_split_along_and_across_the_rays(record, dense):
    found, objective = record.data.depth, dense[0]
    split = depth_split(objective, torch.Generator().manual_seed(1))
    assert found.gradient_ratio == pytest.approx(split.gradient_ratio, rel=1e-6)
    assert found.gradient_median == pytest.approx(split.median_ratio, rel=1e-6)
    assert found.pairs == len(split.components) <= len(objective.active) * len(objective.views)
    depth, lateral = found.curvature["depth"], found.curvature["lateral"]
    whole = record.data.traces["means"]
    assert (depth.reason, lateral.reason) == ("exact", "exact")
    assert depth.value + lateral.value == pytest.approx(whole.value, rel=1e-9)
    assert found.curvature_ratio.value == pytest.approx(2 * depth.value / lateral.value, rel=1e-12)
    assert [row.pixels for row in found.rises] == list(STEPS)
    for row in found.rises:
        assert row.ratio == pytest.approx(row.depth / row.lateral, rel=1e-12)
        assert min(row.depth_error, row.lateral_error, row.ratio_error) > 0
        assert 0 <= row.depth_crossed <= 1
    names = {name for name, *_ in number_rows(record.data)["Positions along and across the rays"]}
    assert names >= {"depth gradient / lateral", "depth curvature / lateral"}
    assert names >= {f"depth / lateral rise, {step:g} px" for step in STEPS}
