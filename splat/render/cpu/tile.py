"""The arrays of the compositing kernels on the CPU, and how a tile of them is read and written.

A vector of pixels is `lanes` / PIXEL_ROWS wide and PIXEL_ROWS high, as few splats are as wide as a register.  A tile is
TILE_ROWS vectors, one below the other; the kernels call each a row.  An intersection is a splat in a tile.  Each writes
its nine sums (six moments of s, three of colour: `render/formulas.py`) to an accumulator of its own, and those of a splat lie
side by side, so that no sum depends on the order in which threads finish.  Every kernel (`compositing.py`, `tangents.py`,
`blocks.py`) takes groups of tiles from a counter until none is left (`threads.over_tiles`).  Arrays are flat: `params` holds
PARAMS floats a splat, `tangents` K x SPLAT floats a splat, a plane stride x height floats.
"""

from typing import NamedTuple

import numpy as np

from splat.backend.cpu.jit import formula
from splat.backend.cpu.memory import (
    PIXEL_ROWS,
    TILE_HEIGHT,
    TILE_ROWS,
    load_pixels,
    pixel_columns,
    pixel_rows,
    store_pixels,
)
from splat.backend.cpu.simd import (
    REGISTER_BITS,
    any_lane,
    broadcast,
    fetch_and_increment,
    fma,
    load,
    load_double,
    prefetch,
    select,
    store,
    store_sums,
)
from splat.render.formulas import SPLAT, along_row, alpha_row, column_terms, reciprocal, row_terms

GROUP = 1024 // REGISTER_BITS  # tiles whose rows share a cache line
AHEAD = 6  # intersections between a prefetch and its use

# A splat's numbers, one cache line in float32: in float64 its mean x, y (pixel index units) and the whitening's shear; then the
# rest of the whitening, a column's step of v, LO = log2 o, colour, cut
PARAMS = 16
MX, MY, SHEAR = 0, 2, 4
ALONG, ACROSS, STEP, LO, RED, GREEN, BLUE, CUT = range(6, 14)

# The vectors that a kernel keeps of a row of pixels, in this order; a number is the first of its channels.
T, STOP = 0, 1  # transmittance, and the number of the intersection from which on none reaches the pixel
IMAGE, FORWARD = 2, 5
REST, GRAD, BACKWARD = 2, 3, 6  # R and v_image
BEHIND, UNDO = 2, 5  # the colour behind, of the passes in `blocks.py` and `footprints.py`
DT, DIMAGE, TANGENT = 0, 1, 4  # after T and STOP, for each of K tangents
TAU, DREST, DGRAD, BACKWARD_TANGENT = 0, 1, 2, 5  # after those of `backward`, for each of K tangents


class Lists(NamedTuple):
    """Splats that touch each tile, in order of depth.

    start: (tiles + 1,) first intersection of each tile; splat: (intersections,); rows: (intersections,) first row |
    last row << 8 within the tile; accumulator: (intersections,) where their sums go, splat by splat;
    order: the first tiles of groups, as these are handed out.
    """

    start: np.ndarray
    splat: np.ndarray
    rows: np.ndarray
    accumulator: np.ndarray
    order: np.ndarray


def grid_of(width: int, height: int, lanes: int) -> tuple[int, int, int]:
    """Pixels in a tile's row, tiles in a row, rows of tiles of an image: a row of its planes is a number of whole registers."""
    return lanes // PIXEL_ROWS, -(-width // lanes) * PIXEL_ROWS, -(-height // TILE_HEIGHT)


class Frame(NamedTuple):
    """Constants of all pixels: size of the image, tiles in a row, floats in a row of a plane, in a plane, cap, background (3,).

    free, floor: as in `formulas.Thresholds`.  row_offsets: the first row of pixels of each vector of a tile, `lanes` times: as
    vectors, they cost the kernels less than a conversion.
    """

    width: int
    height: int
    columns: int
    stride: int
    size: int
    cap: float
    free: float
    floor: float
    background: np.ndarray
    row_offsets: np.ndarray


class Pixels(NamedTuple):
    """Results of `forward` in each pixel: planes (red, green, blue, alpha), the final T, and where it stopped.

    The last two are for kernels alone, and lie tile by tile, row by row (`kept_at`).  Pixels beyond the image stop in front of
    all splats.  reached: (tiles,) how many intersections some pixel reaches.
    """

    planes: np.ndarray
    transmittance: np.ndarray
    stop: np.ndarray
    reached: np.ndarray


@formula
def next_tile(counter, lists, frame, tile):
    """The tile after a thread's last one (at first -1): the next of its group, or another group's first; -1 at the end.

    The tiles of a group share the cache lines of their rows: two threads that write to one line wait for each other.
    """
    if (tile + 1) % frame.columns % GROUP != 0:
        return tile + 1
    turn = fetch_and_increment(counter)
    return lists.order[turn] if turn < lists.order.size else np.int64(-1)


@formula
def next_corner(counter, lists, tile, lanes, frame):
    """Index in a plane of the first pixel of the tile after this one, unless another thread takes that."""
    following = tile + 1 if (tile + 1) % frame.columns % GROUP else lists.order[min(counter[0], lists.order.size - 1)]
    return corner_of(following, lanes, frame.columns, frame.stride)[2]


@formula
def corner_of(tile, lanes, columns, stride):
    """Column and row of a tile's first pixel, and its index in a plane."""
    x0, y0 = (tile % columns) * (lanes // PIXEL_ROWS), (tile // columns) * TILE_HEIGHT
    return x0, y0, y0 * stride + x0


@formula
def row_at(corner, y, frame):
    """Index in a plane of the first pixel of a tile's row y; corner: that of its first row."""
    return corner + PIXEL_ROWS * y * frame.stride


@formula
def kept_at(tile, y, L):
    """Index of a tile's row y in what lies tile by tile."""
    return (tile * TILE_ROWS + y) * L


@formula
def row_range(packed):
    """First row and one past the last row of an intersection."""
    return packed & 255, ((packed >> 8) & 255) + 1


@formula
def column_u(params, o, x0, columns):
    """u of columns, counted from x0; the mean is in double precision."""
    dx = x0 - load_double(params, o + MX)
    return fma(columns, params[o + ALONG], params[o + ALONG] * dx)


@formula
def column_v(params, o, x0, y0, columns):
    """v of columns, counted from x0, in row y0: far from the mean, v of a needle is a small difference of doubles."""
    dx, dy = x0 - load_double(params, o + MX), y0 - load_double(params, o + MY)
    return fma(columns, params[o + STEP], params[o + ACROSS] * (load_double(params, o + SHEAR) * dx + dy))


@formula
def alpha_terms(params, o, x0, y0):
    """u of a tile's columns, and what gives v and log2 alpha of its rows: v of row 0, its step, log2 o - u^2, cut."""
    # whitened offset of a pixel (dx, dy): u = along dx, v = across (shear dx + dy)
    across = params[o + ACROSS]
    # the columns are 0, 1, ... pixels from the corner; a row of pixels adds `across` to v
    columns = pixel_columns(params)
    u = column_u(params, o, x0, columns)
    v = fma(pixel_rows(params), across, column_v(params, o, x0, y0, columns))
    terms = (v, broadcast(params, across), fma(-u, u, params[o + LO]), broadcast(params, params[o + CUT]))
    return u, terms


@formula
def intersection(params, lists, e, k, x0, y0):
    """Intersection e, which is number k of its tile, as all kernels read it.

    Its splat, u of the columns, `alpha_terms`, colour, k, its first row and one past the last.
    """
    splat = np.int64(lists.splat[e])
    u, terms = alpha_terms(params, splat * PARAMS, x0, y0)
    top, bottom = row_range(lists.rows[e])
    colour = broadcast3(params, splat * PARAMS + RED)
    return splat, u, terms, colour, broadcast(params, k), top, bottom


@formula
def row_v(frame, L, y, terms):
    """v of a tile's row y."""
    return fma(load(frame.row_offsets, L * y), terms[1], terms[0])


@formula
def begin_undo_row(state, b, L, frame, pixels, kept):
    """Start a row behind all splats: T, STOP, and the background's colour times T.  kept: of `kept_at`."""
    last = load(pixels.transmittance, kept)
    store(state, b + T * L, last)
    store(state, b + STOP * L, load(pixels.stop, kept))
    for c in range(3):
        store(state, b + (BEHIND + c) * L, last * frame.background[c])


@formula
def undo_row(state, b, L, frame, v, terms, index):
    """Undo a splat in T of a row; w, and w and beta where the cap does not hold."""
    alpha, uncapped = alpha_row(v, terms, index < load(state, b + STOP * L), frame.cap)
    # T in front of the splat: T / (1 - alpha)
    r = reciprocal(1.0 - alpha)
    before = load(state, b + T * L) * r
    store(state, b + T * L, before)
    # where the cap holds alpha does not depend on q: no derivative
    w, free = alpha * before, uncapped <= frame.free
    return w, select(free, w, 0.0), select(free, alpha * r, 0.0)


@formula
def tangent_terms(tangents, j, u):
    """q' of a row as a quadratic in v, and the colour's tangent."""
    q = (tangents[j], tangents[j + 1], tangents[j + 2], tangents[j + 3], tangents[j + 4], tangents[j + 5])
    A, B, C = along_row(q, u)
    return (A, B, broadcast(tangents, C)), broadcast3(tangents, j + 6)


@formula
def broadcast3(array, i):
    return broadcast(array, array[i]), broadcast(array, array[i + 1]), broadcast(array, array[i + 2])


@formula
def load3(array, i, step):
    return load(array, i), load(array, i + step), load(array, i + 2 * step)


@formula
def store3(array, i, step, values):
    store(array, i, values[0])
    store(array, i + step, values[1])
    store(array, i + 2 * step, values[2])


@formula
def load_planes(planes, p, frame):
    """The row of pixels at p of three planes."""
    size, stride = frame.size, frame.stride
    return (
        load_pixels(planes, p, stride),
        load_pixels(planes, p + size, stride),
        load_pixels(planes, p + 2 * size, stride),
    )


@formula
def store_planes(planes, p, frame, image, alpha):
    """Write the row of pixels at p of four planes."""
    for c in range(3):
        store_pixels(planes, c * frame.size + p, frame.stride, image[c])
    store_pixels(planes, 3 * frame.size + p, frame.stride, alpha)


@formula
def fetch_row(planes, count, corner, i, frame):
    """Bring row i of a tile's pixels, in `count` planes, into the cache before it is read or written; i: any number.

    The rows of a tile lie far apart in memory, where the processor does not foresee them.
    """
    if i < TILE_HEIGHT:
        for plane in range(count):
            prefetch(planes, plane * frame.size + corner + i * frame.stride)


@formula
def load_cotangent(planes, p, frame):
    """v_image and v_alpha of a row."""
    red, green, blue = load_planes(planes, p, frame)
    return red, green, blue, load_pixels(planes, p + 3 * frame.size, frame.stride)


@formula
def intersections_of(lists, tile):
    """The first intersection of a tile, and how many it has."""
    first = np.int64(lists.start[tile])
    return first, lists.start[tile + 1] - first


@formula
def dark(planes, first_plane, count, corner, frame):
    """Whether `count` planes are exactly 0 all over a tile: a cotangent that leaves nothing to do."""
    lit, one = broadcast(planes, 0.0), broadcast(planes, 1.0)
    for plane in range(first_plane, first_plane + count):
        for y in range(TILE_ROWS):
            value = load_pixels(planes, plane * frame.size + row_at(corner, y, frame), frame.stride)
            lit = select((value >= 0.0) & (value <= 0.0), lit, one)  # NaN is neither
    return not any_lane(lit > 0.0)


@formula
def clear_sums(lists, first, count, width, sums):
    """Zeros for the sums, `width` an intersection, of a tile's intersections."""
    for e in range(first, first + count):
        at = np.int64(lists.accumulator[e]) * width
        for j in range(width):
            sums[at + j] = 0


@formula
def no_moments(params):
    """Sums over rows before the first: of s, s v, s v^2, and of w h for three channels."""
    zero = broadcast(params, 0.0)
    return zero, zero, zero, zero, zero, zero


@formula
def add_row(m, v, s, w, h):
    """The sums over rows m with one row more, of s at v and of w h."""
    t = row_terms(v, s, w, h)
    return m[0] + t[0], m[1] + t[1], m[2] + t[2], m[3] + t[3], m[4] + t[4], m[5] + t[5]


@formula
def store_moments(sums, accumulator, moments, u):
    """Sum over the columns, with their u, and write a splat's nine sums of this tile."""
    store_sums(sums, accumulator * SPLAT, column_terms(moments, u))
