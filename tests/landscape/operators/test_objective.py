import pytest
import torch

from landscape.errors import InputError
from landscape.operators.objective import ObjectiveHessian


def loss(x):
    """A smooth function of five variables that leaves the last one out."""
    return torch.exp(x[0] * x[1]) + torch.sin(x[2]) * x[0] ** 2 + (x[3] - x[1]) ** 4


POINT = torch.tensor([0.3, -0.7, 1.1, 0.4, 2.0], dtype=torch.float64)


def test_it_is_the_dense_hessian_of_autograd():
    dense = torch.autograd.functional.hessian(loss, POINT)
    H = ObjectiveHessian(loss, POINT)
    assert torch.allclose(H.apply(torch.eye(5, dtype=torch.float64)), dense, rtol=0, atol=1e-14)


def test_its_gradient_and_value_are_those_of_the_loss():
    H = ObjectiveHessian(loss, POINT)
    assert H.value == float(loss(POINT))
    x = POINT.clone().requires_grad_()
    assert torch.equal(H.gradient, torch.autograd.grad(loss(x), x)[0])
    assert not H.gradient.requires_grad


def test_float32_agrees_with_float64_to_its_round_off():
    V = torch.randn(5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    exact = ObjectiveHessian(loss, POINT).apply(V)
    single = ObjectiveHessian(loss, POINT.float()).apply(V.float())
    assert single.dtype == torch.float32
    assert (single - exact).norm() < 20 * torch.finfo(torch.float32).eps * exact.norm()


@pytest.mark.parametrize("flat", [lambda x: 3 * x.sum(), lambda x: 2 + 0 * x.sum(), lambda x: (x - 0.1).abs().sum()])
def test_an_objective_without_curvature_has_a_zero_hessian(flat):
    assert not ObjectiveHessian(flat, POINT).apply(torch.eye(5, dtype=torch.float64)).any()


@pytest.mark.parametrize("number", [lambda x: float(loss(x).detach()), lambda x: loss(x).detach().numpy()[()]])
def test_a_loss_that_is_no_tensor_is_refused(number):
    with pytest.raises(ValueError, match=r"one scalar tensor as loss, got float(64)?; keep to torch"):
        ObjectiveHessian(number, POINT)


WEIGHTS = torch.ones(5, dtype=torch.float64, requires_grad=True)


@pytest.mark.parametrize(
    "cut",
    [
        lambda x: loss(x).detach(),
        torch.no_grad()(loss),
        lambda x: torch.tensor(2.0),
        lambda x: torch.tensor(float(loss(x)), requires_grad=True),
        lambda x: (WEIGHTS * x.detach() ** 2).sum(),  # it has a graph, in which the point is not
    ],
)
def test_a_loss_that_is_cut_off_from_the_point_is_refused(cut):
    with pytest.raises(ValueError, match=r"computed from the point.*\.detach\(\).*no_grad"):
        ObjectiveHessian(cut, POINT)


def test_bad_points_and_losses_are_refused():
    with pytest.raises(ValueError, match="one flat vector of floats"):
        ObjectiveHessian(loss, POINT[:, None])
    with pytest.raises(ValueError, match="one flat vector of floats"):
        ObjectiveHessian(loss, POINT.long())
    with pytest.raises(ValueError, match=r"one scalar tensor as loss, got torch.float64 of shape \(5,\)$"):
        ObjectiveHessian(lambda x: x, POINT)
    with pytest.raises(ValueError, match="finite scalar loss"):
        ObjectiveHessian(lambda x: (x - 3).log().sum(), POINT)


def test_the_hessian_of_a_module_is_that_of_its_dense_loss():
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Tanh(), torch.nn.Linear(4, 2)).double()
    net[0].bias.requires_grad_(False)
    batches = [(torch.randn(5, 3, dtype=torch.float64), torch.randn(5, 2, dtype=torch.float64)) for _ in range(2)]
    H = ObjectiveHessian.of_module(net, torch.nn.functional.mse_loss, batches)
    names = ["0.weight", "2.weight", "2.bias"]
    parts = [net.get_parameter(name) for name in names]
    assert list(H.blocks) == names
    assert [rows.stop - rows.start for rows in H.blocks.values()] == [part.numel() for part in parts]

    def loss(*values):
        outputs = [torch.func.functional_call(net, dict(zip(names, values)), (x,)) for x, _ in batches]
        return sum(torch.nn.functional.mse_loss(out, y) for out, (_, y) in zip(outputs, batches)) / 2

    dense = torch.autograd.functional.hessian(loss, tuple(parts))
    sizes = [part.numel() for part in parts]
    rows = [torch.cat([dense[i][j].reshape(sizes[i], sizes[j]) for j in range(3)], dim=1) for i in range(3)]
    torch.testing.assert_close(H.apply(torch.eye(H.dim, dtype=torch.float64)), torch.cat(rows), rtol=1e-12, atol=1e-14)


def test_a_module_without_parameters_and_no_batches_are_refused():
    with pytest.raises(InputError, match="parameters that require a gradient"):
        ObjectiveHessian.of_module(torch.nn.ReLU(), torch.nn.functional.mse_loss, [(torch.ones(1), torch.ones(1))])
    with pytest.raises(InputError, match="at least one batch"):
        ObjectiveHessian.of_module(torch.nn.Linear(1, 1), torch.nn.functional.mse_loss, [])
