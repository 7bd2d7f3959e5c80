"""What PTX instructions compute, for arrays of numbers: one a thread.

Kinds are PTX's (`f32`, `s64`, `b16`, `pred`); "bits" (`b..`) are unsigned whole numbers.  Rounding is the hardware's, but
for the functions that it approximates: they are off by up to the 2 units in the last place that PTX allows, differently for
every argument and always alike for the same.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

Array = np.ndarray
APPROXIMATE = 2.0**-22  # the error of the functions that the hardware approximates in single precision
COMPARISONS: dict[str, Callable] = {
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
}  # fmt: skip


@dataclass(frozen=True)
class Operation:
    """Kinds of the result and of the operands, and the function."""

    result: str
    operands: tuple[str, ...]
    function: Callable[..., Any]


@cache
def dtype(kind: str) -> np.dtype:
    """
    >>> dtype("f32"), dtype("b16"), dtype("s64"), dtype("pred")
    (dtype('float32'), dtype('uint16'), dtype('int64'), dtype('bool'))
    """
    if kind == "pred":
        return np.dtype(bool)
    return np.dtype({"f": "f", "s": "i", "u": "u", "b": "u"}[kind[0]] + str(int(kind[1:]) // 8))


def number(text: str, kind: str) -> Array:
    """A number in an instruction: whole, or the bits of a floating-point number.

    >>> float(number("0f3F800000", "f32")), int(number("-1", "u32")), bool(number("-1", "pred"))
    (1.0, 4294967295, True)
    """
    if kind == "pred":
        return np.array(int(text, 0) != 0)
    bits = int(text[2:], 16) if text[:2] in ("0f", "0d") else int(text, 0)
    size = dtype(kind).itemsize
    return np.array(bits % 2 ** (8 * size), f"u{size}").view(dtype(kind))


@cache
def operation(opcode: tuple[str, ...]) -> Operation:
    """Of an instruction that computes; NotImplementedError for one that is not known here."""
    name, kind = opcode[0], opcode[-1]
    if name == "cvt":
        return Operation(opcode[-2], (kind,), _conversion(opcode))
    if name == "setp":
        return Operation("pred", (kind, kind), _comparison(opcode))
    if name == "selp":
        return Operation(kind, (kind, kind, "pred"), lambda x, y, which: np.where(which, x, y))
    if name in ("shl", "shr"):
        return Operation(kind, (kind, "u32"), np.left_shift if name == "shl" else np.right_shift)
    if name == "bfe" and kind in ("u32", "s32"):  # with its sign, where numbers have one
        return Operation(kind, (kind, kind, kind), lambda x, start, size: (x << 32 - start - size) >> 32 - size)
    if "wide" in opcode:
        wide = kind[0] + str(2 * int(kind[1:]))
        multiply = lambda x, y, z=0: x.astype(dtype(wide)) * y.astype(dtype(wide)) + z  # noqa: E731
        return Operation(wide, (kind, kind) + (wide,) * (name == "mad"), multiply)
    function = {"f": FLOATING, "pred": LOGIC, "b": LOGIC}.get(kind if kind == "pred" else kind[0], WHOLE).get(name)
    if function is None:
        raise NotImplementedError(f"the instruction {'.'.join(opcode)}")
    count = function.nin if isinstance(function, np.ufunc) else function.__code__.co_argcount
    if "approx" in opcode or "full" in opcode:
        return Operation(kind, (kind,) * count, _approximate(function, kind, "ftz" in opcode))
    return Operation(kind, (kind,) * count, function)


def fma(x: Array, y: Array, z: Array) -> Array:
    """x y + z with one rounding: in single precision by double, in double by an exact product and an exact sum."""
    if x.dtype == np.float32:
        return (x.astype(np.float64) * y + z).astype(np.float32)
    product = x * y
    total = product + z
    (x1, x2), (y1, y2) = _halves(x), _halves(y)
    lost = ((x1 * y1 - product) + x1 * y2 + x2 * y1) + x2 * y2
    back = total - product
    exact = total + (lost + ((product - (total - back)) + (z - back)))
    return np.where(np.isfinite(exact), exact, total)


def _halves(x: Array) -> tuple[Array, Array]:
    scaled = x * 134217729.0  # 2^27 + 1
    first = scaled - (scaled - x)
    return first, x - first


def _quotient(x: Array, y: Array) -> Array:
    return np.trunc(x / np.where(y == 0, 1, y)).astype(x.dtype)


FLOATING: dict[str, Any] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "fma": fma, "neg": np.negative,
    "abs": np.abs, "min": np.fmin, "max": np.fmax, "sqrt": np.sqrt, "ex2": np.exp2, "lg2": np.log2,
    "rsqrt": lambda x: 1 / np.sqrt(x), "rcp": lambda x: 1 / x,
}  # fmt: skip
WHOLE: dict[str, Any] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "mad": lambda x, y, z: x * y + z, "neg": np.negative,
    "abs": np.abs, "min": np.minimum, "max": np.maximum, "div": _quotient, "rem": np.fmod,
}  # fmt: skip
LOGIC: dict[str, Any] = {"and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor, "not": np.invert}


def _approximate(function: Callable, kind: str, flushes: bool) -> Callable:
    """With the hardware's error, and numbers too small to be normal as 0 where it flushes them."""
    if kind == "f64":  # the first guess of an iteration, of which the lower half is 0; without `ftz` as good as it gets
        cut = lambda y: (y.view(np.uint64) & np.uint64(0xFFFFFFFF00000000)).view(np.float64)  # noqa: E731
        return lambda *x: cut(np.atleast_1d(function(*x))) if flushes else function(*x)

    def flushed(x: Array) -> Array:
        return np.where(np.abs(x) < np.finfo(np.float32).tiny, np.float32(0) * x, x) if flushes else x

    def approximated(*operands: Array) -> Array:
        result = function(*(flushed(x).astype(np.float64) for x in operands))
        mixed = operands[0].view(np.uint32) * np.uint32(0x9E3779B1) >> np.uint32(8)
        return flushed((result * (1 + APPROXIMATE * (mixed * 2.0**-23 - 1))).astype(np.float32))

    return approximated


def _comparison(opcode: tuple[str, ...]) -> Callable:
    """Ordered ones are false where a number is NaN, the others (`..u`) true."""
    name, kind = opcode[1], opcode[-1]
    if len(opcode) != 3:
        raise NotImplementedError(f"the instruction {'.'.join(opcode)}")
    if kind[0] != "f":
        return COMPARISONS[{"lo": "lt", "ls": "le", "hi": "gt", "hs": "ge"}.get(name, name)]
    if name in ("nan", "num"):
        return lambda x, y: (np.isnan(x) | np.isnan(y)) == (name == "nan")
    compare, unordered = COMPARISONS[name[:2]], name.endswith("u")
    return lambda x, y: np.where(np.isnan(x) | np.isnan(y), unordered, compare(x, y))


def _conversion(opcode: tuple[str, ...]) -> Callable:
    to, source, rounding = dtype(opcode[-2]), dtype(opcode[-1]), opcode[1]
    if source.kind != "f":
        return lambda x: x.astype(to)
    rounded = {"rzi": np.trunc, "rmi": np.floor, "rpi": np.ceil, "rni": np.rint}.get(rounding, np.positive)
    if to.kind == "f":
        return lambda x: rounded(x).astype(to)
    least, most = np.iinfo(to).min, np.iinfo(to).max

    def to_whole(x: Array) -> Array:
        y = rounded(x).astype(np.float64)
        inside = (y > least) & (y < most)
        beyond = np.where(np.isnan(y), 0, np.where(y < 0, least, most))
        return np.where(inside, np.where(inside, y, 0).astype(to), beyond.astype(to))

    return to_whole
