"""Arrays that start on a cache line, rows of numbers in the lanes of vectors, and vectors and tiles of pixels.

A block holds a few things, such as Gaussians, a thing in each lane of float64: a row of lanes for each of its numbers.  Its
rows are transposed in registers, as many at a time as there are lanes:

    load_rows(a, at, k, last, count, block, row)     number j of thing l, a[at + l k + j], to lane l of row + j of the block;
                                                     l = last for l beyond it, and 0 for j from `count` on
    store_rows(a, at, k, last, count, block, row)    the other way; numbers from `count` on stay as they are
    neighbours(a, at)                                vectors of a[at + t], t = 1, ..., 5, -1, ..., -5; `at` aligned
    neighbouring_products(a, at, b, place)           the same of a[at + t] b[place + t]

A vector of pixels holds PIXEL_ROWS rows of pixels, one after the other:

    load_pixels(a, at, stride), store_pixels(a, at, stride, v)   its first row at a[at], the next one at a[at + stride]
    pixel_columns(a), pixel_rows(a)                  the column and the row of each of its pixels; a names the dtype

a: an array of floats, C-contiguous; `at` counts its numbers.
"""

# pyright: reportOptionalCall=false
# (numba declares its decorators as None until they are set up)

from contextlib import suppress
from ctypes import CDLL
from math import prod

import numpy as np
from llvmlite import ir
from numba.core import types

from splat.backend.cpu.jit import formula
from splat.backend.cpu.simd import (
    I32,
    I64,
    VectorType,
    address_of,
    call,
    exchanged,
    intrinsic,
    lanes,
    load_at,
    numbered,
    select,
    splat_of,
    store,
)

PIXEL_ROWS = 2  # of a vector of pixels
TILE_ROWS = 32  # vectors of pixels, one below the other
TILE_HEIGHT = PIXEL_ROWS * TILE_ROWS
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of malloc.h


def _keep_what_is_freed() -> None:
    """Make glibc keep freed memory for the next array: given back, a step's would be asked for page by page at the next one.

    A 16th of a step at 504 x 378.  Arrays of 32 MiB and more are still given back, as is what lies above 256 MiB.
    """
    with suppress(AttributeError):  # another C library
        mallopt = CDLL(None).mallopt
        for name, size in ((M_MMAP_THRESHOLD, 1 << 25), (M_TRIM_THRESHOLD, 1 << 28)):
            mallopt(name, size)


_keep_what_is_freed()


@formula
def scratch(like, size):
    """A new array of like's dtype that starts on a cache line."""
    buffer = np.empty(size + 16, like.dtype)
    start = ((64 - (buffer.ctypes.data & 63)) & 63) // buffer.itemsize
    return buffer[start : start + size]


def aligned(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """An uninitialised array that starts on a cache line."""
    size = prod(shape) * np.dtype(dtype).itemsize
    buffer = np.empty(size + 64, np.uint8)
    start = -buffer.__array_interface__["data"][0] % 64
    return np.ndarray(shape, dtype, buffer, start)


def _transposed(builder, rows):
    """Vectors of as many lanes as there are vectors, transposed: by exchanges of lanes whose numbers differ in one bit."""
    L, rows = len(rows), list(rows)
    step = 1
    while step < L:
        for r in (r for r in range(L) if not r & step):
            rows[r], rows[r | step] = exchanged(builder, rows[r], rows[r | step], step)
        step *= 2
    return rows


class _Rows:
    """Addresses of rows of an array and of a block, and the mask of the numbers that count; arguments as of `load_rows`."""

    def __init__(self, context, builder, sig, args):
        array, block = sig.args[0], sig.args[5]
        at, k, last, count, row = (context.cast(builder, args[j], sig.args[j], types.intp) for j in (1, 2, 3, 4, 6))
        self.builder, self.wide = builder, VectorType(types.float64)
        L, self.narrow = self.wide.lanes, VectorType(array.dtype, self.wide.lanes)
        numbers = ir.Constant(ir.VectorType(I64, L), list(range(L)))
        self.mask = builder.icmp_signed("<", numbers, splat_of(builder, count, L))
        self.addresses, self.block = [], []
        for l in range(L):
            thing = builder.select(builder.icmp_signed("<", last, I64(l)), last, I64(l))
            places = builder.add(at, builder.mul(thing, k)), builder.mul(builder.add(row, I64(l)), I64(L))
            for found, kind, value, place, vector in (
                (self.addresses, array, args[0], places[0], self.narrow), (self.block, block, args[5], places[1], self.wide)
            ):  # fmt: skip
                data = context.make_array(kind)(context, builder, value).data
                found.append(builder.bitcast(builder.gep(data, [place]), vector.llvm.as_pointer()))

    def masked(self, name, result, *arguments):
        """LLVM's masked load or store."""
        name = f"llvm.masked.{name}.v{self.narrow.lanes}f{self.narrow.bits}.p0"
        return call(self.builder, name, result, arguments)


@intrinsic
def load_rows(typing, array, at, k, last, count, block, row):
    def generate(context, builder, sig, args):
        rows = _Rows(context, builder, sig, args)
        narrow, size, zero = rows.narrow.llvm, I32(rows.narrow.bits // 8), rows.narrow.constant(0)
        found = [rows.masked("load", narrow, address, size, rows.mask, zero) for address in rows.addresses]
        for value, address in zip(_transposed(builder, found), rows.block, strict=True):
            if rows.narrow.bits == 32:
                value = builder.fpext(value, rows.wide.llvm)
            builder.store(value, address).align = 8
        return context.get_dummy_value()

    return types.void(array, at, k, last, count, block, row), generate


@intrinsic
def store_rows(typing, array, at, k, last, count, block, row):
    def generate(context, builder, sig, args):
        rows, found = _Rows(context, builder, sig, args), []
        for address in rows.block:
            found.append(builder.load(address))
            found[-1].align = 8
        if rows.narrow.bits == 32:
            found = [builder.fptrunc(value, rows.narrow.llvm) for value in found]
        for value, address in zip(_transposed(builder, found), rows.addresses, strict=True):
            rows.masked("store", ir.VoidType(), value, address, I32(rows.narrow.bits // 8), rows.mask)
        return context.get_dummy_value()

    return types.void(array, at, k, last, count, block, row), generate


def _neighbours(dtype, addresses):
    """A vector across the border of two cache lines is slow to load: these are put together from three that are not."""
    vector, steps = VectorType(dtype), [*range(1, 6), *range(-1, -6, -1)]
    many = types.UniTuple(vector, len(steps))

    def generate(context, builder, sig, args):
        L, first, *second = vector.lanes, *addresses(context, builder, sig, args)

        def near(step):
            value = load_at(builder, first, vector, step)
            for address in second:
                value = builder.fmul(value, load_at(builder, address, vector, step))
            return builder.bitcast(value, vector.integers_ir)  # LLVM aligns integers alone in one instruction

        def shifted(step):
            low, high, first = (here, after, step) if step > 0 else (before, here, L + step)
            return builder.shuffle_vector(low, high, ir.Constant(ir.VectorType(I32, L), [first + l for l in range(L)]))

        before, here, after = near(-L), near(0), near(L)
        values = [near(step) if max(steps) > L else shifted(step) for step in steps]
        return context.make_tuple(builder, many, [builder.bitcast(value, vector.llvm) for value in values])

    return many, generate


@intrinsic
def neighbours(typing, array, at):
    many, generate = _neighbours(array.dtype, lambda *known: [address_of(*known)])
    return many(array, at), generate


@intrinsic
def neighbouring_products(typing, array, at, other, place):
    def addresses(context, builder, sig, args):
        pairs = ((sig.args[i : i + 2], args[i : i + 2]) for i in (0, 2))
        return [address_of(context, builder, types.void(*some), values) for some, values in pairs]

    many, generate = _neighbours(array.dtype, addresses)
    return many(array, at, other, place), generate


def _parts(context, builder, sig, args, vector):
    """Addresses of a vector's rows of pixels, and the type of one."""
    address, stride = address_of(context, builder, sig, args), context.cast(builder, args[2], sig.args[2], types.intp)
    part = VectorType(vector.dtype, vector.lanes // PIXEL_ROWS)
    return [builder.gep(address, [builder.mul(stride, I64(row))]) for row in range(PIXEL_ROWS)], part


@intrinsic
def load_pixels(typing, plane, at, stride):
    vector = VectorType(plane.dtype)

    def generate(context, builder, sig, args):
        addresses, part = _parts(context, builder, sig, args, vector)
        rows = [load_at(builder, address, part) for address in addresses]
        return builder.shuffle_vector(*rows, ir.Constant(ir.VectorType(I32, vector.lanes), list(range(vector.lanes))))

    return vector(plane, at, stride), generate


@intrinsic
def store_pixels(typing, plane, at, stride, value):
    vector = VectorType(plane.dtype)

    def generate(context, builder, sig, args):
        addresses, part = _parts(context, builder, sig, args, vector)
        for row, address in enumerate(addresses):
            lanes = [row * part.lanes + lane for lane in range(part.lanes)]
            value = builder.shuffle_vector(args[3], args[3], ir.Constant(ir.VectorType(I32, part.lanes), lanes))
            builder.store(value, builder.bitcast(address, part.llvm.as_pointer())).align = vector.bits // 8
        return context.get_dummy_value()

    return types.void(plane, at, stride, vector), generate


@intrinsic
def pixel_columns(typing, like):
    return numbered(like, lambda lane, lanes: lane % (lanes // PIXEL_ROWS))


@intrinsic
def pixel_rows(typing, like):
    return numbered(like, lambda lane, lanes: lane // (lanes // PIXEL_ROWS))


@formula
def gather(numbers, k, i, stop, block, row):
    """Copy the k numbers of each Gaussian, (n, ...), to k rows of the block; lanes beyond the last Gaussian repeat it."""
    for j in range(0, k, lanes(block)):
        load_rows(numbers, i * k + j, k, stop - 1 - i, k - j, block, row + j)


@formula
def scatter(block, row, numbers, k, i, stop):
    """Copy k rows of the block to the numbers of each Gaussian, (n, ...)."""
    for j in range(0, k, lanes(block)):
        store_rows(numbers, i * k + j, k, stop - 1 - i, k - j, block, row + j)


@formula
def gather_one(numbers, i, stop, block, row):
    """Copy a number of each Gaussian, (n,), to a row of the block."""
    for l in range(lanes(block)):
        block[row * lanes(block) + l] = numbers[min(i + l, stop - 1)]


@formula
def scatter_one(block, row, numbers, i, stop):
    for l in range(min(lanes(block), stop - i)):
        numbers[i + l] = block[row * lanes(block) + l]


@formula
def store_all(block, row, numbers):
    """Store a tuple of vectors in rows of the block."""
    for j in range(len(numbers)):
        store(block, (row + j) * lanes(block), numbers[j])


@formula
def store_where(mask, block, row, numbers):
    """Store a tuple of vectors in rows of the block, 0 where the mask does not hold."""
    for j in range(len(numbers)):
        store(block, (row + j) * lanes(block), select(mask, numbers[j], 0.0))
