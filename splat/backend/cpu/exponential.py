"""exp2, exp and log of SIMD vectors, by polynomials whose coefficients are fitted when this module is loaded.

    exp2(x)   for -126 <= x <= 126 (float32), -1022 <= x <= 1022 (float64); relative error: EXP2_ERROR
    exp(x)    of float64, of any x: 0 below the smallest normal number, and not above the largest power of two
    log(x)    of float64, for x from the smallest normal number to infinity; of a number, math.log

A float's bits are mantissa and exponent: adding an integer to the exponent multiplies by a power of two.  Adding
1.5 x 2^(mantissa bits) to a float rounds it to the nearest integer, and leaves this in the low bits of the sum.
"""

# pyright: reportOptionalCall=false
# (numba declares its decorators as None until they are set up)

from math import log as log_of_number
from math import sqrt

import numpy as np
from llvmlite import ir
from numba.core import types

from splat.backend.cpu.simd import VectorType, call_on_lanes, intrinsic

MANTISSA = {32: 23, 64: 52}
LOG2_E, LOG2_E_REST = 1.4426950408889634, 2.0355273740931033e-17  # log2 e as a double, and what it lacks
LN_2 = 1 / LOG2_E


def _exp2_polynomial(bits: int) -> tuple[np.ndarray, float]:
    """Coefficients of 2^f on |f| <= 1/2, close to minimax in relative error, 2^0 = 1 exactly; and the error reached."""
    degree = 5 if bits == 32 else 11
    nodes = np.cos(np.pi * (np.arange(200) + 0.5) / 200) / 2
    powers = np.stack([nodes**k for k in range(1, degree + 1)], axis=1) / np.exp2(nodes)[:, None]
    rest = np.linalg.lstsq(powers, 1 - np.exp2(-nodes), rcond=None)[0]
    coefficients = np.concatenate([[1.0], rest])
    grid = np.linspace(-0.5, 0.5, 10001)
    return coefficients, float(np.abs(np.polyval(coefficients[::-1], grid) / np.exp2(grid) - 1).max())


EXP2 = {bits: _exp2_polynomial(bits) for bits in (32, 64)}
EXP2_ERROR = {bits: error for bits, (_, error) in EXP2.items()}
ATANH = [2 / (2 * k + 1) for k in range(12)]  # ln((1 + s) / (1 - s)) = s sum_k ATANH[k] s^2k, for s^2 <= 0.03 to 1e-19


def _polynomial(builder, vector, coefficients, x):
    """sum_k coefficients[k] x^k."""
    value = vector.constant(coefficients[-1])
    for c in coefficients[-2::-1]:
        value = call_on_lanes(builder, "fma", value, x, vector.constant(c))
    return value


def _power_of_two(builder, vector, shifted, fraction):
    """2^(whole + fraction), the whole number in the low bits of `shifted`."""
    value = _polynomial(builder, vector, EXP2[vector.bits][0], fraction)
    whole = builder.bitcast(shifted, vector.integers_ir)
    exponent = builder.shl(whole, _integers(vector, MANTISSA[vector.bits]))
    return builder.bitcast(builder.add(builder.bitcast(value, vector.integers_ir), exponent), vector.llvm)


def _integers(vector, number: int) -> ir.Constant:
    return ir.Constant(vector.integers_ir, [number] * vector.lanes)


@intrinsic
def exp2(typing, x):
    magic = x.constant(1.5 * 2.0 ** MANTISSA[x.bits])

    def generate(context, builder, sig, args):
        shifted = builder.fadd(args[0], magic)
        fraction = builder.fsub(args[0], builder.fsub(shifted, magic))
        return _power_of_two(builder, x, shifted, fraction)

    return x(x), generate


def emit_exp(builder, vector: VectorType, x: ir.Value) -> ir.Value:
    """exp of a vector of float64, for `dual.exp`."""
    magic, least, most = (vector.constant(c) for c in (1.5 * 2.0**52, -1022 / LOG2_E, 1022 / LOG2_E))
    seen = builder.fcmp_ordered(">", x, least)
    x = builder.select(seen, x, least)
    x = builder.select(builder.fcmp_ordered("<", x, most), x, most)
    # x log2 e = whole + fraction, the fraction to the last bit
    whole = builder.fsub(call_on_lanes(builder, "fma", x, vector.constant(LOG2_E), magic), magic)
    fraction = call_on_lanes(builder, "fma", x, vector.constant(LOG2_E), builder.fneg(whole))
    fraction = call_on_lanes(builder, "fma", x, vector.constant(LOG2_E_REST), fraction)
    power = _power_of_two(builder, vector, builder.fadd(whole, magic), fraction)
    return builder.select(seen, power, vector.constant(0))


def _emit_log(builder, vector: VectorType, x: ir.Value) -> ir.Value:
    """x = 2^e m with m from sqrt(1/2) to sqrt(2);  ln x = e ln 2 + 2 atanh((m - 1) / (m + 1))."""
    middle = np.array(sqrt(0.5)).view(np.int64)
    magic = 1.5 * 2.0**52
    bits = builder.bitcast(x, vector.integers_ir)
    e = builder.ashr(builder.sub(bits, _integers(vector, int(middle))), _integers(vector, 52))
    m = builder.bitcast(builder.sub(bits, builder.shl(e, _integers(vector, 52))), vector.llvm)
    # the integer e as a float
    e = builder.bitcast(builder.add(e, _integers(vector, int(np.array(magic).view(np.int64)))), vector.llvm)
    e = builder.fsub(e, vector.constant(magic))
    one = vector.constant(1)
    s = builder.fdiv(builder.fsub(m, one), builder.fadd(m, one))
    tail = builder.fmul(s, _polynomial(builder, vector, ATANH, builder.fmul(s, s)))
    infinity = vector.constant(float("inf"))
    found = call_on_lanes(builder, "fma", e, vector.constant(LN_2), tail)
    return builder.select(builder.fcmp_ordered("==", x, infinity), infinity, found)


@intrinsic
def log(typing, x):
    if isinstance(x, VectorType):
        return x(x), lambda context, builder, sig, args: _emit_log(builder, x, args[0])
    number = types.float64

    def generate(context, builder, sig, args):
        function = context.get_function(log_of_number, number(number))
        return function(builder, args)

    return number(number), generate
