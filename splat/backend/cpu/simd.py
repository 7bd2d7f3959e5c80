"""SIMD vectors for Numba: a value that holds one register of floats and reads like a float.

Numba's loop vectoriser does not see through the compositing loops (5-12 times slower), so the kernels say what is meant:
a `Vector` of `lanes(dtype)` floats with the arithmetic operators and comparisons of Python.  Kernels are written once, for
any width and type: the array that a vector is loaded from decides its dtype, and the machine decides its width.

    load(a, i), store(a, i, v)      lanes a[i], a[i+1], ... of a one-dimensional array (any alignment)
    broadcast(a, x)                 the number x in every lane; in arithmetic with a vector it is broadcast by itself
    iota(a)                         0, 1, 2, ...; here and above, a names the dtype
    x + y, x - y, x * y, x / y, -x  may be contracted to fused multiply-adds by the compiler
    fma(x, y, z)                    x y + z with one rounding, always: for values that decide a comparison
    minimum(x, y), maximum(x, y), min(x, y), max(x, y), abs(x), sqrt(x), floor(x), ceil(x)
    x < y ..., m & n, m | n         masks;  select(m, x, y), of numbers and duals too;  any_lane(m)
    load_all(a, i, k), store_all(a, i, t)   a tuple of k vectors, one behind the other; k is a constant
    load_wide(a, i)                 numbers of any type in a vector of float64, of as many lanes as that has
    load_double(a, i), store_double(a, i, x)   one number of float64, which takes the place of two of float32
    store_sums(a, i, (v0, ...))     the sum over the lanes of each vector to a[i], a[i+1], ...;  lane_sum(v) of one
    prefetch(a, i)                  hint that a[i] will be read soon; no effect on results

Requires C-contiguous arrays; indices are not checked.
"""

# pyright: reportOptionalCall=false
# (numba declares its decorators as None until they are set up)

import math
import operator
import os
from collections.abc import Callable
from typing import Any

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.errors import RequireLiteralValue
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic as numba_intrinsic
from numba.extending import lower_builtin, lower_cast, models, register_model

from landscape.errors import InputError
from splat.backend.cpu.kernel_cache import keep_kernels


def intrinsic(definition: Callable) -> Callable[..., Any]:
    """Numba's `intrinsic`, typed as what kernels see of it: a function without the leading typing context."""
    return numba_intrinsic(definition)  # pyright: ignore[reportReturnType]


def _register_bits() -> int:
    """Width of the machine's vector registers; LANDSCAPE_VECTOR_BITS overrides it (for tests of other widths)."""
    if chosen := os.environ.get("LANDSCAPE_VECTOR_BITS"):
        if chosen not in ("128", "256", "512"):
            raise InputError(f"expected LANDSCAPE_VECTOR_BITS to be 128, 256 or 512, got {chosen!r}")
        return int(chosen)
    features = llvmlite.binding.get_host_cpu_features()
    if features.get("avx512f") and features.get("avx512dq"):
        return 512
    return 256 if features.get("avx2") else 128


REGISTER_BITS = _register_bits()
keep_kernels(REGISTER_BITS)
# of a template: tried before Numba's own for the same function, which are of any target: that saves 8% of compilation
FIRST = {"target": "cpu"}
I32, I64, F32, DOUBLE = ir.IntType(32), ir.IntType(64), ir.FloatType(), ir.DoubleType()


def lanes_of(dtype: np.dtype | type) -> int:
    """Number of lanes of a vector of dtype on this machine."""
    return REGISTER_BITS // (8 * np.dtype(dtype).itemsize)


class VectorType(types.Type):
    """Numba's type of a vector: lanes of float32 or float64, one register where `lanes` does not say otherwise."""

    def __init__(self, dtype: types.Float, lanes: int | None = None):
        self.dtype, self.bits = dtype, dtype.bitwidth
        self.lanes = REGISTER_BITS // self.bits if lanes is None else lanes
        super().__init__(name=f"Vector({dtype} x {self.lanes})")

    @property
    def scalar_ir(self) -> ir.Type:
        return F32 if self.bits == 32 else DOUBLE

    @property
    def llvm(self) -> ir.VectorType:
        return ir.VectorType(self.scalar_ir, self.lanes)

    @property
    def integers_ir(self) -> ir.VectorType:
        return ir.VectorType(ir.IntType(self.bits), self.lanes)

    def constant(self, value: float) -> ir.Constant:
        return ir.Constant(self.llvm, [float(np.float32(value)) if self.bits == 32 else float(value)] * self.lanes)


class MaskType(types.Type):
    """Numba's type of a comparison's result: one bit a lane."""

    def __init__(self, lanes: int):
        self.lanes = lanes
        super().__init__(name=f"Mask({lanes})")


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, vector):
        super().__init__(manager, vector, vector.llvm)


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager, mask):
        super().__init__(manager, mask, ir.VectorType(ir.IntType(1), mask.lanes))


def splat_of(builder, number, lanes):
    """A vector with the number in every lane."""
    undefined = ir.Constant(ir.VectorType(number.type, lanes), ir.Undefined)
    first = builder.insert_element(undefined, number, I32(0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(I32, lanes), [0] * lanes))


def call(builder, name, result, arguments):
    """A call of LLVM's function of this name."""
    function = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, function, name), arguments)


@lower_cast(types.Number, VectorType)
def _number_to_vector(context, builder, number, vector, value):
    return splat_of(builder, context.cast(builder, value, number, vector.dtype), vector.lanes)


# --- operators --------------------------------------------------------------------------------------------------------


def _common(arguments) -> VectorType | None:
    """The vector type that arguments of vectors and numbers share."""
    vectors = {argument for argument in arguments if isinstance(argument, VectorType)}
    fits = all(isinstance(argument, VectorType | types.Number | types.Literal) for argument in arguments)
    return vectors.pop() if len(vectors) == 1 and fits else None


def _register(function, emit, to_mask: bool = False) -> None:
    class Template(AbstractTemplate):
        key, metadata = function, FIRST

        def generic(self, args, kws):
            vector = _common(args)
            if vector is not None and not kws:
                return signature(MaskType(vector.lanes) if to_mask else vector, *[vector] * len(args))
            return None

    infer_global(function)(Template)

    @lower_builtin(function, VectorType, VectorType)
    def lower(context, builder, sig, args):
        return emit(builder, *args)


def _arithmetic(instruction):
    return lambda builder, x, y: getattr(builder, instruction)(x, y, flags=("contract",))


def _comparison(symbol):
    return lambda builder, x, y: builder.fcmp_ordered(symbol, x, y)


def _least(builder, x, y):
    return builder.select(builder.fcmp_ordered("<", x, y), x, y)


def _greatest(builder, x, y):
    return builder.select(builder.fcmp_ordered(">", x, y), x, y)


def call_on_lanes(builder, name, *vectors):
    """LLVM's function of this name of every lane."""
    result = vectors[0].type
    suffix = f"v{result.count}f{32 if result.element == F32 else 64}"
    return call(builder, f"llvm.{name}.{suffix}", result, list(vectors))


def _of_lanes(name):
    return lambda builder, x: call_on_lanes(builder, name, x)


for _function, _instruction in (
    (operator.add, "fadd"),
    (operator.iadd, "fadd"),
    (operator.sub, "fsub"),
    (operator.isub, "fsub"),
    (operator.mul, "fmul"),
    (operator.imul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _register(_function, _arithmetic(_instruction))
for _function, _symbol in (
    (operator.ge, ">="), (operator.gt, ">"), (operator.le, "<="), (operator.lt, "<"), (operator.eq, "==")
):  # fmt: skip
    _register(_function, _comparison(_symbol), to_mask=True)
_register(operator.ne, lambda builder, x, y: builder.fcmp_unordered("!=", x, y), to_mask=True)
_register(min, _least)
_register(max, _greatest)


def _register_of(kind, function, emit) -> None:
    """Type and lower a function of vectors, or of masks, alone."""

    class Template(AbstractTemplate):
        key, metadata = function, FIRST

        def generic(self, args, kws):
            return signature(args[0], *args) if isinstance(args[0], kind) and len(set(args)) == 1 else None

    infer_global(function)(Template)

    @lower_builtin(function, kind)
    @lower_builtin(function, kind, kind)
    def lower(context, builder, sig, args):
        return emit(builder, *args)


_register_of(VectorType, operator.neg, lambda builder, x: builder.fneg(x))
_register_of(MaskType, operator.and_, lambda builder, m, n: builder.and_(m, n))
_register_of(MaskType, operator.or_, lambda builder, m, n: builder.or_(m, n))
for _function, _name in ((abs, "fabs"), (math.floor, "floor"), (math.ceil, "ceil")):
    _register_of(VectorType, _function, _of_lanes(_name))


# --- memory -----------------------------------------------------------------------------------------------------------


def address_of(context, builder, sig, args):
    """Where the array that is the first argument keeps the number whose index is the second."""
    data = context.make_array(sig.args[0])(context, builder, args[0]).data
    return builder.gep(data, [context.cast(builder, args[1], sig.args[1], types.intp)])


def load_at(builder, address, vector, further=0):
    """The vector so many numbers behind an address."""
    address = builder.gep(address, [I64(further)])
    value = builder.load(builder.bitcast(address, vector.llvm.as_pointer()))
    value.align = vector.bits // 8
    return value


@intrinsic
def load(typing, array, index):
    vector = VectorType(array.dtype)

    def generate(context, builder, sig, args):
        return load_at(builder, address_of(context, builder, sig, args), vector)

    return vector(array, index), generate


@intrinsic
def load_wide(typing, array, index):
    """As many numbers as a vector of float64 has lanes, in double precision."""
    wide = VectorType(types.float64)
    vector = VectorType(array.dtype, wide.lanes)

    def generate(context, builder, sig, args):
        value = load_at(builder, address_of(context, builder, sig, args), vector)
        return value if vector.bits == wide.bits else builder.fpext(value, wide.llvm)

    return wide(array, index), generate


@intrinsic
def store(typing, array, index, value):
    vector = value if isinstance(value, VectorType) else VectorType(array.dtype)

    def generate(context, builder, sig, args):
        address = address_of(context, builder, sig, args)
        done = builder.store(args[2], builder.bitcast(address, vector.llvm.as_pointer()))
        done.align = vector.bits // 8
        return context.get_dummy_value()

    return types.void(array, index, vector), generate


@intrinsic
def load_all(typing, array, index, count):
    if not isinstance(count, types.IntegerLiteral):
        raise RequireLiteralValue("expected a constant number of vectors")
    many = types.UniTuple(VectorType(array.dtype), count.literal_value)

    def generate(context, builder, sig, args):
        address, vector = address_of(context, builder, sig, args), many.dtype
        values = [load_at(builder, address, vector, k * vector.lanes) for k in range(many.count)]
        return context.make_tuple(builder, many, values)

    return many(array, index, count), generate


@intrinsic
def load_double(typing, array, index):
    def generate(context, builder, sig, args):
        value = builder.load(builder.bitcast(address_of(context, builder, sig, args), DOUBLE.as_pointer()))
        value.align = array.dtype.bitwidth // 8
        return value

    return types.float64(array, index), generate


@intrinsic
def store_double(typing, array, index, number):
    def generate(context, builder, sig, args):
        address = builder.bitcast(address_of(context, builder, sig, args), DOUBLE.as_pointer())
        builder.store(args[2], address).align = array.dtype.bitwidth // 8
        return context.get_dummy_value()

    return types.void(array, index, types.float64), generate


@intrinsic
def prefetch(typing, array, index):
    def generate(context, builder, sig, args):
        address = builder.bitcast(address_of(context, builder, sig, args), ir.IntType(8).as_pointer())
        call(builder, "llvm.prefetch.p0", ir.VoidType(), [address, I32(0), I32(3), I32(1)])
        return context.get_dummy_value()

    return types.void(array, index), generate


@intrinsic
def store_sums(typing, array, index, vectors):
    """Sum each vector of a tuple over its lanes, in a fixed tree, and store the sums side by side."""
    vector = VectorType(array.dtype)

    def generate(context, builder, sig, args):
        address, values = address_of(context, builder, sig, args), cgutils.unpack_tuple(builder, args[2])
        while values:
            # as many as a tree can take
            count = min(1 << len(values).bit_length() - 1, vector.lanes)
            sums, values = _sums_of(builder, values[:count]), values[count:]
            builder.store(sums, builder.bitcast(address, sums.type.as_pointer())).align = vector.bits // 8
            address = builder.gep(address, [I64(count)])
        return context.get_dummy_value()

    return types.void(array, index, vectors), generate


def shuffled(builder, x, y, places):
    """The lanes of x and then y at these places."""
    return builder.shuffle_vector(x, y, ir.Constant(ir.VectorType(I32, len(places)), places))


def exchanged(builder, x, y, step):
    """x and y, the lanes of x whose number has the bit `step` exchanged for those of y whose number has not."""
    n = x.type.count
    low = [lane if not lane & step else n + lane - step for lane in range(n)]
    high = [lane + step if not lane & step else n + lane for lane in range(n)]
    return shuffled(builder, x, y, low), shuffled(builder, x, y, high)


def _sums_of(builder, values):
    """The sum over the lanes of each vector, as one vector; as many vectors as a power of two, at most one a lane.

    Two vectors become one, whose lanes hold sums of half of the lanes of either: a transposition that adds.
    """
    n, places = values[0].type.count, [0]
    for step in (n >> k for k in range(1, n.bit_length())):
        if len(values) > 1:
            pairs = zip(values[::2], values[1::2], strict=True)
            values = [builder.fadd(*exchanged(builder, x, y, step)) for x, y in pairs]
            places += [place + step for place in places]
        else:
            swapped = shuffled(builder, values[0], values[0], [lane ^ step for lane in range(n)])
            values = [builder.fadd(values[0], swapped)]
    return shuffled(builder, values[0], values[0], places)


# --- functions of vectors ---------------------------------------------------------------------------------------------


@intrinsic
def lane_sum(typing, x):
    """The sum over the lanes, in a fixed tree."""

    def generate(context, builder, sig, args):
        return builder.extract_element(_sums_of(builder, list(args)), I32(0))

    return x.dtype(x), generate


@intrinsic
def lanes(typing, array):
    """The number of lanes of a vector of the array's dtype, a compile-time constant."""
    count = VectorType(array.dtype).lanes
    return types.int64(array), lambda context, builder, sig, args: I64(count)


@intrinsic
def broadcast(typing, array, number):
    vector = VectorType(array.dtype)
    return vector(array, vector), lambda context, builder, sig, args: args[1]


def numbered(array, number_of):
    """For an intrinsic: a constant vector of the array's dtype, number_of(lane, lanes) in each lane."""
    vector = VectorType(array.dtype)
    numbers = [float(number_of(lane, vector.lanes)) for lane in range(vector.lanes)]
    return vector(array), lambda *_: ir.Constant(vector.llvm, numbers)


@intrinsic
def iota(typing, array):
    return numbered(array, lambda lane, _: lane)


@intrinsic
def fma(typing, x, y, z):
    vector = _common((x, y, z))
    if vector is None:
        return None

    return vector(vector, vector, vector), lambda context, builder, sig, args: call_on_lanes(builder, "fma", *args)


@intrinsic
def minimum(typing, x, y):
    vector = _common((x, y))
    if vector is None:
        return None

    return vector(vector, vector), lambda context, builder, sig, args: _least(builder, *args)


@intrinsic
def maximum(typing, x, y):
    vector = _common((x, y))
    if vector is None:
        return None

    return vector(vector, vector), lambda context, builder, sig, args: _greatest(builder, *args)


@intrinsic
def select(typing, mask, x, y):
    vector = typing.unify_types(x, y) if isinstance(mask, types.Boolean) else _common((x, y))
    if vector is None:
        return None
    return vector(mask, vector, vector), lambda context, builder, sig, args: builder.select(*args)


@intrinsic
def sqrt(typing, x):
    return x(x), lambda context, builder, sig, args: _of_lanes("sqrt")(builder, *args)


@intrinsic
def any_lane(typing, mask):
    def generate(context, builder, sig, args):
        bits = ir.IntType(mask.lanes)
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], bits), ir.Constant(bits, 0))

    return types.boolean(mask), generate


@intrinsic
def fetch_and_increment(typing, counter):
    """counter[0] before adding 1 to it, atomically; counter is an int64 array.  Hands out tiles to threads."""

    def generate(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, I64(1), "monotonic")

    return types.int64(counter), generate
