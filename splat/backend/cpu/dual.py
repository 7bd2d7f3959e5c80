"""Dual numbers for Numba: a formula written once is evaluated with its derivative along.

A `Dual` is value + tangent eps with eps^2 = 0.  The value is a float; the tangent is a float (one direction) or a
`Vector` (as many directions as it has lanes), of the same precision or a lower one.

A function of floats that uses +, -, *, /, `sqrt` and `exp` gives, applied to
duals, its Jacobian; applied to the adjoint of a function, its Hessian.  Branches look at the value alone.

    dual(x, dx)         value_of(x)         tangent_of(x)        value_of takes floats too
    variable(a, x, i)   x, whose derivative is 1 in direction i and 0 in the others; a: an array of the tangents' dtype
    sqrt(x), exp(x)     of floats, duals, and vectors, whose lanes are so many Gaussians
    select(c, x, y)     x where c holds, else y, of the same: for formulas that Triton compiles, too
"""

# pyright: reportOptionalCall=false
# (numba declares its decorators as None until they are set up)

import operator

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model

from splat.backend.cpu.exponential import emit_exp
from splat.backend.cpu.simd import FIRST, VectorType, call_on_lanes, intrinsic, select

__all__ = ["dual", "exp", "select", "sqrt", "tangent_of", "value_of", "variable"]

CONTRACT = ("contract",)


class DualType(types.Type):
    """Numba's type of a dual number."""

    def __init__(self, value: types.Float, tangent: types.Float | VectorType):
        self.value, self.tangent = value, tangent
        super().__init__(name=f"Dual({value}, {tangent})")


@register_model(DualType)
class _DualModel(models.StructModel):
    def __init__(self, manager, dual):
        super().__init__(manager, dual, [("value", dual.value), ("tangent", dual.tangent)])


class _Emitter:
    """The arithmetic of one dual type in LLVM: values, tangents, and values spread over tangents."""

    def __init__(self, context, builder, dual: DualType):
        self.context, self.builder, self.dual = context, builder, dual

    def parts(self, number):
        proxy = cgutils.create_struct_proxy(self.dual)(self.context, self.builder, value=number)
        return proxy.value, proxy.tangent

    def make(self, value, tangent):
        proxy = cgutils.create_struct_proxy(self.dual)(self.context, self.builder)
        proxy.value, proxy.tangent = value, tangent
        return proxy._getvalue()

    def spread(self, value):
        """A value as a tangent's factor, rounded to its type."""
        vector = self.dual.tangent
        scalar = vector.scalar_ir if isinstance(vector, VectorType) else self.context.get_value_type(vector)
        if scalar != value.type:
            value = self.builder.fptrunc(value, scalar)
        if not isinstance(vector, VectorType):
            return value
        undefined = ir.Constant(vector.llvm, ir.Undefined)
        first = self.builder.insert_element(undefined, value, ir.IntType(32)(0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), vector.lanes), [0] * vector.lanes)
        return self.builder.shuffle_vector(first, undefined, zeros)

    def mul(self, x, y):
        return self.builder.fmul(x, y, flags=CONTRACT)

    def add(self, x, y):
        return self.builder.fadd(x, y, flags=CONTRACT)

    def sub(self, x, y):
        return self.builder.fsub(x, y, flags=CONTRACT)

    def scale(self, tangent, value):
        return self.mul(tangent, self.spread(value))


def _add(e, x, dx, y, dy):
    return e.add(x, y), (dx if dy is None else dy if dx is None else e.add(dx, dy))


def _sub(e, x, dx, y, dy):
    return e.sub(x, y), (dx if dy is None else e.builder.fneg(dy) if dx is None else e.sub(dx, dy))


def _mul(e, x, dx, y, dy):
    terms = [e.scale(d, v) for d, v in ((dx, y), (dy, x)) if d is not None]
    return e.mul(x, y), terms[0] if len(terms) == 1 else e.add(*terms)


def _div(e, x, dx, y, dy):
    inverse = e.builder.fdiv(x.type(1.0), y)
    quotient = e.mul(x, inverse)
    if dy is None:
        return quotient, e.scale(dx, inverse)
    change = e.scale(dy, quotient)
    change = e.builder.fneg(change) if dx is None else e.sub(dx, change)
    return quotient, e.scale(change, inverse)


def _register(function, emit) -> None:
    """Type and lower function for two duals, a dual and a number, a number and a dual."""

    class Template(AbstractTemplate):
        key, metadata = function, FIRST

        def generic(self, args, kws):
            duals = {argument for argument in args if isinstance(argument, DualType)}
            others = [argument for argument in args if not isinstance(argument, DualType)]
            if len(duals) != 1 or kws or not all(isinstance(other, types.Number) for other in others):
                return None
            (dual,) = duals
            return signature(dual, *[a if isinstance(a, DualType) else dual.value for a in args])

    infer_global(function)(Template)

    def lower(context, builder, sig, args):
        e = _Emitter(context, builder, sig.return_type)
        pairs = [e.parts(v) if isinstance(t, DualType) else (v, None) for t, v in zip(sig.args, args, strict=True)]
        return e.make(*emit(e, *pairs[0], *pairs[1]))

    lower_builtin(function, DualType, DualType)(lower)
    lower_builtin(function, DualType, types.Float)(lower)
    lower_builtin(function, types.Float, DualType)(lower)


for _functions, _emit in (
    ((operator.add, operator.iadd), _add),
    ((operator.sub, operator.isub), _sub),
    ((operator.mul, operator.imul), _mul),
    ((operator.truediv,), _div),
):
    for _function in _functions:
        _register(_function, _emit)


@infer_global(operator.neg)
class _Negation(AbstractTemplate):
    def generic(self, args, kws):
        return signature(args[0], args[0]) if isinstance(args[0], DualType) else None


@lower_builtin(operator.neg, DualType)
def _negate(context, builder, sig, args):
    e = _Emitter(context, builder, sig.return_type)
    value, tangent = e.parts(args[0])
    return e.make(builder.fneg(value), builder.fneg(tangent))


@intrinsic
def dual(typing, value, tangent):
    """value + tangent eps."""
    result = DualType(value, tangent)

    def generate(context, builder, sig, args):
        return _Emitter(context, builder, result).make(*args)

    return result(value, tangent), generate


@intrinsic
def value_of(typing, x):
    if not isinstance(x, DualType):
        return x(x), lambda context, builder, sig, args: args[0]
    return x.value(x), lambda context, builder, sig, args: _Emitter(context, builder, x).parts(args[0])[0]


@intrinsic
def tangent_of(typing, x):
    return x.tangent(x), lambda context, builder, sig, args: _Emitter(context, builder, x).parts(args[0])[1]


DIRECTIONS = 16  # lanes of the tangents of `variable`


@intrinsic
def variable(typing, array, x, i):
    result = DualType(types.float64, VectorType(array.dtype, DIRECTIONS))

    def generate(context, builder, sig, args):
        one = result.tangent.scalar_ir(1.0)
        index = context.cast(builder, args[2], sig.args[2], types.int32)
        tangent = builder.insert_element(result.tangent.constant(0), one, index)
        return _Emitter(context, builder, result).make(args[1], tangent)

    return result(array, types.float64, i), generate


def _unary(llvm_name, derivative, of_vector):
    """An intrinsic of floats, duals and vectors.  derivative(e, x, f(x)) emits f'(x); of_vector(builder, vector, x): f(x)."""

    def typed(typing, x):
        if isinstance(x, VectorType):
            return x(x), lambda context, builder, sig, args: of_vector(builder, x, args[0])
        number = x.value if isinstance(x, DualType) else x
        suffix = "f32" if number.bitwidth == 32 else "f64"

        def generate(context, builder, sig, args):
            value = args[0]
            e = _Emitter(context, builder, x)
            if isinstance(x, DualType):
                value, tangent = e.parts(args[0])
            function_type = ir.FunctionType(value.type, [value.type])
            function = cgutils.get_or_insert_function(builder.module, function_type, f"llvm.{llvm_name}.{suffix}")
            result = builder.call(function, [value])
            if not isinstance(x, DualType):
                return result
            return e.make(result, e.scale(tangent, derivative(e, value, result)))

        return x(x), generate

    typed.__name__ = llvm_name
    return intrinsic(typed)


def _root_of_vector(builder, _vector, x):
    return call_on_lanes(builder, "sqrt", x)


sqrt = _unary("sqrt", lambda e, x, root: e.builder.fdiv(x.type(0.5), root), _root_of_vector)
exp = _unary("exp", lambda e, x, power: power, emit_exp)
