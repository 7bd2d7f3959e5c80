"""Five attributes over one flat vector."""

import pytest
import torch

from splat.model.gaussians import ATTRIBUTES, Gaussians, attribute_shapes, parameters_per_gaussian
from tests.refusals import refused
from tests.splat.random_scenes import random_gaussians, random_like


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_flat_vector_holds_the_attributes_one_after_the_other(degree):
    n, shapes = 7, attribute_shapes(7, degree)
    attributes = {name: random_like(shape, i) for i, (name, shape) in enumerate(shapes.items())}
    gaussians = Gaussians.pack(attributes)
    assert len(gaussians) == n and gaussians.sh_degree == degree
    assert gaussians.flat.numel() == n * parameters_per_gaussian(degree)
    assert torch.equal(gaussians.flat, torch.cat([attributes[name].reshape(-1) for name in ATTRIBUTES]))
    end = 0
    for name, block in gaussians.blocks.items():
        assert block.start == end and torch.equal(gaussians.flat[block], attributes[name].reshape(-1))
        assert torch.equal(getattr(gaussians, name), attributes[name])
        end = block.stop
    assert end == gaussians.flat.numel() and parameters_per_gaussian(3) == 59


def test_attributes_are_views_in_both_directions():
    gaussians = random_gaussians(4, 1)
    gaussians.opacity_logits[2] = 11.0
    assert gaussians.flat[gaussians.blocks["opacity_logits"]][2] == 11.0
    gaussians.flat[gaussians.blocks["sh"].start] = -5.0
    assert gaussians.sh[0, 0, 0] == -5.0
    for value in gaussians.attributes.values():
        assert value.untyped_storage().data_ptr() == gaussians.flat.untyped_storage().data_ptr()


def test_gradients_pass_through_to_the_flat_vector():
    flat = random_gaussians(3, 1).flat.requires_grad_()
    gaussians = Gaussians(flat, 1)
    (gradient,) = torch.autograd.grad(gaussians.quats.sum() + 2 * gaussians.sh.sum(), flat)
    expected = Gaussians(torch.zeros_like(gradient), 1)
    expected.quats[:] = 1
    expected.sh[:] = 2
    assert torch.equal(gradient, expected.flat)


def test_selection_takes_repeats_and_masks_and_cuts_or_pads_bands():
    gaussians = random_gaussians(5, 2)
    twice = gaussians.select(torch.tensor([3, 3, 0]))
    assert torch.equal(twice.means, gaussians.means[[3, 3, 0]]) and torch.equal(twice.sh, gaussians.sh[[3, 3, 0]])
    mask = torch.tensor([True, False, False, True, True])
    fewer, more = gaussians.select(mask, 1), gaussians.select(mask, 3)
    assert torch.equal(fewer.sh, gaussians.sh[mask][:, :4]) and fewer.sh_degree == 1
    assert torch.equal(more.sh[:, :9], gaussians.sh[mask]) and not more.sh[:, 9:].any() and more.sh_degree == 3
    fewer.means[0] = 0.0
    assert gaussians.means[0].all()  # a copy


def test_layouts_that_do_not_fit_are_refused():
    refused(r"expected a vector of n x 14 parameters at SH degree 0, got \(15,\)", Gaussians, torch.zeros(15), 0)
    refused("expected sh_degree 0, 1, 2 or 3, got 4", Gaussians, torch.zeros(86), 4)
    attributes = random_gaussians(5, 1).attributes
    with pytest.raises(ValueError, match=r"expected quats of shape \(5, 4\), got \(4, 4\)"):
        Gaussians.pack({**attributes, "quats": attributes["quats"][:4]})
    with pytest.raises(ValueError, match=r"expected sh of shape \(5, 4, 3\), got \(5, 5, 3\)"):
        Gaussians.pack({**attributes, "sh": torch.zeros(5, 5, 3)})


def test_vectors_that_do_not_hold_plain_numbers_in_a_row_are_refused():
    flat = random_gaussians(2, 1).flat
    wrong = (torch.nested.nested_tensor([flat]), flat.to_sparse())
    for other in wrong:
        refused("got a tensor that holds its numbers in another way", Gaussians, other, 1)
    for kind in (torch.float16, torch.bfloat16, torch.int64, torch.bool, torch.complex64):
        refused(f"expected Gaussians in float32 or float64, got {kind}", Gaussians(flat.to(kind), 1).require_finite)


def test_no_gaussian_at_all_is_refused_where_it_is_drawn():
    refused("expected at least one Gaussian, got none", Gaussians(torch.zeros(0), 3).require_finite)


@pytest.mark.parametrize("name", ATTRIBUTES)
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_what_is_not_finite_is_named_with_its_place_and_number(name, bad):
    gaussians = random_gaussians(6, 1)
    gaussians.require_finite()
    value = gaussians.attributes[name]
    value[2:4] = bad
    refused(rf"expected finite {name}, got .* at Gaussian 2 \(2 of 6 are not finite\)", gaussians.require_finite)


def test_a_quaternion_without_a_direction_is_named():
    gaussians = random_gaussians(6, 1)
    gaussians.quats[3] = 0.0
    refused(r"expected non-zero quats, got \[0.0, 0.0, 0.0, 0.0\] at Gaussian 3 \(1 of 6", gaussians.require_finite)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["quats", "sh"])
def test_magnitudes_whose_fourth_power_overflows_are_refused(name, dtype):
    largest = torch.finfo(dtype).max ** 0.25
    gaussians = random_gaussians(6, 1).to(dtype)
    value = gaussians.attributes[name]
    value[4].view(-1)[1] = 0.99 * largest
    gaussians.require_finite()
    value[4].view(-1)[1] = -1.01 * largest
    refused(rf"expected moderate {name} \(.*\), got .* at Gaussian 4 \(1 of 6", gaussians.require_finite)


def test_quaternions_too_short_for_their_curvature_are_refused():
    gaussians = random_gaussians(6, 1).to(torch.float32)
    gaussians.quats[1:3] = 1e-10
    refused(r"moderate quats \(2.3e-10 to 4.3e\+09\), got .* at Gaussian 1 \(2 of 6", gaussians.require_finite)
    gaussians.quats[1:3] = 1e-9
    gaussians.require_finite()


def test_aligned_gaussians_have_unit_quaternions_on_the_near_side():
    here = random_gaussians(5, 1)
    turned = here.with_flat(here.flat.clone())
    turned.quats.mul_(torch.tensor([-3.0, 2.0, -0.1, 1.0, -1.0]).to(here.flat)[:, None])
    before, aligned = turned.flat.clone(), turned.aligned_to(here)
    torch.testing.assert_close(aligned.quats, here.quats / here.quats.norm(dim=1, keepdim=True))
    assert torch.equal(turned.flat, before) and torch.equal(aligned.means, here.means)
