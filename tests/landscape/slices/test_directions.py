import pytest
import torch

from landscape.slices.directions import gradient_direction, groups_of, line_between, orthonormal, random_directions
from landscape.slices.slices import SliceSettings, evaluate_slice
from tests.refusals import misused

BLOCKS = {"position": slice(0, 12), "weight": slice(12, 16)}
GROUPS = groups_of(BLOCKS, items=4, n=16)
CENTER = torch.linspace(-3, 4, 16, dtype=torch.float64)


def test_each_attribute_of_each_item_is_a_group():
    assert GROUPS.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 5, 6, 7]
    misused("blocks of 5 items, got 12 parameters in position", groups_of, BLOCKS, items=5, n=16)


def test_a_random_direction_is_as_long_in_every_group_as_its_parameters():
    d = random_directions(CENTER, GROUPS, torch.Generator().manual_seed(0), count=3)
    for group in range(8):
        rows = group == GROUPS
        expected = CENTER[rows].norm().expand(3)
        assert torch.allclose(d[rows].norm(dim=0), expected, rtol=1e-14, atol=0)


def test_a_random_direction_is_isotropic_within_a_group():
    # of unit vectors in three dimensions each coordinate has mean 0 and mean square 1/3, of variance 1/3 and 4/45
    count = 4000
    d = random_directions(torch.ones(3, dtype=torch.float64), torch.zeros(3, dtype=torch.int64),
                          torch.Generator().manual_seed(1), count) / 3**0.5  # fmt: skip
    assert (d.mean(dim=1).abs() < 4 * (1 / 3 / count) ** 0.5).all()
    assert ((d.square().mean(dim=1) - 1 / 3).abs() < 4 * (4 / 45 / count) ** 0.5).all()


def test_random_directions_scale_with_parameters_and_repeat_with_the_seed():
    one, two = (random_directions(scale * CENTER, GROUPS, torch.Generator().manual_seed(2)) for scale in (1, 10))
    assert torch.allclose(two, 10 * one, rtol=1e-14, atol=0)
    assert torch.equal(one, random_directions(CENTER, GROUPS, torch.Generator().manual_seed(2)))


def test_on_a_gpu_group_sums_do_not_depend_on_the_order_of_threads(monkeypatch):
    here = random_directions(CENTER, GROUPS, torch.Generator().manual_seed(0))
    monkeypatch.setattr(torch.Tensor, "is_cuda", property(lambda _tensor: True))
    monkeypatch.setattr(torch.Tensor, "index_add_", None)
    assert torch.allclose(random_directions(CENTER, GROUPS, torch.Generator().manual_seed(0)), here, rtol=1e-14, atol=0)


def test_a_group_of_zeros_does_not_move_and_numbers_may_be_left_out():
    center = torch.tensor([0.0, 0.0, 2.0])
    d = random_directions(center, torch.tensor([7, 7, 3]), torch.Generator().manual_seed(0))
    assert not d[:2].any() and torch.equal(d[2].abs(), torch.tensor([2.0, 2.0])) and d.dtype == torch.float32


def test_the_gradient_is_the_steepest_of_unit_directions():
    g = torch.linspace(-1, 2, 7, dtype=torch.float64)
    d = gradient_direction(g)
    assert d.shape == (7, 1) and float(d.norm()) == pytest.approx(1, abs=1e-15)
    assert float(g @ d[:, 0]) == pytest.approx(float(g.norm()), rel=1e-15)


def test_a_line_reaches_the_second_checkpoint_at_one():
    end, seen = CENTER.flip(0) + 1, []
    axis = torch.linspace(0, 1, 5, dtype=torch.float64)
    evaluate_slice(lambda theta: seen.append(theta) or 0.0, CENTER, line_between(CENTER, end), [axis],
                   settings=SliceSettings(tolerance=None))  # fmt: skip
    assert torch.equal(seen[1], CENTER) and torch.allclose(seen[5], end, rtol=0, atol=1e-14)


def test_orthonormal_directions_span_the_same_plane_and_keep_the_first():
    d = torch.stack([CENTER, CENTER.square()], dim=1)
    q = orthonormal(d)
    assert torch.allclose(q.T @ q, torch.eye(2, dtype=torch.float64), rtol=0, atol=1e-15)
    assert torch.allclose(q[:, 0], CENTER / CENTER.norm(), rtol=0, atol=1e-15) and float(q[:, 1] @ d[:, 1]) > 0
    assert torch.allclose(q @ (q.T @ d), d, rtol=1e-14, atol=1e-14)


def test_bad_directions_are_refused():
    generator = torch.Generator().manual_seed(0)
    misused("one group number, from 0, for each of 16 parameters", random_directions, CENTER, GROUPS[:5], generator)
    misused("one group number", random_directions, CENTER, GROUPS - 1, generator)
    misused("not all zero", random_directions, 0 * CENTER, GROUPS, generator)
    misused("not zero", gradient_direction, torch.zeros(3))
    misused("same parameters, got \\(16,\\) and \\(15,\\)", line_between, CENTER, CENTER[:15])
    misused("that differ", line_between, CENTER, CENTER)
    misused("not parallel", orthonormal, torch.stack([CENTER, -2 * CENTER], dim=1))
    misused("not zero", orthonormal, torch.zeros(4, 2))
