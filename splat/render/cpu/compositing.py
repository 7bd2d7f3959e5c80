"""The compositing kernels of first order: `forward` renders front to back, `backward` differentiates back to front.

The formulas stand in `render/formulas.py`, with alpha, w, T, R, s and beta as they are named here; tiles, intersections and
the arrays in `tile.py`.  A kernel's thread takes tile after tile, and of each tile splat after splat; it keeps what each
pixel has so far in `state`, row by row.

L        lanes: the pixels of a tile's row, which are one vector (two rows of the image: `tile.py`)
e, k     an intersection: its place in all lists, and its number in its tile, 0 in front
u, v     whitened offset of a pixel from the splat's mean: u is the same in all rows of a tile, v follows by `row_v`
terms    what gives v and log2 alpha of any row of the tile (`tile.alpha_terms`)
top, bottom   the first row that the splat touches, and one past the last
b, p, kept   where a row begins: in `state`, in a plane of the picture, and in what lies tile by tile (`tile.Pixels`)
T, STOP, IMAGE, REST, GRAD   in code, the vectors of a row in `state`, by number (a colour takes three): T lies at b + T * L;
         a row has FORWARD or BACKWARD of them
T        in formulas, transmittance; `forward` keeps -T in front of the splat that stopped a pixel: its sign says "stopped"
v_x      cotangent: the loss's derivative in x
"""

import numpy as np

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.memory import PIXEL_ROWS, TILE_ROWS, pixel_columns, pixel_rows, scratch
from splat.backend.cpu.simd import any_lane, broadcast, fma, lanes, load, maximum, prefetch, select, store
from splat.render.cpu.tile import (
    AHEAD,
    BACKWARD,
    FORWARD,
    GRAD,
    IMAGE,
    PARAMS,
    REST,
    STOP,
    T,
    add_row,
    clear_sums,
    corner_of,
    dark,
    fetch_row,
    intersection,
    intersections_of,
    kept_at,
    load3,
    load_cotangent,
    next_corner,
    next_tile,
    no_moments,
    row_at,
    row_v,
    store3,
    store_moments,
    store_planes,
)
from splat.render.formulas import SPLAT, alpha_row, behind_all, plus, step_back

# --- forward ----------------------------------------------------------------------------------------------------------


@kernel
def forward(counter, params, lists, frame, pixels):
    """Render: fill `pixels` with colour, alpha, the final T and the number of the splat that stops each pixel."""
    L = lanes(params)
    state = scratch(params, FORWARD * L * TILE_ROWS)
    tile = next_tile(counter, lists, frame, -1)
    while tile >= 0:
        x0, y0, corner = corner_of(tile, L, frame.columns, frame.stride)
        # nothing in front yet: T = 1, black, and no pixel has stopped but those beyond the image
        inside = pixel_columns(params) < broadcast(params, frame.width - x0)
        for y in range(TILE_ROWS):
            b = FORWARD * L * y
            here = inside & (pixel_rows(params) < broadcast(params, frame.height - y0 - PIXEL_ROWS * y))
            store(state, b + T * L, select(here, broadcast(params, 1.0), -1.0))
            store(state, b + STOP * L, 0.0)
            store3(state, b + IMAGE * L, L, (0.0, 0.0, 0.0))
        first, count = intersections_of(lists, tile)
        # front to back, with each splat a row of the planes fetched; every 16 splats: have all pixels stopped?
        for k in range(count):
            prefetch(params, np.int64(lists.splat[first + min(k + AHEAD, count - 1)]) * PARAMS)
            fetch_row(pixels.planes, 4, corner, k, frame)
            composite(params, lists, first + k, k, x0, y0, frame, state)
            if (k & 15) == 15 and all_stopped(state, L):
                break
        furthest = broadcast(params, 0.0)
        for y in range(TILE_ROWS):
            furthest = maximum(furthest, load(state, (FORWARD * y + STOP) * L))
            end_row(state, FORWARD * L * y, L, frame, pixels, row_at(corner, y, frame), kept_at(tile, y, L))
        store(state, 0, furthest)
        pixels.reached[tile] = np.int64(state[:L].max())
        tile = next_tile(counter, lists, frame, tile)


@formula
def composite(params, lists, e, k, x0, y0, frame, state):
    """Composite intersection e, number k of its tile."""
    L = lanes(params)
    _splat, _u, terms, colour, index, top, bottom = intersection(params, lists, e, k, x0, y0)
    following = index + 1.0
    for y in range(top, bottom):
        b = FORWARD * L * y
        before = load(state, b + T * L)
        alpha, _uncapped = alpha_row(row_v(frame, L, y, terms), terms, None, frame.cap)
        after = fma(-alpha, before, before)  # T - alpha T, rounded once
        # other pixels stop in front of the splat, or have stopped: T's sign turns, or stays
        runs = after >= frame.floor
        store(state, b + T * L, select(runs, after, -abs(before)))
        store(state, b + STOP * L, select(runs, following, load(state, b + STOP * L)))
        # image += w c with the splat's colour c
        w = select(runs, alpha * before, 0.0)
        store3(state, b + IMAGE * L, L, plus(load3(state, b + IMAGE * L, L), w, colour))


@formula
def end_row(state, b, L, frame, pixels, p, kept):
    """Add the background to a row, and write its colour and alpha at p of each plane, its final T and stops at `kept`."""
    last = abs(load(state, b + T * L))
    store(pixels.transmittance, kept, last)
    store(pixels.stop, kept, load(state, b + STOP * L))
    image = plus(load3(state, b + IMAGE * L, L), last, frame.background)
    store_planes(pixels.planes, p, frame, image, 1.0 - last)


@formula
def all_stopped(state, L):
    """Whether no pixel of the tile has a positive T."""
    for y in range(TILE_ROWS):
        if any_lane(load(state, (FORWARD * y + T) * L) > 0.0):
            return False
    return True


# --- backward ---------------------------------------------------------------------------------------------------------


@kernel
def backward(counter, params, lists, frame, pixels, v_planes, sums):
    """The nine sums of every intersection, from the loss's derivative in the planes; those of a splat make its adjoint.

    v_planes: derivatives in red, green, blue and alpha of each pixel.  sums: six moments of s, then three sums of w v_image.
    """
    L = lanes(params)
    state = scratch(params, BACKWARD * L * TILE_ROWS)
    tile = next_tile(counter, lists, frame, -1)
    while tile >= 0:
        x0, y0, corner = corner_of(tile, L, frame.columns, frame.stride)
        for y in range(TILE_ROWS):
            # behind all splats: the final T, and R of the background
            p, kept = row_at(corner, y, frame), kept_at(tile, y, L)
            begin_backward_row(state, BACKWARD * L * y, L, frame, pixels, v_planes, p, kept)
        first, count = intersections_of(lists, tile)
        # a tile without cotangent adds nothing
        if dark(v_planes, 0, 4, corner, frame):
            clear_sums(lists, first, count, SPLAT, sums)
            count = 0
        # back to front, with each splat a row of the next tile fetched
        following = next_corner(counter, lists, tile, L, frame)
        for k in range(count - 1, -1, -1):
            fetch_row(v_planes, 4, following, count - 1 - k, frame)
            later = first + max(k - AHEAD, 0)
            prefetch(params, np.int64(lists.splat[later]) * PARAMS)
            prefetch(sums, np.int64(lists.accumulator[later]) * SPLAT)
            differentiate(params, lists, first + k, k, x0, y0, frame, state, sums)
        tile = next_tile(counter, lists, frame, tile)


@formula
def begin_backward_row(state, b, L, frame, pixels, v_planes, p, kept):
    """Start a row behind all splats: the final T, where it stopped, R of the background, v_image."""
    last, v_pixel = load(pixels.transmittance, kept), load_cotangent(v_planes, p, frame)
    store(state, b + T * L, last)
    store(state, b + STOP * L, load(pixels.stop, kept))
    store(state, b + REST * L, last * behind_all(v_pixel, frame.background))
    store3(state, b + GRAD * L, L, v_pixel)


@formula
def differentiate(params, lists, e, k, x0, y0, frame, state, sums):
    """Step in front of intersection e in each row, and write its sums."""
    L = lanes(params)
    _splat, u, terms, colour, index, top, bottom = intersection(params, lists, e, k, x0, y0)
    moments = no_moments(params)
    for y in range(top, bottom):
        b = BACKWARD * L * y
        v = row_v(frame, L, y, terms)
        # alpha as in `forward`
        alpha, uncapped = alpha_row(v, terms, index < load(state, b + STOP * L), frame.cap)
        R, v_image = load(state, b + REST * L), load3(state, b + GRAD * L, L)
        # T and R in front of the splat; s, the derivative in ln alpha, is 0 where alpha before the cap is above frame.free
        before, rest, w, beta, _r, we = step_back(alpha, load(state, b + T * L), R, v_image, colour)
        s = select(uncapped <= frame.free, we - beta * R, 0.0)  # we: w (v_image . c)
        store(state, b + T * L, before)
        store(state, b + REST * L, rest)
        # add s, s v, s v^2 and w v_image to the sums over rows; sums over columns, with their u, come once, at the end
        moments = add_row(moments, v, s, w, v_image)
    store_moments(sums, np.int64(lists.accumulator[e]), moments, u)
