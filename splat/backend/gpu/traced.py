"""The CPU kernels' formulas inside Triton kernels: one source of formulas, compiled twice.

A `@formula` of plain numbers is a Python function that Numba compiles for the CPU.  Here the same function runs, as Python,
while a Triton kernel is compiled: on `Number`s, which stand for tensors of that kernel and write down every
operation that is made with them.  Tuples, loops and branches over constants are Python's own and leave no trace; a choice that
depends on a tensor is written `select(condition, x, y)`.  (`raster/triton_formulas.py` gives a formula's source to Triton's own
front end instead, which knows no dual numbers.)

A number may carry a tangent, a tensor with the directions along its last axis: a dual number, as in `dual.py`.

    @traced                               a function of numbers, to be called in a kernel with tensors (and tuples of them),
    def slope(x, y):                      which it gets as Numbers; what it returns, a number or a tuple, the kernel gets as
        return dot(x, y) * exp(x[0])      tensors.  Its globals that are formulas, and theirs, are run as Python

Triton keeps compiled kernels by their source, which does not show the formulas: `digest()` stands for those, and every kernel
that calls a traced function takes it as its last argument.
"""

# pyright: reportAttributeAccessIssue=false
# (Triton tells type checkers little of its language)

import builtins
import inspect
from collections.abc import Callable, Mapping
from functools import cache, reduce, wraps
from hashlib import sha256
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import triton.language as tl
from numba.core.dispatcher import Dispatcher


class Number:
    """A tensor of a kernel under way, with its tangent or none; semantic: what writes operations down."""

    def __init__(self, semantic: Any, value: Any, tangent: Any = None):
        self.semantic, self.value, self.tangent = semantic, value, tangent

    def _call(self, method: str, x: Any, *others: Any) -> Any:
        return getattr(x, method)(*others, _semantic=self.semantic)

    def _times(self, tangent: Any, factor: Any) -> Any:
        return None if tangent is None else self._call("__mul__", tangent, factor)

    def _plus(self, x: Any, y: Any) -> Any:
        """The sum of two tangents, either of which may be none."""
        return y if x is None else x if y is None else self._call("__add__", x, y)

    def __neg__(self) -> "Number":
        return Number(self.semantic, self._call("__neg__", self.value), self._times(self.tangent, -1.0))

    def __add__(self, other: Any) -> "Number":
        y, dy = _parts(other)
        return Number(self.semantic, self._call("__add__", self.value, y), self._plus(self.tangent, dy))

    def __sub__(self, other: Any) -> "Number":
        y, dy = _parts(other)
        tangent = self._plus(self.tangent, self._times(dy, -1.0))
        return Number(self.semantic, self._call("__sub__", self.value, y), tangent)

    def __rsub__(self, other: float) -> "Number":
        return -self + other

    def __mul__(self, other: Any) -> "Number":
        y, dy = _parts(other)
        tangent = self._plus(self._times(self.tangent, y), self._times(dy, self.value))
        return Number(self.semantic, self._call("__mul__", self.value, y), tangent)

    def __truediv__(self, other: Any) -> "Number":
        if self.tangent is None and not isinstance(other, Number):
            return Number(self.semantic, self._call("__truediv__", self.value, other))
        return self * (1.0 / other)

    def __rtruediv__(self, other: float) -> "Number":
        value = self._call("__rtruediv__", self.value, other)
        if self.tangent is None:
            return Number(self.semantic, value)
        slope = self._call("__mul__", self._call("__mul__", value, value), -1.0 / other)
        return Number(self.semantic, value, self._times(self.tangent, slope))

    __radd__, __rmul__ = __add__, __mul__

    def __gt__(self, other: Any) -> Any:
        return self._call("__gt__", self.value, _parts(other)[0])

    def __lt__(self, other: Any) -> Any:
        return self._call("__lt__", self.value, _parts(other)[0])

    def __bool__(self) -> bool:
        raise TypeError("expected a formula whose branches depend on constants alone; write select(condition, x, y)")


def _parts(x: Any) -> tuple[Any, Any]:
    return (x.value, x.tangent) if isinstance(x, Number) else (x, None)


# --- what formulas call beside each other -----------------------------------------------------------------------------


def _sqrt(x: Number) -> Number:
    root = Number(x.semantic, tl.math.sqrt(x.value, _semantic=x.semantic))
    return root if x.tangent is None else Number(x.semantic, root.value, x._times(x.tangent, (0.5 / root).value))


def _exp(x: Number) -> Number:
    power = tl.math.exp(x.value, _semantic=x.semantic)
    return Number(x.semantic, power, x._times(x.tangent, power))


def _value_of(x: Number) -> Number:
    return Number(x.semantic, x.value)


def tangent_of(x: Number) -> Number:
    return Number(x.semantic, x.tangent)


def select(condition: Any, x: Any, y: Any) -> Number:
    """x where the condition holds, else y: numbers, of which one may be a constant."""
    semantic = (x if isinstance(x, Number) else y).semantic
    (x, dx), (y, dy) = _parts(x), _parts(y)
    value = tl.where(condition, x, y, _semantic=semantic)
    if dx is None and dy is None:
        return Number(semantic, value)
    return Number(
        semantic, value, tl.where(condition, 0.0 if dx is None else dx, 0.0 if dy is None else dy, _semantic=semantic)
    )


def _maximum(*numbers: Any) -> Any:
    """Of numbers without tangents."""
    return reduce(lambda x, y: select(y > x, y, x), numbers)


def variable(x: Number, lane: Number, i: int) -> Number:
    """x with the tangent 1 in direction i and 0 in the others; lane: the directions' indices, along the last axis."""
    semantic = x.semantic
    one = tl.where(lane._call("__eq__", lane.value, i), 1.0, 0.0, _semantic=semantic)
    return Number(semantic, x.value, one.to(x.value.dtype, _semantic=semantic))


PRIMITIVES = {
    "sqrt": _sqrt, "exp": _exp, "value_of": _value_of, "tangent_of": tangent_of, "max": _maximum,
    "maximum": _maximum, "abs": lambda x: _maximum(x, -x), "select": select,
}  # fmt: skip


@cache
def as_python(formula: Dispatcher) -> Callable:
    """The Python function of a formula, with all formulas that it calls replaced by theirs."""
    return _rebound(formula.py_func, PRIMITIVES)


def _rebound(function: FunctionType, meaning: Mapping[str, Any]) -> FunctionType:
    """A function whose names mean other things, and the formulas that it calls are Python."""
    names: dict[str, Any] = {"__builtins__": builtins, "__name__": function.__module__}
    SOURCES.update(inspect.getsource(function).encode())
    for name in sorted(_names_in(function.__code__)):
        value = meaning.get(name, function.__globals__.get(name))
        if isinstance(value, float | int):
            SOURCES.update(f"{name} = {value!r}\n".encode())
        if value is not None:
            names[name] = as_python(value) if isinstance(value, Dispatcher) else value
    return FunctionType(function.__code__, names, function.__name__)


def _names_in(code: CodeType) -> set[str]:
    inner = (_names_in(constant) for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*inner)


SOURCES = sha256(Path(__file__).read_bytes())


def digest() -> str:
    """Of this module and all formulas traced so far, for the kernels' keys in Triton's cache."""
    return SOURCES.hexdigest()[:16]


# --- calls from a kernel ----------------------------------------------------------------------------------------------


def traced(function: Callable) -> Callable:
    """A function of numbers, or a formula, as one that kernels can call."""
    python = as_python(function) if isinstance(function, Dispatcher) else _rebound(function, {})

    @wraps(python)
    def call(*arguments: Any, _semantic: Any = None) -> Any:
        return _tensors(python(*(_numbers(argument, _semantic) for argument in arguments)))

    call.__triton_builtin__ = True
    # Triton gives _semantic to those that have it in their signature, which older versions look up as Python does
    call.signature = call.__signature__ = inspect.signature(call, follow_wrapped=False)
    return call


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
