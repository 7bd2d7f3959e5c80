"""One source of formulas for two compilers: what Numba compiles for the CPU, as functions that Triton's kernels call.

A `@formula` (`backend/cpu/jit.py`) is a Python function of numbers and tuples of numbers.  While a Triton kernel is compiled,
`triton_formula` runs it as Python on `Number`s: stand-ins for the kernel's tensors that emit every operation made with them.
Tuples, lists, loops and branches over constants are Python's own and leave no trace in the kernel.  A choice that depends on a
tensor is written `select(condition, x, y)`; the functions in `PRIMITIVES` mean the same by name in every formula.

    @triton_formula                       decorates a function of numbers, or takes a `@formula`; kernels call it with
    def slope(x, y):                      tensors, constants and tuples of them, and get tensors or tuples of them
        return dot(x, y) * exp(x[0])

A Number may carry a tangent, a tensor with the directions along its last axis: a dual number, as in `backend/cpu/dual.py`.
"""

# pyright: reportAttributeAccessIssue=false
# (Triton tells type checkers little of its language)

import builtins
import inspect
from collections.abc import Callable
from functools import cache, reduce
from hashlib import sha256
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import triton.language as tl


def _of_values(method: str) -> Callable[["Number", Any], Any]:
    """An operator that looks at the values alone."""
    return lambda x, y: Number(x.semantic, x._emit(method, x.value, _parts(y)[0]))


class Number:
    """A tensor of the kernel that is being compiled, with a tangent or None; semantic: Triton's emitter of operations."""

    def __init__(self, semantic: Any, value: Any, tangent: Any = None):
        self.semantic, self.value, self.tangent = semantic, value, tangent

    def _emit(self, method: str, x: Any, *others: Any) -> Any:
        return getattr(x, method)(*others, _semantic=self.semantic)

    def _times(self, tangent: Any, factor: Any) -> Any:
        return None if tangent is None else self._emit("__mul__", tangent, factor)

    def _plus(self, x: Any, y: Any) -> Any:
        """The sum of two tangents; either may be None."""
        return y if x is None else x if y is None else self._emit("__add__", x, y)

    def __neg__(self) -> "Number":
        return Number(self.semantic, self._emit("__neg__", self.value), self._times(self.tangent, -1.0))

    def __add__(self, other: Any) -> "Number":
        y, dy = _parts(other)
        return Number(self.semantic, self._emit("__add__", self.value, y), self._plus(self.tangent, dy))

    def __sub__(self, other: Any) -> "Number":
        y, dy = _parts(other)
        tangent = self._plus(self.tangent, self._times(dy, -1.0))
        return Number(self.semantic, self._emit("__sub__", self.value, y), tangent)

    def __rsub__(self, other: float) -> "Number":
        return Number(self.semantic, self._emit("__rsub__", self.value, other), self._times(self.tangent, -1.0))

    def __mul__(self, other: Any) -> "Number":
        y, dy = _parts(other)
        tangent = self._plus(self._times(self.tangent, y), self._times(dy, self.value))
        return Number(self.semantic, self._emit("__mul__", self.value, y), tangent)

    def __truediv__(self, other: Any) -> "Number":
        if self.tangent is None and _parts(other)[1] is None:
            return Number(self.semantic, self._emit("__truediv__", self.value, _parts(other)[0]))
        return self * (1.0 / other)

    def __rtruediv__(self, other: float) -> "Number":
        value = self._emit("__rtruediv__", self.value, other)
        if self.tangent is None:
            return Number(self.semantic, value)
        slope = self._emit("__mul__", self._emit("__mul__", value, value), -1.0 / other)
        return Number(self.semantic, value, self._times(self.tangent, slope))

    __radd__, __rmul__ = __add__, __mul__
    __gt__, __ge__, __lt__, __le__ = (_of_values(name) for name in ("__gt__", "__ge__", "__lt__", "__le__"))
    __eq__, __and__, __or__ = (_of_values(name) for name in ("__eq__", "__and__", "__or__"))

    def __bool__(self) -> bool:
        raise TypeError("expected a formula whose branches depend on constants alone; write select(condition, x, y)")


def _parts(x: Any) -> tuple[Any, Any]:
    return (x.value, x.tangent) if isinstance(x, Number) else (x, None)


# --- the functions that formulas call ---------------------------------------------------------------------------------


def _elementwise(operation: Callable) -> Callable:
    """A function of tensors as one of Numbers without tangents and constants, at least one of them a Number."""

    def call(*numbers: Any) -> Any:
        semantic = next(x.semantic for x in numbers if isinstance(x, Number))
        return Number(semantic, operation(*(_parts(x)[0] for x in numbers), _semantic=semantic))

    return call


def _sqrt(x: Number) -> Number:
    root = Number(x.semantic, tl.sqrt(x.value, _semantic=x.semantic))
    return root if x.tangent is None else Number(x.semantic, root.value, x._times(x.tangent, (0.5 / root).value))


def _exp(x: Number) -> Number:
    power = tl.exp(x.value, _semantic=x.semantic)
    return Number(x.semantic, power, x._times(x.tangent, power))


_rsqrt, _fma = _elementwise(tl.rsqrt), _elementwise(tl.fma)


def _reciprocal(x: Number) -> Number:
    """1 / x for positive x, within a unit in the last place: the hardware's inverse square root and one Newton step.

    A quotient in single precision takes care of denormal numbers, which costs twice as much.
    """
    root = _rsqrt(x)
    r = root * root
    return _fma(r, _fma(-x, r, 1.0), r)


def _value_of(x: Number) -> Number:
    return Number(x.semantic, x.value)


def tangent_of(x: Number) -> Number:
    return Number(x.semantic, x.tangent)


def select(condition: Number, x: Any, y: Any) -> Number:
    """x where the condition holds, else y: numbers or constants."""
    (x, dx), (y, dy), semantic = _parts(x), _parts(y), condition.semantic
    value, tangent = tl.where(condition.value, x, y, _semantic=semantic), None
    if dx is not None or dy is not None:
        dx, dy = 0.0 if dx is None else dx, 0.0 if dy is None else dy
        tangent = tl.where(condition.value, dx, dy, _semantic=semantic)
    return Number(semantic, value, tangent)


def variable(x: Number, lane: Number, i: int) -> Number:
    """x with the tangent 1 in direction i and 0 in the others; lane: the directions' indices, along the last axis."""
    one = select(lane == i, 1.0, 0.0)  # pyright: ignore[reportArgumentType]
    return Number(x.semantic, x.value, one.value.to(x.value.dtype, _semantic=x.semantic))


_maximum, _minimum = _elementwise(tl.maximum), _elementwise(tl.minimum)
PRIMITIVES: dict[str, Callable] = {
    "value_of": _value_of, "select": select, "fma": _fma, "reciprocal": _reciprocal, "sqrt": _sqrt, "exp": _exp,
    "maximum": _maximum, "max": lambda *numbers: reduce(_maximum, numbers), "minimum": _minimum, "min": _minimum,
    "abs": _elementwise(tl.abs), "log": _elementwise(tl.log), "exp2": _elementwise(tl.exp2), "ceil": _elementwise(tl.ceil),
    "floor": _elementwise(tl.floor),
}  # fmt: skip


# --- formulas in kernels ----------------------------------------------------------------------------------------------


class Formula:
    """A function of Numbers that kernels call.  digest: changes with its source and with all that it calls."""

    __triton_builtin__ = True

    def __init__(self, function: FunctionType, digest: str):
        self._function, self.digest = function, digest

    def __call__(self, *arguments: Any, _semantic: Any = None) -> Any:
        return _tensors(self._function(*(_numbers(argument, _semantic) for argument in arguments)))


def triton_formula(function: Callable) -> Formula:
    """A formula, or a function that calls formulas, as one that Triton's kernels can call."""
    return Formula(*_rebuilt(getattr(function, "py_func", function)))


@cache
def _rebuilt(function: FunctionType) -> tuple[FunctionType, str]:
    """A function of numbers as one of Numbers, with all functions that it calls; and a digest of their sources."""
    if function.__name__ in PRIMITIVES:
        return PRIMITIVES[function.__name__], THIS_MODULE  # pyright: ignore[reportReturnType]
    names: dict[str, Any] = {"__builtins__": builtins, "__name__": function.__module__}
    digest = sha256((THIS_MODULE + inspect.getsource(function)).encode())
    for name in sorted(_names_in(function.__code__)):
        value = function.__globals__.get(name)
        value = getattr(value, "py_func", value)
        if name in PRIMITIVES:
            value = PRIMITIVES[name]
        elif isinstance(value, FunctionType) and value.__module__ != __name__:
            value, text = _rebuilt(value)
            digest.update(text.encode())
        elif inspect.isclass(value):
            digest.update(inspect.getsource(value).encode())
        elif isinstance(value, bool | int | float):
            digest.update(f"{name} = {value!r}\n".encode())
        if value is not None:
            names[name] = value
    return FunctionType(function.__code__, names, function.__name__), digest.hexdigest()


def _names_in(code: CodeType) -> set[str]:
    inner = (_names_in(constant) for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*inner)


THIS_MODULE = sha256(Path(__file__).read_bytes()).hexdigest()


def _numbers(argument: Any, semantic: Any) -> Any:
    if isinstance(argument, tl.constexpr):
        return argument.value
    if isinstance(argument, tuple | tl.tuple):
        return tuple(_numbers(each, semantic) for each in argument)
    return Number(semantic, argument) if isinstance(argument, tl.tensor) else argument


def _tensors(result: Any) -> Any:
    if isinstance(result, tuple | list):
        return tl.tuple(tuple(_tensors(each) for each in result))
    return result.value if isinstance(result, Number) else result
