"""Effect of every splat on the pixels under it: w = alpha T, and D_c = dI_c/dq of the three colours c, q = ln alpha.

They are found tile by tile, from back to front as in `blocks.py`, and laid out splat by splat for passes that look at a splat
as a whole: four vectors (w, D) for each row of each intersection, an intersection's rows one after the other, the
intersections of a splat side by side.

`find_neighbours` goes over the same pixels from front to back: how many each splat has weight in, and which splat is in front.
"""

from typing import NamedTuple

import numpy as np

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.memory import TILE_ROWS, scratch
from splat.backend.cpu.simd import broadcast, lanes, load, maximum, select, store
from splat.render.cpu.tile import (
    BEHIND,
    UNDO,
    Lists,
    begin_undo_row,
    corner_of,
    intersection,
    intersections_of,
    kept_at,
    load3,
    next_tile,
    row_range,
    row_v,
    store3,
    undo_row,
)
from splat.render.formulas import alpha_row, colour_slopes, plus

FOOTPRINT = 4  # vectors of a row: w, D


class Footprints(NamedTuple):
    """Places of the rows of each splat.

    tiles, rows: (accumulators,) tile of an intersection, and its rows as in `Lists`; place: (accumulators + 1,) which row is an
    intersection's first; splat_start: (n + 1,) the first accumulator of each splat.
    """

    tiles: np.ndarray
    rows: np.ndarray
    place: np.ndarray
    splat_start: np.ndarray


@kernel
def number_rows(lists, tiles, rows, place):
    """Fill tiles, rows and place of `Footprints`."""
    for tile in range(lists.start.size - 1):
        for e in range(lists.start[tile], lists.start[tile + 1]):
            tiles[lists.accumulator[e]], rows[lists.accumulator[e]] = tile, lists.rows[e]
    place[0] = 0
    for a in range(rows.size):
        top, bottom = row_range(rows[a])
        place[a + 1] = place[a] + bottom - top


def footprints_of(lists: Lists, splat_start: np.ndarray) -> Footprints:
    """Footprints of the intersections of lists, which are numbered splat by splat."""
    tiles, rows = np.empty((2, splat_start[-1]), np.int32)
    place = np.empty(splat_start[-1] + 1, np.int64)
    number_rows(lists, tiles, rows, place)
    return Footprints(tiles, rows, place, splat_start)


@kernel
def find_footprints(counter, params, lists, frame, pixels, footprints, begin, end, found):
    """w and D (rows, FOOTPRINT vectors) of the accumulators begin .. end - 1."""
    L = lanes(params)
    state = scratch(params, UNDO * L * TILE_ROWS)
    tile = next_tile(counter, lists, frame, -1)
    while tile >= 0:
        x0, y0, _corner = corner_of(tile, L, frame.columns, frame.stride)
        for y in range(TILE_ROWS):
            begin_undo_row(state, UNDO * L * y, L, frame, pixels, kept_at(tile, y, L))
        first, count = intersections_of(lists, tile)
        for k in range(count - 1, -1, -1):
            a = lists.accumulator[first + k]
            at = np.int64(-1)
            if begin <= a < end:
                at = (footprints.place[a] - footprints.place[begin]) * FOOTPRINT * L
            footprint_of(params, lists, first + k, k, x0, y0, frame, state, found, at)
        tile = next_tile(counter, lists, frame, tile)


@formula
def footprint_of(params, lists, e, k, x0, y0, frame, state, found, at):
    """Undo intersection e, and write its rows to found at `at`, unless it is negative."""
    L = lanes(params)
    _splat, _u, terms, colour, index, top, bottom = intersection(params, lists, e, k, x0, y0)
    for y in range(top, bottom):
        b = UNDO * L * y
        w, free, beta = undo_row(state, b, L, frame, row_v(frame, L, y, terms), terms, index)
        R = load3(state, b + BEHIND * L, L)
        store3(state, b + BEHIND * L, L, plus(R, w, colour))
        if at >= 0:
            to = at + (y - top) * FOOTPRINT * L
            store(found, to, w)
            store3(found, to + L, L, colour_slopes(free, beta, R, colour))


@kernel
def find_neighbours(counter, params, lists, frame, pixels, covered, before):
    """For each intersection: `covered`, how many pixels its splat has weight in; `before`, the nearest splat in front
    that shares one of these pixels, or -1."""
    L = lanes(params)
    state, row = scratch(params, 2 * L * TILE_ROWS), scratch(params, L)  # state: stop, last intersection with weight
    tile = next_tile(counter, lists, frame, -1)
    while tile >= 0:
        x0, y0, _corner = corner_of(tile, L, frame.columns, frame.stride)
        for y in range(TILE_ROWS):
            store(state, 2 * L * y, load(pixels.stop, kept_at(tile, y, L)))
            store(state, (2 * y + 1) * L, -1.0)
        first, count = intersections_of(lists, tile)
        for k in range(count):
            e = first + k
            covered[e], nearest = neighbours_of(params, lists, e, k, x0, y0, frame, state, row)
            before[e] = lists.splat[first + nearest] if nearest >= 0 else -1
        tile = next_tile(counter, lists, frame, tile)


@formula
def neighbours_of(params, lists, e, k, x0, y0, frame, state, row):
    """Number of pixels in which intersection e has weight, and the nearest intersection in front in one of them, or -1."""
    L = lanes(params)
    _splat, _u, terms, _colour, index, top, bottom = intersection(params, lists, e, k, x0, y0)
    none, one = broadcast(params, 0.0), broadcast(params, 1.0)
    ones, nearest = none, -one
    for y in range(top, bottom):
        b = 2 * L * y
        alpha, _uncapped = alpha_row(row_v(frame, L, y, terms), terms, index < load(state, b), frame.cap)
        seen, last = alpha > 0.0, load(state, b + L)
        ones = ones + select(seen, one, none)
        nearest = maximum(nearest, select(seen, last, -one))
        store(state, b + L, select(seen, index, last))
    store(row, 0, ones)
    covered = row.sum()
    store(row, 0, nearest)
    return np.int64(covered), np.int64(row.max())
