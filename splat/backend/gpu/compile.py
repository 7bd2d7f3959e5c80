"""The CPU's formulas, compiled a second time: by Triton, for the GPU.

A formula that is plain arithmetic on numbers (`jit.formula`) is written once.  Numba compiles it for vectors of
float; `twin` gives the same source to Triton, where a number is a tensor and every other name of it means the functions of
this module.  Formulas therefore take and give numbers and tuples of numbers, index tuples by constants, and choose by
`select(condition, x, y)`, which is elementwise there.

    quadratic, dot = twins(formulas.quadratic, formulas.dot)

`jit` and `sized` mark kernels, `jit` what they call, too.
"""

from collections.abc import Callable
from functools import cache, partial
from types import FunctionType
from typing import Any

import torch
import triton
import triton.language as tl


def jit(function: Callable) -> Any:
    """A kernel, run by `launch`, or what kernels call.  No kernel's parameter may be called params, which Triton's code
    uses.
    """
    return triton.jit(function)


def sized(*names: str) -> Any:
    """A kernel with parameters that change from launch to launch: numbers of Gaussians, vectors or entries.

    Others are compiled anew, which takes seconds, where they become 1 or a multiple of 16 or cease to be.
    """
    return partial(triton.jit, do_not_specialize=names)


def launch(kernel: Any, programs: tuple[int, ...], *arguments: Any, **constants: Any) -> None:
    """Run a kernel, if any programs, on the device of its first argument, which need not be the current one."""
    if all(programs):
        with torch.cuda.device_of(arguments[0]):
            kernel[programs](*arguments, enable_fp_fusion=True, **constants)


def twin(formula: Callable) -> Any:
    """A formula of the CPU as a function that kernels call."""
    return _twin(getattr(formula, "py_func", formula))


def twins(*formulas: Callable) -> tuple[Any, ...]:
    return tuple(twin(formula) for formula in formulas)


@cache
def _twin(function: FunctionType) -> Any:
    meaning = {name: _meaning(name, function.__globals__) for name in _names(function)}
    copied = FunctionType(function.__code__, {"__name__": function.__module__, "tl": tl, **meaning}, function.__name__)
    copied.__module__, copied.__qualname__ = function.__module__, function.__qualname__
    return jit(copied)


def _names(function: FunctionType) -> list[str]:
    return [name for name in function.__code__.co_names if name in MEANING or name in function.__globals__]


def _meaning(name: str, names: dict[str, Any]) -> Any:
    if name in MEANING:
        return MEANING[name]
    value = names[name]
    if isinstance(value, bool | int | float):
        return tl.constexpr(value)
    if not isinstance(getattr(value, "py_func", value), FunctionType):
        raise TypeError(
            f"expected a formula's names to be formulas, numbers or in MEANING, got {name}; give it a meaning"
        )
    return twin(value)


# --- what the names of the formulas mean ------------------------------------------------------------------------------


@jit
def fma(x, y, z):
    return tl.fma(x, y, z)


@jit
def select(condition, x, y):
    return tl.where(condition, x, y)


@jit
def minimum(x, y):
    return tl.minimum(x, y)


@jit
def maximum(x, y):
    return tl.maximum(x, y)


@jit
def reciprocal(x):
    """1 / x for positive x, to the last bit or the one before: by the hardware's inverse square root and a step of Newton's.

    A quotient in single precision takes care of denormal numbers, which costs twice as much.
    """
    root = tl.rsqrt(x)
    r = root * root
    return tl.fma(r, tl.fma(-x, r, 1.0), r)


@jit
def sqrt(x):
    return tl.sqrt(x)


@jit
def exp(x):
    return tl.exp(x)


@jit
def log(x):
    return tl.log(x)


@jit
def exp2(x):
    return tl.exp2(x)


@jit
def log2(x):
    return tl.log2(x)


@jit
def ceil(x):
    return tl.ceil(x)


@jit
def floor(x):
    return tl.floor(x)


@jit
def truncated(x):
    return x.to(tl.int32)


MEANING: dict[str, Any] = {
    "fma": fma,
    "select": select,
    "minimum": minimum,
    "maximum": maximum,
    "min": minimum,
    "max": maximum,
    "reciprocal": reciprocal,
    "sqrt": sqrt,
    "exp": exp,
    "log": log,
    "exp2": exp2,
    "log2": log2,
    "ceil": ceil,
    "floor": floor,
    "int": truncated,
}
