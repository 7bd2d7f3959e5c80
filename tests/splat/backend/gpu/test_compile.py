"""A formula of the CPU gives Triton the numbers that it gives Python."""

import inspect

import numpy as np
import pytest
import torch

pytest.importorskip("triton", reason="the kernels for GPUs need triton; pip install -e '.[gpu]'")

import triton.language as tl

from splat.backend.gpu.compile import jit, twin, twins
from splat.backend.gpu.traced import traced
from splat.projection import whitening
from splat.raster import formulas

quadratic, dot = twins(formulas.quadratic, formulas.dot)
plain, plain_adjoint = twins(whitening.plain, whitening.plain_adjoint)


@jit
def evaluate(x, out, n, BLOCK: tl.constexpr):
    i = tl.arange(0, BLOCK)
    v = tl.load(x + i, i < n)
    W = (v + 1, 0.5 * v, v)
    five = plain_adjoint(W, plain(W, (v, 2.0, v * v, v, 0.3 * v)))
    tl.store(out + i, quadratic(v, five) + dot(five, W), i < n)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_twin_computes_what_its_formula_computes(device, dtype):
    x = torch.linspace(0.5, 2.0, 10, dtype=dtype, device=device)
    out = torch.empty_like(x)
    evaluate[(1,)](x, out, 10, BLOCK=16)
    expected = []
    for v in x.tolist():
        W = (v + 1, 0.5 * v, v)
        five = whitening.plain_adjoint.py_func(W, whitening.plain.py_func(W, (v, 2.0, v * v, v, 0.3 * v)))
        expected.append(formulas.quadratic.py_func(v, five) + formulas.dot.py_func(five, W))
    np.testing.assert_allclose(out.cpu(), expected, rtol=16 * torch.finfo(dtype).eps)


def test_a_formula_has_one_twin():
    assert twin(formulas.dot) is dot


def test_a_traced_formula_asks_triton_for_the_compiler_by_either_way_of_reading_signatures():
    call = traced(whitening.plain)
    assert "_semantic" in inspect.signature(call).parameters  # Triton 3.6
    assert "_semantic" in call.signature.parameters  # Triton 3.9
