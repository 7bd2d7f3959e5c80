"""Tile lists: which splats touch which tiles of an image, in order of depth, and in which rows.

A splat is drawn where its alpha is at least alpha_min, inside the ellipse a dx^2 + 2 b dx dy + c dy^2 <= 2 ln(o / alpha_min)
(or contour_sigma^2, where that is less).  Its rows in a tile are those of the ellipse within the tile's columns, found in
double precision and rounded outwards.  Splats: (n, 9), as in `projection/whitening.py`.
"""

from math import floor

import numpy as np

from splat.backend.cpu.jit import kernel
from splat.backend.cpu.memory import PIXEL_ROWS, TILE_HEIGHT, gather, scatter, scratch, store_all
from splat.backend.cpu.simd import broadcast, iota, lanes, lanes_of, load_all, prefetch, select
from splat.backend.cpu.threads import over_range
from splat.render.cpu.tile import Lists, grid_of
from splat.render.formulas import SPLAT, Thresholds, box_of, ellipse_of, rows_of_strip

RADIX_BITS = 11


def depth_order(depths: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """Indices of the drawn splats, nearest first, equal depths in the order of their index."""
    index = np.flatnonzero(drawn).astype(np.int32)
    if depths.dtype == np.float32:  # positive floats sort as the integers of their bits
        return radix_argsort(depths[index].view(np.uint32), index)
    return index[np.argsort(depths[index], kind="stable")]


@kernel
def radix_argsort(keys, index):
    """index, reordered so that the 32-bit keys ascend; stable. Overwrites both."""
    n = keys.size
    buckets = 1 << RADIX_BITS
    other_keys, other_index = np.empty_like(keys), np.empty_like(index)
    for digit in range(3):
        shift = np.uint32(digit * RADIX_BITS)
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


BOX = 7  # numbers of a box: those of `ellipse_of`; first and last column of tiles; number of tiles
AHEAD = 12  # splats between a prefetch and its use
BOX_AT, ROWS = 16, 24  # rows of a block of splats


@kernel
def find_boxes(start, stop, splats, tile, width, height, alpha_min, contour, boxes):
    """Fill boxes (n, BOX)."""
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


@kernel
def list_tiles(start, stop, splats, order, boxes, tile, columns, width, height, place, count, tiles, rows):
    """The tiles that each splat touches and its rows in them, at place[i], place[i] + 1, ...; count[i] of them.

    The strips of a splat, a column of tiles each, lie in the lanes of vectors.
    """
    L = lanes(np.empty(0))
    block = scratch(np.empty(0), 2 * L)
    for i in range(start, stop):
        s, k, later = order[i], place[i], np.int64(order[min(i + AHEAD, stop - 1)])
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
                        k += 1
        count[i] = k - place[i]


@kernel
def fill_lists(order, place, count, tiles, rows, start, splat_of, rows_of):
    """Sort the intersections by tile, in order of depth within each; start: (tiles + 1,) becomes where each tile's begin."""
    start[:] = 0
    for i in range(order.size):
        for k in range(place[i], place[i] + count[i]):
            start[tiles[k] + 1] += 1
    for t in range(start.size - 1):
        start[t + 1] += start[t]
    following = start[:-1].copy()
    for i in range(order.size):
        for k in range(place[i], place[i] + count[i]):
            e = following[tiles[k]]
            following[tiles[k]] = e + 1
            splat_of[e] = order[i]
            rows_of[e] = rows[k]


def bin_splats(
    splats: np.ndarray, depths: np.ndarray, drawn: np.ndarray, width: int, height: int, thresholds: Thresholds
) -> Lists:
    """The tile lists of a view; the tiles are in the order of `heaviest_first`.  Accumulators come with `reached_lists`."""
    tile, columns, tile_rows = grid_of(width, height, lanes_of(depths.dtype))
    order = depth_order(depths, drawn)
    boxes, limits = np.empty((len(splats), BOX)), (thresholds.alpha_min, thresholds.contour)
    over_range(len(splats), find_boxes, splats, tile, width, height, *limits, boxes)
    place = np.zeros(order.size + 1, np.int64)  # room for all tiles of each box
    np.cumsum(boxes[order, BOX - 1], out=place[1:], dtype=np.int64)
    count = np.empty(order.size, np.int32)
    tiles, rows = np.empty(place[-1], np.int32), np.empty(place[-1], np.int32)
    over_range(order.size, list_tiles, splats, order, boxes, tile, columns, width, height, place, count, tiles, rows)
    intersections, start = int(count.sum()), np.empty(columns * tile_rows + 1, np.int64)
    splat_of, rows_of = np.empty(intersections, np.int32), np.empty(intersections, np.int32)
    fill_lists(order, place, count, tiles, rows, start, splat_of, rows_of)
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
    """Tiles row by row, as neighbours share cache lines; rows with the most work first, so that threads finish together."""
    rows = np.argsort(-work.reshape(-1, columns).sum(1), kind="stable")
    return (rows[:, None] * columns + np.arange(columns)).reshape(-1)
