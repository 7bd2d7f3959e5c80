"""The vector type against NumPy, at the machine's width and, in processes of their own, at the others."""

import os
import subprocess
import sys
from math import ceil, floor
from pathlib import Path

import numba
import numpy as np
import pytest

from splat.backend.cpu import kernel_cache, simd
from splat.backend.cpu.dual import exp
from splat.backend.cpu.exponential import EXP2_ERROR, exp2, log
from splat.backend.cpu.memory import (
    PIXEL_ROWS,
    gather,
    load_pixels,
    neighbouring_products,
    neighbours,
    pixel_columns,
    pixel_rows,
    scatter,
    store_pixels,
)
from splat.backend.cpu.simd import (
    any_lane,
    broadcast,
    fetch_and_increment,
    fma,
    iota,
    lanes,
    lanes_of,
    load,
    maximum,
    minimum,
    prefetch,
    select,
    sqrt,
    store,
    store_sums,
)

each_dtype = pytest.mark.parametrize("dtype", [np.float32, np.float64])
BITS = ("128", "256", "512")
OPERATIONS = 20


@numba.njit
def every_operation(a, b, c, number, out):
    """One operation after the other, `lanes` results each."""
    L = lanes(a)
    x, y, z = load(a, 1), load(b, 0), load(c, 0)
    prefetch(a, 0)
    store(out, 0, x + y)
    store(out, L, x - number)
    store(out, 2 * L, 3 * x)
    store(out, 3 * L, number / x)
    store(out, 4 * L, -x)
    store(out, 5 * L, fma(x, y, z))
    store(out, 6 * L, minimum(x, y))
    store(out, 7 * L, maximum(x, number))
    store(out, 8 * L, sqrt(x))
    store(out, 9 * L, select((x < y) & (x >= z), x, 0.0))
    store(out, 10 * L, select(x > y, y, x))
    store(out, 11 * L, select(x <= y, y, x))
    store(out, 12 * L, iota(a) + broadcast(a, 2))
    x += y
    x *= z
    x -= 1.0
    store(out, 13 * L, x)
    x = load(a, 1)
    store(out, 14 * L, min(x, y))
    store(out, 15 * L, max(number, x))
    store(out, 16 * L, abs(x - y))
    store(out, 17 * L, floor(3 * x))
    store(out, 18 * L, ceil(-3 * x))
    store(out, 19 * L, select((x == x) & ((x > y) | (x != x)), x, y))


@numba.njit
def powers(x, out):
    for i in range(0, x.size, lanes(x)):
        store(out, i, exp2(load(x, i)))


@numba.njit
def sums(a, out):
    L = lanes(a)
    x, y, z = load(a, 0), load(a, L), load(a, 2 * L)
    store_sums(out, 1, (x, y, z, x + y, -x, y + z, 2.0 * x, x, y))


@numba.njit
def any_above(a, number):
    return any_lane(load(a, 0) > number)


@numba.njit
def take(counter):
    return fetch_and_increment(counter)


def test_the_width_is_the_one_asked_for():
    assert str(simd.REGISTER_BITS) == os.environ.get("LANDSCAPE_VECTOR_BITS", str(simd.REGISTER_BITS))
    assert lanes_of(np.float32) == 2 * lanes_of(np.float64) == simd.REGISTER_BITS // 32


@each_dtype
def test_every_operation_is_that_of_numpy_to_the_last_bit(dtype):
    generator, L = np.random.default_rng(0), lanes_of(dtype)
    a, b, c = (generator.random(L + 1, dtype) + dtype(0.25) for _ in range(3))
    number, out = dtype(0.625), np.full(OPERATIONS * L, np.nan, dtype)
    every_operation(a, b, c, number, out)
    x, y, z = a[1:], b[:L], c[:L]
    expected = [
        x + y, x - number, 3 * x, number / x, -x, x * y + z, np.minimum(x, y), np.maximum(x, number), np.sqrt(x),
        np.where((x < y) & (x >= z), x, 0), np.where(x > y, y, x), np.where(x <= y, y, x), np.arange(L) + 2,
        (x + y) * z - 1, np.minimum(x, y), np.maximum(x, number), abs(x - y), np.floor(3 * x), np.ceil(-3 * x),
        np.maximum(x, y),
    ]  # fmt: skip
    fused = (5, 13)  # rounded once fewer than by NumPy; their terms are below 4
    for i, (got, want) in enumerate(zip(out.reshape(OPERATIONS, L), expected, strict=True)):
        assert got == pytest.approx(want, rel=0, abs=4 * float(np.finfo(dtype).eps) if i in fused else 0), i
    # a fetch changes no number, but stays in the code
    assert all("llvm.prefetch" in code for code in every_operation.inspect_llvm().values())


@each_dtype
def test_fma_rounds_once(dtype):
    L, tiny = lanes_of(dtype), dtype(np.finfo(dtype).eps)
    ones = np.full(L + 1, 1 + tiny, dtype)
    out = np.zeros(OPERATIONS * L, dtype)
    every_operation(ones, ones, np.full(L, -(1 + 2 * tiny), dtype), dtype(1), out)
    assert (out[5 * L : 6 * L] == tiny * tiny).all()  # (1 + e)^2 - (1 + 2 e); 0 where the product is rounded first


@each_dtype
def test_exp2_has_its_stated_error_over_its_whole_range(dtype):
    bits = 8 * np.dtype(dtype).itemsize
    end = 126 if bits == 32 else 1022
    x = np.linspace(-end, end, 64 * 1024).astype(dtype)
    out = np.empty_like(x)
    powers(x, out)
    exact = np.exp2(x.astype(np.longdouble))
    # Horner's five or eleven fused steps on |f| <= 1/2 round by less than 1.5 units in the last place together
    bound = EXP2_ERROR[bits] + 1.5 * np.finfo(dtype).eps
    assert np.abs(out / exact - 1).max() < bound
    whole = np.arange(-end, end + 1 + (-2 * end - 1) % 16, dtype=dtype)[: (2 * end + 1) // 16 * 16]
    out = np.empty_like(whole)
    powers(whole, out)
    assert (out == np.exp2(whole)).all()
    assert bound < (3e-7 if bits == 32 else 1e-15)


@numba.njit
def powers_and_logarithms(x, power, y, logarithm):
    for i in range(0, x.size, lanes(x)):
        store(power, i, exp(load(x, i)))
        store(logarithm, i, log(load(y, i)))


def test_exp_and_log_are_right_to_a_unit_in_the_last_place():
    x = np.append(np.linspace(-708.3, 708.3, 4088), [-1e4, -709, -1e-300, 0, 1e-300, 1, 709, 1e4])
    y = np.append(np.exp(x[:-8]), [0.5, 1, 2, 0.7071067811865475, 1 - 2**-53, 1 + 2**-52, 2.3e-308, np.inf])
    power, logarithm = np.empty_like(x), np.empty_like(y)
    powers_and_logarithms(x, power, y, logarithm)
    inside, eps = abs(x) < 708.35, np.finfo(np.float64).eps
    assert abs(power[inside] / np.exp(x[inside].astype(np.longdouble)) - 1).max() < 1.25 * eps
    assert not power[x < -708.4].any() and (power[x > 708.4] > 1e307).all() and np.isfinite(power).all()
    assert logarithm[-1] == np.inf and logarithm[y == 1] == 0
    exact = np.log(y[:-1].astype(np.longdouble))
    assert (abs(logarithm[:-1] - exact) <= 1.25 * eps * abs(exact)).all()


@numba.njit
def through_lanes(numbers, k, block, out, stop):
    for i in range(0, stop, lanes(block)):
        gather(numbers, k, i, stop, block, 0)
        scatter(block, 0, out, k, i, stop)


@each_dtype
@pytest.mark.parametrize("k", [1, 3, 9, 27])
@pytest.mark.parametrize("n", [1, 5, 17])
def test_rows_go_into_lanes_and_back_and_no_further(dtype, k, n):
    numbers, block = np.random.default_rng(0).random((n + 1, k), dtype), np.zeros(40 * lanes_of(np.float64))
    out = np.full_like(numbers, -1)
    through_lanes(numbers, k, block, out, n)
    assert (out[:n] == numbers[:n]).all() and (out[n:] == -1).all()
    L = lanes_of(np.float64)
    last = np.minimum((n - 1) // L * L + np.arange(L), n - 1)  # in the last block, a row of a number each
    assert (block.reshape(40, L)[:k] == numbers[last].T).all()


@numba.njit
def all_around(a, at, b, place, out):
    found, products = neighbours(a, at), neighbouring_products(a, at, b, place)
    for j in range(10):
        store(out, j * lanes(a), found[j])
        store(out, (10 + j) * lanes(a), products[j])


@each_dtype
def test_neighbours_are_those_to_the_right_then_those_to_the_left(dtype):
    L = lanes_of(dtype)
    a, b, at, place = np.arange(16 * L, dtype=dtype), np.sqrt(np.arange(64, dtype=dtype)), 8 * L, 21
    out, near = np.empty((20, L), dtype), np.arange(L) + np.array([[1, 2, 3, 4, 5, -1, -2, -3, -4, -5]]).T
    all_around(a, at, b, place, out.reshape(-1))
    assert (out[:10] == at + near).all() and (out[10:] == a[at + near] * b[place + near]).all()


@numba.njit
def through_pixels(plane, at, stride, out, places):
    store_pixels(out, at, stride, load_pixels(plane, at, stride))
    store(places, 0, pixel_columns(plane))
    store(places, lanes(plane), pixel_rows(plane))


@each_dtype
def test_vectors_of_pixels_are_read_and_written_row_by_row(dtype):
    L, stride, at = lanes_of(dtype), 2 * lanes_of(dtype), 2 * lanes_of(dtype) + 1
    plane = np.arange(1, 4 * stride + 1, dtype=dtype)
    out, places = np.zeros_like(plane), np.empty(2 * L, dtype)
    through_pixels(plane, at, stride, out, places)
    columns, rows = places.reshape(2, L).astype(int)
    expected = np.zeros_like(plane)
    expected[at + columns + stride * rows] = plane[at + columns + stride * rows]
    assert (out == expected).all() and np.count_nonzero(out) == L
    assert (columns + L // PIXEL_ROWS * rows).tolist() == list(range(L))


@each_dtype
def test_sums_over_lanes_are_stored_side_by_side_and_nowhere_else(dtype):
    L = lanes_of(dtype)
    a = np.random.default_rng(1).integers(-8, 8, 3 * L).astype(dtype)  # integers sum exactly
    out = np.full(12, 99, dtype)
    sums(a, out)
    x, y, z = (row.sum() for row in a.reshape(3, L))
    assert out.tolist() == [99, x, y, z, x + y, -x, y + z, 2 * x, x, y, 99, 99]


@each_dtype
def test_any_lane_sees_each_lane(dtype):
    L = lanes_of(dtype)
    assert not any_above(np.zeros(L, dtype), dtype(0))
    for lane in range(L):
        assert any_above((np.arange(L) == lane).astype(dtype), dtype(0))


def test_the_counter_hands_out_every_number_once():
    counter = np.zeros(1, np.int64)
    assert [take(counter) for _ in range(5)] == [0, 1, 2, 3, 4] and counter[0] == 5


OTHERS = [bits for bits in BITS if bits != str(simd.REGISTER_BITS)]
KERNEL = "test_compositing.py::test_colour_and_alpha_are_those_of_the_specification[opaque-float64]"


@pytest.mark.skipif("LANDSCAPE_VECTOR_BITS" in os.environ, reason="this is such a process")
@pytest.mark.parametrize("bits", OTHERS)
def test_the_same_holds_at_another_width(bits):
    files = [__file__]
    if bits == OTHERS[0]:  # the kernels take a while to compile
        files.append(str(Path(__file__).parents[2] / "render" / "cpu" / KERNEL))
    command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", "--noconftest", *files]
    done = subprocess.run(command, env={**os.environ, "LANDSCAPE_VECTOR_BITS": bits}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_a_width_that_does_not_exist_is_refused():
    command = [sys.executable, "-c", "import splat.backend.cpu.simd"]
    done = subprocess.run(command, env={**os.environ, "LANDSCAPE_VECTOR_BITS": "100"}, capture_output=True, text=True)
    assert done.returncode != 0 and "expected LANDSCAPE_VECTOR_BITS to be 128, 256 or 512, got '100'" in done.stderr


def test_a_changed_source_or_width_gets_kernels_of_its_own(tmp_path, monkeypatch) -> None:
    (tmp_path / "inner").mkdir()
    sources = {
        "kernels.py": "from splat.inner import (\n    blurs,\n)\n\n@kernel\ndef f(): pass\n",
        "inner/blurs.py": "from splat.constants import x\n",
        "constants.py": "x = 1\n",
        "training.py": "from splat.kernels import f\n",
    }
    for name, text in sources.items():
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(kernel_cache, "PACKAGE", tmp_path)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    before = kernel_cache.kernel_folder(256)
    assert kernel_cache.kernel_folder(256) == before != kernel_cache.kernel_folder(512)
    (tmp_path / "training.py").write_text("no kernel's business")
    assert kernel_cache.kernel_folder(256) == before
    for name in ("constants.py", "inner/blurs.py", "kernels.py"):
        (tmp_path / name).write_text(sources[name] + "# changed")
        assert kernel_cache.kernel_folder(256) != before
        (tmp_path / name).write_text(sources[name])
    assert before.is_relative_to(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "elsewhere"))
    assert kernel_cache.kernel_folder(256).parent == tmp_path / "elsewhere"


@pytest.mark.parametrize(("mode", "ours"), [(0o755, True), (0o777, False), (0o757, False), (0o1777, False)])
def test_kernels_are_not_run_from_where_others_may_write(tmp_path, mode, ours):
    from splat.backend.cpu.kernel_cache import _is_ours, _is_this_users

    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels").chmod(mode)
    assert _is_ours(tmp_path / "kernels") == ours
    (tmp_path / "kernels/inner").mkdir(mode=0o755)
    assert _is_ours(tmp_path / "kernels/inner") == ours
    (tmp_path / "kernels").chmod(0o775)
    assert _is_ours(tmp_path / "kernels")  # of this user's own group
    group = os.stat_result([0o40775, 0, 0, 0, os.getuid(), os.getgid() + 1, 0, 0, 0, 0])
    assert not _is_this_users(group)
