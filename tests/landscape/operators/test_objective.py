import pytest
import torch
from torch.utils.checkpoint import checkpoint

from landscape.errors import InputError
from landscape.operators.objective import ObjectiveHessian
from tests.refusals import misused, refused


def loss(x):
    """A smooth function of five variables that leaves the last one out."""
    return torch.exp(x[0] * x[1]) + torch.sin(x[2]) * x[0] ** 2 + (x[3] - x[1]) ** 4


POINT = torch.tensor([0.3, -0.7, 1.1, 0.4, 2.0], dtype=torch.float64)


def test_it_is_the_dense_hessian_of_autograd():
    dense = torch.autograd.functional.hessian(loss, POINT)
    assert isinstance(dense, torch.Tensor)
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
    misused(r"one scalar tensor as loss, got float(64)?; keep to torch", ObjectiveHessian, number, POINT)


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
    misused(r"computed from the point.*\.detach\(\).*no_grad", ObjectiveHessian, cut, POINT)


def test_bad_points_and_losses_are_refused():
    misused("one flat vector of float32 or float64", ObjectiveHessian, loss, POINT[:, None])
    misused("one flat vector of float32 or float64", ObjectiveHessian, loss, POINT.long())
    misused(r"one scalar tensor as loss, got torch.float64 of shape \(5,\)$", ObjectiveHessian, lambda x: x, POINT)
    misused("finite scalar loss", ObjectiveHessian, lambda x: (x - 3).log().sum(), POINT)


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
    refused("at least one batch", ObjectiveHessian.of_module, torch.nn.Linear(1, 1), torch.nn.functional.mse_loss, [])


MSE = torch.nn.functional.mse_loss


def drawn(*shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(len(shape) + sum(shape)))


class Averaging(torch.nn.Module):
    """A layer that divides by a running size of its inputs; it and a count of calls are buffers, changed in place."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(3))
        self.register_buffer("size", torch.ones(()))
        self.register_buffer("calls", torch.zeros((), dtype=torch.long))

    def forward(self, x):
        self.size.mul_(0.9).add_(0.1 * x.detach().norm())  # pyright: ignore
        self.calls += 1
        return self.weight**2 * x / self.size


def spectral(mode):
    torch.manual_seed(0)
    return torch.nn.utils.parametrizations.spectral_norm(torch.nn.Linear(3, 3)).train(mode)


CHANGING = {
    "a running average in place": Averaging(),
    "batch normalisation": torch.nn.Sequential(torch.nn.Linear(3, 3), torch.nn.BatchNorm1d(3)),
    "spectral normalisation": spectral(False),
}


@pytest.mark.parametrize("name", CHANGING)
def test_measuring_changes_neither_buffers_nor_the_mode(name):
    net = CHANGING[name]
    modes, before = [part.training for part in net.modules()], {k: v.clone() for k, v in net.state_dict().items()}
    H = ObjectiveHessian.of_module(net, MSE, [(drawn(8, 3), drawn(8, 3)), (drawn(5, 3), drawn(5, 3))])
    first = H.apply(torch.eye(H.dim)).clone()
    assert torch.equal(H.apply(torch.eye(H.dim)), first)
    assert [part.training for part in net.modules()] == modes
    assert all(torch.equal(v, before[k]) for k, v in net.state_dict().items())


def test_vectors_that_a_layer_iterates_without_gradient_are_said_and_stay_as_they_are():
    net = spectral(True)
    before = {k: v.clone() for k, v in net.state_dict().items()}
    refused("expected products H v", ObjectiveHessian.of_module, net, MSE, [(drawn(8, 3), drawn(8, 3))])
    assert all(torch.equal(v, before[k]) for k, v in net.state_dict().items())


def test_dropout_is_refused_while_it_draws():
    net = torch.nn.Sequential(torch.nn.Linear(3, 8), torch.nn.Dropout(0.5), torch.nn.Linear(8, 3))
    with pytest.raises(InputError, match=r"one gradient at one point, got two .*module\.eval\(\)"):
        ObjectiveHessian.of_module(net, MSE, [(drawn(8, 3), drawn(8, 3))])
    assert ObjectiveHessian.of_module(net.eval(), MSE, [(drawn(8, 3), drawn(8, 3))]).dim == 59


def test_a_loss_that_changes_its_point_is_refused():
    net = torch.nn.Embedding(6, 3, max_norm=0.1)  # shortens its weights in place
    refused("changes it in place", ObjectiveHessian.of_module, net, MSE, [(torch.arange(6), drawn(6, 3))])


def test_samples_weigh_alike_however_they_are_cut_or_batches_by_request():
    net, x, y = torch.nn.Linear(3, 2).double(), drawn(9, 3).double(), drawn(9, 2).double()
    whole = ObjectiveHessian.of_module(net, MSE, [(x, y)])
    eye = torch.eye(whole.dim, dtype=torch.float64)
    cuts = [(x[:8], y[:8]), (x[8:], y[8:])]
    cut = ObjectiveHessian.of_module(net, MSE, cuts)
    torch.testing.assert_close(cut.apply(eye), whole.apply(eye), rtol=1e-12, atol=1e-14)
    assert cut.value == pytest.approx(whole.value, rel=1e-12)
    parts = [ObjectiveHessian.of_module(net, MSE, [batch]).apply(eye) for batch in cuts]
    batches = ObjectiveHessian.of_module(net, MSE, cuts, alike="batches")
    torch.testing.assert_close(batches.apply(eye), (parts[0] + parts[1]) / 2, rtol=1e-12, atol=1e-14)
    with pytest.raises(InputError, match=r"a row for each sample .*alike='batches'"):
        ObjectiveHessian.of_module(net, lambda out, label: (out**2).mean(), [(x, "label")])  # pyright: ignore


def test_graphs_that_leave_too_little_memory_are_built_anew(monkeypatch):
    net, batches = torch.nn.Linear(3, 2), [(drawn(n, 3), drawn(n, 2)) for n in (4, 5, 6)]
    kept = ObjectiveHessian.of_module(net, MSE, batches)
    free = iter([100, 60, 49, 80])
    monkeypatch.setattr("landscape.operators.objective._free_memory", lambda device: next(free))
    short = ObjectiveHessian.of_module(net, MSE, batches)
    assert (len(kept._anew), len(short._anew)) == (0, 1)
    torch.testing.assert_close(short.apply(torch.eye(8)), kept.apply(torch.eye(8)), rtol=1e-6, atol=1e-7)


def test_a_dict_of_parameters_is_a_block_for_each():
    def of_parts(parts):
        return (parts["a"] ** 2).sum() * parts["b"] + parts["b"] ** 3

    point = {"a": torch.tensor([[1.0, 2.0]]), "b": torch.tensor(3.0), "unused": torch.ones(1)}
    H = ObjectiveHessian(of_parts, point)
    assert H.blocks == {"a": slice(0, 2), "b": slice(2, 3), "unused": slice(3, 4)}
    expected = torch.tensor([[6.0, 0, 2, 0], [0, 6, 4, 0], [2, 4, 18, 0], [0, 0, 0, 0]])
    assert torch.equal(H.apply(torch.eye(4)), expected)
    assert torch.equal(H.gradient, torch.tensor([6.0, 12.0, 32.0, 0.0]))


SHARED = torch.ones(3)
KINDS = {
    "half precision": ({"x": torch.ones(3, dtype=torch.bfloat16)}, r"got torch\.bfloat16 on cpu in x; convert"),
    "complex": ({"x": torch.ones(3, dtype=torch.complex64)}, "view_as_real"),
    "two dtypes": ({"x": SHARED, "y": SHARED.double()}, r"float32 on cpu in x and torch\.float64 on cpu in y"),
    "two devices": ({"x": torch.ones(3), "y": torch.ones(3, device="meta")}, "on cpu in x and .* on meta in y"),
    "none": ({}, "got none"),
    "a list": ({"x": [1.0]}, "got list in x"),
    "one tensor twice": ({"x": SHARED, "y": SHARED.view(3, 1)}, "one tensor as x and y"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_parameters_of_other_kinds_are_refused(kind):
    point, sentence = KINDS[kind]
    refused(sentence, ObjectiveHessian, lambda parts: sum((part**2).sum() for part in parts.values()), point)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.complex64])
def test_a_vector_of_too_few_digits_or_complex_is_refused(dtype):
    refused("float32 or float64", ObjectiveHessian, lambda x: (x * x).sum().real, torch.ones(3, dtype=dtype))


def test_a_network_with_shared_weights_has_them_once():
    net = torch.nn.Sequential(torch.nn.Linear(3, 3), torch.nn.Tanh(), torch.nn.Linear(3, 3))
    net[2].weight = net[0].weight
    assert ObjectiveHessian.of_module(net, MSE, [(drawn(4, 3), drawn(4, 3))]).dim == 15


class Called(torch.nn.Module):
    """A linear layer followed by a function."""

    def __init__(self, function):
        super().__init__()
        self.linear, self.function = torch.nn.Linear(3, 4), function

    def forward(self, x):
        return self.function(self.linear, x)


def looked_up(linear, x):
    grid = torch.tanh(linear(x)).view(1, -1, 2, 2)
    return torch.nn.functional.grid_sample(x.view(1, 1, 4, 3), grid, align_corners=False)


MEASURED = {
    "attention": torch.nn.TransformerEncoderLayer(4, 2, 2, dropout=0.0, batch_first=True),
    "a recurrent layer": Called(lambda linear, x: torch.nn.functional.tanh(linear(x)).cumprod(dim=1)),
    "an image that is looked up": Called(looked_up),
    "a checkpoint": Called(lambda linear, x: checkpoint(linear, x, use_reentrant=False) ** 2),
}


@pytest.mark.parametrize("name", MEASURED)
def test_what_torch_differentiates_twice_is_measured(name):
    net = MEASURED[name].double()
    width = 4 if name == "attention" else 3
    x = drawn(4, width).double()[None] if name == "attention" else drawn(4, width).double()
    H = ObjectiveHessian.of_module(net, lambda out, y: (out**2).mean(), [(x, x)])
    dense = H.apply(torch.eye(H.dim, dtype=torch.float64))
    assert float(dense.norm()) > 0 and torch.allclose(dense, dense.T, rtol=0, atol=1e-12 * float(dense.abs().max()))


def test_a_recurrent_network_is_measured():
    net = torch.nn.LSTM(3, 4, batch_first=True).double()
    H = ObjectiveHessian.of_module(
        net, lambda out, y: MSE(out[0], y), [(drawn(2, 5, 3).double(), drawn(2, 5, 4).double())]
    )
    dense = H.apply(torch.eye(H.dim, dtype=torch.float64))
    assert float(dense.norm()) > 0 and torch.allclose(dense, dense.T, rtol=0, atol=1e-12 * float(dense.abs().max()))


def ctc(out, y):
    labels, lengths = torch.ones(2, 2, dtype=torch.long), torch.full((2,), 4)
    return torch.nn.functional.ctc_loss(out[:, None].expand(4, 2, 4).log_softmax(-1), labels, lengths, lengths // 2)


ERRORS = {
    "a bag of embeddings": (torch.nn.EmbeddingBag(6, 3), MSE, torch.ones(4, 3, dtype=torch.long), "take nn.Embedding and"),
    "sparse gradients": (torch.nn.Embedding(6, 3, sparse=True), MSE, torch.arange(4), r"nn\.Embedding\(sparse=False\)"),
    "distances": (
        torch.nn.Linear(3, 4),
        lambda out, y: torch.cdist(out, out + y.mean()).mean(),
        drawn(4, 3),
        "_cdist_backward.*; write that operation",
    ),
    "a loss of sequences": (torch.nn.Linear(3, 4), ctc, drawn(4, 3), "_ctc_loss_backward.*; write that operation"),
    "a reentrant checkpoint": (
        Called(lambda linear, x: checkpoint(torch.tanh, linear(x), use_reentrant=True)),
        lambda out, y: (out**2).mean(),
        drawn(4, 3),
        "use_reentrant=False",
    ),
    "a compiled network": (
        # made by its test: the compiler takes seconds to import
        lambda: torch.compile(torch.nn.Sequential(torch.nn.Linear(3, 3), torch.nn.Tanh()), backend="aot_eager"),
        MSE,
        drawn(4, 3),
        "take the module that was compiled",
    ),
    "inputs of another dtype": (torch.nn.Linear(3, 3), MSE, drawn(4, 3).double(), "one dtype"),
    "inputs on another device": (torch.nn.Linear(3, 3), MSE, drawn(4, 3).to("meta"), "to one device"),
}  # fmt: skip


@pytest.mark.parametrize("name", ERRORS)
def test_what_torch_cannot_do_is_said_with_a_remedy(name):
    net, loss, x, remedy = ERRORS[name]
    net = net if isinstance(net, torch.nn.Module) else net()
    refused(f"^expected [^\n]*{remedy}[^\n]*$", ObjectiveHessian.of_module, net, loss, [(x, drawn(4, 3))])


def test_vectors_of_another_dtype_or_device_are_refused():
    H = ObjectiveHessian(loss, POINT)
    for vectors in (torch.ones(5, 1), torch.ones(5, 1, dtype=torch.float64, device="meta")):
        misused(r"expected V of torch\.float64 on cpu, got", H.apply, vectors)


def test_an_error_of_the_loss_itself_stays_as_it_is():
    refused("must match the size", ObjectiveHessian, lambda x: (x - torch.ones(4)).sum(), POINT, error=RuntimeError)
