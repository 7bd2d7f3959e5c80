"""A formula gives Triton the numbers that it gives Python, and its source is part of Triton's key."""

import numpy as np
import pytest
import torch

pytest.importorskip("triton", reason="the kernels for GPUs need triton; pip install -e '.[gpu]'")

import triton.language as tl

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false
# (in a kernel names mean tensors)
from splat.backend.cpu.dual import exp, select, sqrt, value_of
from splat.backend.cpu.jit import kernel
from splat.gpu.language import formula
from splat.gpu.language.compile import jit
from splat.gpu.language.formula import Number, tangent_of, triton_formula, variable
from splat.projection import whitening
from splat.render import formulas

quadratic, dot = triton_formula(formulas.quadratic), triton_formula(formulas.dot)
plain, plain_adjoint = triton_formula(whitening.plain), triton_formula(whitening.plain_adjoint)
rows_of_strip, ellipse_of = triton_formula(formulas.rows_of_strip), triton_formula(formulas.ellipse_of)


@jit
def evaluate(x, out, n, BLOCK: tl.constexpr):
    i = tl.arange(0, BLOCK)
    v = tl.load(x + i, i < n)
    W = (v + 1, 0.5 * v, v)
    five = plain_adjoint(W, plain(W, (v, 2.0, v * v, v, 0.3 * v)))
    tl.store(out + i, quadratic(v, five) + dot(five, W), i < n)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_formula_in_a_kernel_computes_what_python_computes(device, dtype):
    x = torch.linspace(0.5, 2.0, 10, dtype=dtype, device=device)
    out = torch.empty_like(x)
    evaluate[(1,)](x, out, 10, BLOCK=16)
    expected = []
    for v in x.tolist():
        W = (v + 1, 0.5 * v, v)
        five = whitening.plain_adjoint.py_func(W, whitening.plain.py_func(W, (v, 2.0, v * v, v, 0.3 * v)))
        expected.append(formulas.quadratic.py_func(v, five) + formulas.dot.py_func(five, W))
    np.testing.assert_allclose(out.cpu(), expected, rtol=16 * torch.finfo(dtype).eps)


@jit
def list_rows(splats, first, last, n, BLOCK: tl.constexpr, TILE: tl.constexpr):
    i = tl.arange(0, BLOCK)
    splat = ()
    for j in tl.static_range(6):
        splat = splat + (tl.load(splats + i * 6 + j, i < n, other=1.0),)
    ellipse = ellipse_of(splat, 0.1, 3.0)
    rows = rows_of_strip(splat, ellipse, i % 3, TILE, 40, 30)
    tl.store(first + i, rows[0], i < n)
    tl.store(last + i, rows[1], i < n)


def test_comparisons_choices_and_whole_numbers_are_those_of_python(device):
    generator = torch.Generator().manual_seed(0)
    splats = torch.rand(16, 6, generator=generator, dtype=torch.float64)
    splats *= torch.tensor([40.0, 30.0, 0.02, 0.01, 0.02, 1.2])  # some too faint, some not bounded by an ellipse
    first, last = (torch.empty(16, dtype=torch.int32, device=device) for _ in range(2))
    list_rows[(1,)](splats.to(device), first, last, 16, BLOCK=16, TILE=16)
    ellipse_alone, rows_alone = kernel(formulas.ellipse_of.py_func), kernel(formulas.rows_of_strip.py_func)
    expected = []
    for i, splat in enumerate(splats.numpy()):
        expected.append(rows_alone(splat, ellipse_alone(splat, 0.1, 3.0), i % 3, 16, 40, 30))
    assert list(zip(first.tolist(), last.tolist(), strict=True)) == expected
    assert len(set(expected)) > 3


@triton_formula
def value_and_gradient(x, y, lane):
    """f = e^x sqrt(y) - y / x where x > y, else 1 - x y; and its derivatives in x and y, side by side."""
    x, y = variable(x, lane, 0), variable(y, lane, 1)
    f = select(x > y, exp(x) * sqrt(y) - y / x, 1.0 - x * y)
    return value_of(f), tangent_of(f)


@jit
def differentiate(x, y, value, gradient, n, BLOCK: tl.constexpr):
    i, lane = tl.arange(0, BLOCK)[:, None], tl.arange(0, 2)[None, :]
    f, slope = value_and_gradient(tl.load(x + i, i < n), tl.load(y + i, i < n, other=1.0), lane)
    tl.store(value + i, f, i < n)
    tl.store(gradient + 2 * i + lane, slope, i < n)


def test_a_dual_number_carries_the_derivatives_in_closed_form(device):
    x, y = torch.linspace(0.2, 2, 20, dtype=torch.float64), torch.linspace(1.5, 0.3, 20, dtype=torch.float64)
    value, gradient = torch.empty_like(x, device=device), torch.empty(20, 2, dtype=torch.float64, device=device)
    differentiate[(1,)](x.to(device), y.to(device), value, gradient, 20, BLOCK=32)
    power, root = torch.exp(x), torch.sqrt(y)
    expected = ((power * root - y / x, power * root + y / x**2, 0.5 * power / root - 1 / x), (1 - x * y, -y, -x))
    assert 0 < (x > y).sum() < 20
    for found, one, other in zip((value, *gradient.T), *expected, strict=True):
        torch.testing.assert_close(found.cpu(), torch.where(x > y, one, other), rtol=1e-14, atol=0)


@triton_formula
def branching(x):
    return x if x > 0 else -x


def test_a_branch_that_depends_on_a_tensor_is_refused():
    with pytest.raises(TypeError, match=r"branches depend on constants alone; write select\(condition, x, y\)"):
        branching._function(Number(None, Comparable()))


class Comparable:
    """A tensor of Triton that can be compared."""

    def __gt__(self, other: object, _semantic: None = None) -> bool:
        return True


@jit
def calls_a_function_that_calls_a_formula(x, out, n, BLOCK: tl.constexpr):
    evaluate(x, out, n, BLOCK)


def test_tritons_key_of_a_kernel_changes_with_a_formula_that_it_calls(monkeypatch):
    """Also with one that a function called by the kernel calls, and with a constant of a formula."""
    keys = set()
    for digest in ("one", "other"):
        monkeypatch.setattr(quadratic, "digest", digest)
        calls_a_function_that_calls_a_formula.hash = evaluate.hash = None
        keys |= {evaluate.cache_key, calls_a_function_that_calls_a_formula.cache_key}
    assert len(keys) == 4
    monkeypatch.setattr(formulas, "WIDEN", 2e-4)
    monkeypatch.setattr(formula, "_rebuilt", formula._rebuilt.__wrapped__)
    assert triton_formula(formulas.ellipse_of).digest != ellipse_of.digest
