"""The machine's arithmetic against exact fractions and what PTX says of numbers that are none."""

from fractions import Fraction

import numpy as np
import pytest

from tests.ptx.arithmetic import APPROXIMATE, dtype, fma, number, operation


def of(text: str, *operands: object) -> list:
    """An instruction's result for operands given as numbers."""
    known = operation(tuple(text.split(".")))
    arrays = [np.atleast_1d(np.asarray(x, dtype(kind))) for x, kind in zip(operands, known.operands, strict=True)]
    with np.errstate(all="ignore"):
        return np.asarray(known.function(*arrays)).tolist()


def test_a_fused_product_is_rounded_once():
    rng = np.random.default_rng(0)
    x, y, z = rng.standard_normal((3, 500)) * 2.0 ** rng.integers(-30, 30, (3, 500))
    exact = [Fraction(a) * Fraction(b) + Fraction(c) for a, b, c in zip(x, y, z, strict=True)]
    assert all(abs(Fraction(got) - e) <= abs(e) / 2**53 for got, e in zip(fma(x, y, z), exact, strict=True))
    lost = [float(Fraction(a) * Fraction(b) - Fraction(a * b)) for a, b in zip(x, y, strict=True)]
    assert fma(x, y, -(x * y)).tolist() == lost
    near, two_near = (np.array([1 + 2.0**-k], np.float32) for k in (23, 22))
    assert fma(near, near, -two_near).tolist() == [2.0**-46]
    with np.errstate(all="ignore"):
        assert fma(np.array([1e308]), np.array([10.0]), np.array([1.0])).tolist() == [np.inf]


def test_an_approximate_instruction_is_off_by_two_units_and_repeatable():
    x = np.linspace(-20, 0, 10_000, dtype=np.float32)
    got = np.array(of("ex2.approx.ftz.f32", x))
    off = got / np.exp2(x.astype(np.float64)) - 1
    assert 0.9 * APPROXIMATE < np.abs(off).max() < 1.3 * APPROXIMATE  # and rounding
    assert got.tolist() == of("ex2.approx.ftz.f32", x)
    assert of("ex2.approx.ftz.f32", -130.0) == [0.0] and of("abs.f32", 1e-40) != [0.0]


def test_nan_is_neither_less_nor_equal_and_conversions_saturate():
    nan = np.nan
    assert of("setp.ne.f32", nan, 1) == [False] and of("setp.neu.f32", nan, 1) == [True]
    assert of("setp.geu.f64", 1, nan) == [True] and of("setp.lt.f64", nan, 1) == [False]
    assert of("setp.nan.f64", nan, 1) == [True] and of("setp.lt.u32", 1, 2**32 - 1) == [True]
    assert of("min.f32", nan, 1) == [1.0] and of("max.f64", 2, nan) == [2.0]
    assert of("cvt.rzi.s32.f64", [1e30, -1e30, nan, -2.7]) == [2**31 - 1, -(2**31), 0, -2]
    assert of("cvt.rmi.f64.f64", -0.5) == [-1.0] and of("cvt.s64.s32", -1) == [-1]
    assert of("cvt.u64.u32", 2**32 - 1) == [2**32 - 1]


def test_whole_numbers_wrap_and_divide_towards_zero():
    assert of("mul.lo.s32", 2**30, 6) == [-(2**31)] and of("mul.wide.s32", 2**30, 6) == [6 * 2**30]
    assert of("div.s32", -7, 2) == [-3] and of("rem.s32", -7, 2) == [-1]
    assert of("bfe.u32", 0b110100, 2, 3) == [0b101] and of("bfe.s32", 0b110100, 2, 4) == [-3]
    assert of("shr.s32", -8, 1) == [-4] and of("shr.u32", 2**31, 31) == [1]
    assert number("0d3FF0000000000000", "f64") == 1.0 and number("0xff", "b16") == 255


def test_an_instruction_that_is_not_known_is_named():
    with pytest.raises(NotImplementedError, match=r"the instruction tanh\.approx\.f32"):
        operation(("tanh", "approx", "f32"))
