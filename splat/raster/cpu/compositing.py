"""The compositing kernels of first order: `forward` front to back, `backward` back to front (`formulas.py`)."""

import numpy as np

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.planes import TILE_ROWS, scratch
from splat.backend.cpu.simd import any_lane, broadcast, fma, lanes, load, maximum, prefetch, select, store
from splat.raster.cpu.tile import (
    AHEAD,
    CAPPED,
    NEVER,
    PARAMS,
    RED,
    SUMS,
    add_row,
    alpha_terms,
    broadcast3,
    clear_entries,
    corner_of,
    dark,
    load3,
    load_cotangent,
    next_tile,
    no_moments,
    reached,
    row_range,
    row_v,
    store3,
    store_moments,
)
from splat.raster.formulas import alpha_row, behind_all, plus, step_back

# --- forward ----------------------------------------------------------------------------------------------------------


@kernel
def forward(counter, params, lists, frame, pixels):
    """Render: fill `pixels`."""
    L = lanes(params)
    state = scratch(params, 5 * L * TILE_ROWS)  # a row: T (negative once stopped), image (3), stop
    tile = next_tile(counter, lists)
    while tile >= 0:
        x0, y0, corner = corner_of(tile, L, frame.columns, frame.stride)
        for y in range(TILE_ROWS):
            b = 5 * L * y
            store(state, b, 1.0)
            for j in range(1, 4):
                store(state, b + j * L, 0.0)
            store(state, b + 4 * L, NEVER)
        first = np.int64(lists.start[tile])
        count = lists.start[tile + 1] - first
        some_stopped = False
        for k in range(count):
            prefetch(params, np.int64(lists.splat[first + min(k + AHEAD, count - 1)]) * PARAMS)
            some_stopped |= forward_entry(params, lists, first + k, k, x0, y0, frame, state)
            if some_stopped and (k & 15) == 15:
                some_stopped = False
                if all_stopped(state, L):
                    break
        for y in range(TILE_ROWS):
            b, p = 5 * L * y, corner + y * frame.stride
            T = maximum(load(state, b), -load(state, b))
            store(pixels.transmittance, p, T)
            store(pixels.stop, p, load(state, b + 4 * L))
            for c in range(3):
                store(pixels.planes, c * frame.size + p, load(state, b + (1 + c) * L) + T * frame.background[c])
            store(pixels.planes, 3 * frame.size + p, 1.0 - T)
        tile = next_tile(counter, lists)


@formula
def forward_entry(params, lists, e, k, x0, y0, frame, state):
    """Composite one entry; True if it stopped a pixel."""
    L = lanes(params)
    o = np.int64(lists.splat[e]) * PARAMS
    _u, terms = alpha_terms(params, o, x0, y0)
    colour = broadcast3(params, o + RED)
    top, bottom = row_range(lists.rows[e])
    stopped = False
    for y in range(top, bottom):
        b = 5 * L * y
        T = load(state, b)
        alpha, _uncapped = alpha_row(row_v(frame, L, y, terms), terms, T > 0.0, frame.cap)
        w = alpha * T
        after = fma(-alpha, T, T)  # T - w, to the last bit even where alpha is near 1
        ends = (after < frame.floor) & (T > 0.0)
        if any_lane(ends):
            w = select(ends, 0.0, w)
            after = select(ends, -T, after)
            store(state, b + 4 * L, select(ends, k, load(state, b + 4 * L)))
            stopped = True
        store(state, b, after)
        store3(state, b + L, L, plus(load3(state, b + L, L), w, colour))
    return stopped


@formula
def all_stopped(state, L):
    for y in range(TILE_ROWS):
        if any_lane(load(state, 5 * L * y) > 0.0):
            return False
    return True


# --- backward ---------------------------------------------------------------------------------------------------------


@kernel
def backward(counter, params, lists, frame, pixels, cotangent, sums):
    """Moments of every entry, (entries, SUMS), from the cotangent of the planes."""
    L = lanes(params)
    state = scratch(params, 6 * L * TILE_ROWS)  # a row: T, R, g (3), stop
    tile = next_tile(counter, lists)
    while tile >= 0:
        x0, y0, corner = corner_of(tile, L, frame.columns, frame.stride)
        for y in range(TILE_ROWS):
            begin_backward_row(state, 6 * L * y, L, frame, pixels, cotangent, corner + y * frame.stride)
        first, count = reached(lists, tile, pixels, corner, frame.stride)
        if dark(cotangent, 0, 4, corner, frame.size, frame.stride):
            clear_entries(lists, first, count, SUMS, sums)
            count = 0
        for k in range(count - 1, -1, -1):
            later = first + max(k - AHEAD, 0)
            prefetch(params, np.int64(lists.splat[later]) * PARAMS)
            prefetch(sums, np.int64(lists.slots[later]) * SUMS)
            backward_entry(params, lists, first + k, k, x0, y0, frame, state, sums)
        tile = next_tile(counter, lists)


@formula
def begin_backward_row(state, b, L, frame, pixels, cotangent, p):
    T, g = load(pixels.transmittance, p), load_cotangent(cotangent, p, frame.size)
    store(state, b, T)
    store(state, b + L, T * behind_all(g, frame.background))
    store3(state, b + 2 * L, L, g)
    store(state, b + 5 * L, load(pixels.stop, p))


@formula
def backward_entry(params, lists, e, k, x0, y0, frame, state, sums):
    L = lanes(params)
    o = np.int64(lists.splat[e]) * PARAMS
    u, terms = alpha_terms(params, o, x0, y0)
    colour = broadcast3(params, o + RED)
    capped = lists.rows[e] & CAPPED
    index = broadcast(params, k)
    moments = no_moments(params)
    top, bottom = row_range(lists.rows[e])
    for y in range(top, bottom):
        b = 6 * L * y
        v = row_v(frame, L, y, terms)
        alpha, uncapped = alpha_row(v, terms, index < load(state, b + 5 * L), frame.cap)
        R, g = load(state, b + L), load3(state, b + 2 * L, L)
        T, after, w, beta, _r, we = step_back(alpha, load(state, b), R, g, colour)
        s = we - beta * R
        if capped:
            s = select(uncapped <= frame.cap, s, 0.0)
        store(state, b, T)
        store(state, b + L, after)
        moments = add_row(moments, v, s, w, g)
    store_moments(sums, np.int64(lists.slots[e]), moments, u)
