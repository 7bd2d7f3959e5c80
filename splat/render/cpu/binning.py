"""Tile lists: which splats touch which tiles of an image, in order of depth, and in which rows.

A splat is drawn where its alpha is at least alpha_min, inside the ellipse a dx^2 + 2 b dx dy + c dy^2 <= 2 ln(o / alpha_min)
(or contour_sigma^2, where that is less).  Its rows in a tile are those of the ellipse within the tile's columns, found in
double precision and rounded outwards.  Splats: (n, 9), as in `projection/whitening.py`.
"""

from math import floor

import numpy as np

from splat.backend.cpu.jit import kernel
from splat.backend.cpu.memory import PIXEL_ROWS, TILE_HEIGHT, gather, scatter, scatter_one, scratch, store_all
from splat.backend.cpu.simd import broadcast, iota, lanes, lanes_of, load_all, prefetch, select
from splat.backend.cpu.threads import LIGHT, over_range
from splat.render.cpu.tile import GROUP, Lists, grid_of
from splat.render.formulas import SPLAT, Thresholds, box_of, ellipse_of, rows_of_strip

DIGITS = 3
CHUNKS = 32  # parts of the splats in order of depth, that have about the same number of tiles


def depth_order(depths: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """Indices of the drawn splats, nearest first, equal depths in the order of their index."""
    index = np.flatnonzero(drawn).astype(np.int32)
    depths = depths.take(index)
    if depths.dtype != np.float32 or not index.size:
        return index[np.argsort(depths, kind="stable")]
    # positive floats sort as the integers of their bits, and those as what they are above the least
    keys = depths.view(np.uint32)
    keys -= keys.min()
    return radix_argsort(keys, index, -(-int(keys.max()).bit_length() // DIGITS))


@kernel
def radix_argsort(keys, index, bits):
    """index, reordered so that keys of DIGITS digits of so many bits ascend; stable. Overwrites both."""
    n = keys.size
    buckets = 1 << bits
    other_keys, other_index = np.empty_like(keys), np.empty_like(index)
    for digit in range(DIGITS):
        shift = np.uint32(digit * bits)
        place = np.zeros(buckets + 1, np.int64)
        for i in range(n):
            place[((keys[i] >> shift) & np.uint32(buckets - 1)) + 1] += 1
        for d in range(buckets):
            place[d + 1] += place[d]
        for i in range(n):
            d = (keys[i] >> shift) & np.uint32(buckets - 1)
            other_keys[place[d]], other_index[place[d]] = keys[i], index[i]
            place[d] += 1
        keys, other_keys = other_keys, keys
        index, other_index = other_index, index
    return index


BOX = 6  # numbers of a box: those of `ellipse_of`; first and last column of tiles
AHEAD = 12  # splats between a prefetch and its use
BOX_AT, ROWS = 16, 24  # rows of a block of splats


@kernel
def find_boxes(start, stop, splats, tile, width, height, alpha_min, contour, boxes, room):
    """Fill boxes (n, BOX), and room (n,): the number of tiles in each."""
    block, across, down = scratch(np.empty(0), ROWS * lanes(np.empty(0))), 1 / tile, 1 / TILE_HEIGHT
    for i in range(start, stop, lanes(block)):
        gather(splats, SPLAT, i, stop, block, 0)
        splat = load_all(block, 0, 6)
        ellipse = ellipse_of(splat, alpha_min, contour)
        x0, x1, y0, y1 = box_of(splat, ellipse, width, height)
        first, last = floor(x0 * across), floor(x1 * across)
        tiles = (last - first + 1.0) * (floor(y1 * down) - floor(y0 * down) + 1.0)
        store_all(block, BOX_AT, (*ellipse, first, last, select((x0 <= x1) & (y0 <= y1), tiles, 0.0)))
        scatter(block, BOX_AT, boxes, BOX, i, stop)
        scatter_one(block, BOX_AT + BOX, room, i, stop)


@kernel
def find_places(order, room, place):
    """Fill place (order.size + 1,): where the tiles of each splat begin, with room for all in its box."""
    place[0] = 0
    for i in range(order.size):
        place[i + 1] = place[i] + room[order[i]]


@kernel
def list_tiles(start, stop, bounds, splats, order, boxes, grid, place, count, tiles, rows, held):
    """The tiles that each splat touches and its rows in them, at place[i], place[i] + 1, ...; count[i] of them.

    start, stop: parts of the order, which begin at bounds (CHUNKS + 1,); held: (CHUNKS, tiles) how many splats of each part
    touch each tile; grid: pixels in a tile's row, tiles in a row, size of the image.  The strips of a splat, a column of tiles
    each, lie in the lanes of vectors.
    """
    L, (tile, columns, width, height) = lanes(np.empty(0)), grid
    block = scratch(np.empty(0), 2 * L)
    for chunk in range(start, stop):
        held[chunk] = 0
        for i in range(bounds[chunk], bounds[chunk + 1]):
            s, k, later = order[i], place[i], np.int64(order[min(i + AHEAD, order.size - 1)])
            for j in (0, 4):  # both lines of the cache in which each may lie
                prefetch(splats, later * SPLAT + j)
                prefetch(boxes, later * BOX + j)
            if place[i + 1] > k:
                splat = (splats[s, 0], splats[s, 1], splats[s, 2], splats[s, 3], splats[s, 4])
                ellipse = (boxes[s, 0], boxes[s, 1], broadcast(block, boxes[s, 2]), boxes[s, 3])
                first, last = int(boxes[s, 4]), int(boxes[s, 5])
                for column in range(first, last + 1):
                    lane = (column - first) % L
                    if lane == 0:
                        store_all(block, 0, rows_of_strip(splat, ellipse, column + iota(block), tile, width, height))
                    y0, y1 = int(block[lane]), int(block[L + lane])
                    if y0 <= y1:
                        for row in range(y0 // TILE_HEIGHT, y1 // TILE_HEIGHT + 1):
                            top = max(y0 - row * TILE_HEIGHT, 0) // PIXEL_ROWS
                            bottom = min(y1 - row * TILE_HEIGHT, TILE_HEIGHT - 1) // PIXEL_ROWS
                            tiles[k] = row * columns + column
                            rows[k] = top | bottom << 8
                            held[chunk, tiles[k]] += 1
                            k += 1
            count[i] = k - place[i]


@kernel
def fill_lists(start, stop, bounds, order, place, count, tiles, rows, following, splat_of, rows_of):
    """Sort the intersections by tile, in order of depth within each.

    start, stop: as in `list_tiles`; following: (CHUNKS, tiles) where the first of each part comes in each tile; overwritten.
    """
    for chunk in range(start, stop):
        for i in range(bounds[chunk], bounds[chunk + 1]):
            for k in range(place[i], place[i] + count[i]):
                e = following[chunk, tiles[k]]
                following[chunk, tiles[k]] = e + 1
                splat_of[e] = order[i]
                rows_of[e] = rows[k]


def bin_splats(
    splats: np.ndarray, depths: np.ndarray, drawn: np.ndarray, width: int, height: int, thresholds: Thresholds
) -> Lists:
    """The tile lists of a view; the tiles are in the order of `heaviest_first`.  Accumulators come with `reached_lists`."""
    tile, columns, tile_rows = grid_of(width, height, lanes_of(depths.dtype))
    order = depth_order(depths, drawn)
    boxes, room = np.empty((len(splats), BOX)), np.empty(len(splats), np.int32)
    limits = thresholds.alpha_min, thresholds.contour
    over_range(len(splats), find_boxes, splats, tile, width, height, *limits, boxes, room, least=LIGHT)
    place, count = np.empty(order.size + 1, np.int64), np.empty(order.size, np.int32)
    find_places(order, room, place)
    bounds = np.searchsorted(place, np.linspace(0, place[-1], CHUNKS + 1))
    tiles, rows = np.empty(place[-1], np.int32), np.empty(place[-1], np.int32)
    held = np.empty((CHUNKS, columns * tile_rows), np.int64)
    grid = tile, columns, width, height
    over_range(CHUNKS, list_tiles, bounds, splats, order, boxes, grid, place, count, tiles, rows, held)
    # tile after tile, and in each, part after part of the order
    end = held.T.cumsum().reshape(-1, CHUNKS)
    start = np.concatenate([[0], end[:, -1]])
    splat_of, rows_of = np.empty(start[-1], np.int32), np.empty(start[-1], np.int32)
    over_range(CHUNKS, fill_lists, bounds, order, place, count, tiles, rows, end.T - held, splat_of, rows_of)
    return Lists(start, splat_of, rows_of, np.empty(0, np.int32), heaviest_first(np.diff(start), columns))


@kernel
def keep_reached(lists, kept_start, splat_of, rows, accumulator, splat_start):
    """Copy the intersections that some pixel reaches, and number them splat by splat.

    kept_start: (tiles + 1,) where each tile's begin; splat i's are numbers splat_start[i] .. splat_start[i + 1] - 1.
    """
    splat_start[:] = 0
    for t in range(kept_start.size - 1):
        first = lists.start[t]
        for e in range(kept_start[t], kept_start[t + 1]):
            splat_of[e], rows[e] = lists.splat[first + e - kept_start[t]], lists.rows[first + e - kept_start[t]]
            splat_start[splat_of[e] + 1] += 1
    for i in range(splat_start.size - 1):
        splat_start[i + 1] += splat_start[i]
    following = splat_start[:-1].copy()
    for e in range(splat_of.size):
        accumulator[e] = following[splat_of[e]]
        following[splat_of[e]] += 1


def reached_lists(lists: Lists, reached: np.ndarray, n: int) -> tuple[Lists, np.ndarray]:
    """The lists without the intersections behind each tile's last stop, with accumulators; and splat_start (n + 1,).

    reached: (tiles,) how many intersections of each tile some pixel reaches.
    """
    start = np.zeros(reached.size + 1, np.int64)
    np.cumsum(reached, out=start[1:])
    splat_of, rows, accumulator = (np.empty(start[-1], np.int32) for _ in range(3))
    splat_start = np.empty(n + 1, np.int64)
    keep_reached(lists, start, splat_of, rows, accumulator, splat_start)
    return Lists(start, splat_of, rows, accumulator, lists.order), splat_start


def heaviest_first(work: np.ndarray, columns: int) -> np.ndarray:
    """First tiles of groups, row by row; rows with the most work first, so that threads finish together."""
    rows = np.argsort(-work.reshape(-1, columns).sum(1), kind="stable")
    return (rows[:, None] * columns + np.arange(0, columns, GROUP)).reshape(-1)
