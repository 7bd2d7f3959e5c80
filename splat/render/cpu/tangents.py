"""The compositing kernels for Hessian products: `tangent` (J u), front to back, and `backward_tangent`, back to front.

Letters are those of `render/formulas.py`: T, R, w, beta, r, tau, s, h; d.. marks a tangent, v_.. a cotangent.  `.._block`: K
tangents share the primal quantities of a splat's rows, which stay in the first-level cache between them (`shared`).
`.._single`: the same for K = 1, in one loop over the rows.  `state`: for each row of a tile the vectors that `tile.py` lists,
those of a tangent K times.
"""

import numpy as np

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.memory import TILE_ROWS, scratch
from splat.backend.cpu.simd import fma, lanes, load, prefetch, select, store
from splat.render.cpu.compositing import begin_backward_row
from splat.render.cpu.tile import (
    AHEAD,
    BACKWARD,
    BACKWARD_TANGENT,
    DGRAD,
    DIMAGE,
    DREST,
    DT,
    GRAD,
    PARAMS,
    REST,
    STOP,
    TANGENT,
    TAU,
    T,
    add_row,
    clear_sums,
    corner_of,
    dark,
    intersection,
    intersections_of,
    kept_at,
    load3,
    load_cotangent,
    next_tile,
    no_moments,
    row_at,
    row_v,
    store3,
    store_moments,
    store_planes,
    tangent_terms,
)
from splat.render.formulas import (
    SPLAT,
    alpha_row,
    behind_all,
    plus,
    quadratic,
    step_back,
    step_backward_tangent,
    step_tangent,
)


@kernel
def tangent(counter, params, tangents, lists, frame, pixels, planes, transmittances):
    """J u for K tangents: their planes (K, 4 planes) and the tangents of the final transmittances, as these in `Pixels`."""
    L = lanes(params)
    K = transmittances.size // frame.size
    width = (2 + TANGENT * K) * L
    state = scratch(params, width * TILE_ROWS)
    shared = scratch(params, 3 * L * TILE_ROWS)  # a row: alpha, w, w where the cap does not hold
    tile = next_tile(counter, lists, frame, -1)
    while tile >= 0:
        x0, y0, corner = corner_of(tile, L, frame.columns, frame.stride)
        for y in range(TILE_ROWS):
            store(state, width * y + T * L, 1.0)
            store(state, width * y + STOP * L, load(pixels.stop, kept_at(tile, y, L)))
            for j in range(2, 2 + TANGENT * K):
                store(state, width * y + j * L, 0.0)
        first, count = intersections_of(lists, tile)
        for k in range(count):
            later = np.int64(lists.splat[first + min(k + AHEAD, count - 1)])
            prefetch(params, later * PARAMS)
            for i in range(K):
                prefetch(tangents, (later * K + i) * SPLAT)
            if K == 1:
                tangent_single(params, tangents, lists, first + k, k, x0, y0, frame, state)
            else:
                tangent_block(params, tangents, K, lists, first + k, k, x0, y0, frame, state, shared)
        for y in range(TILE_ROWS):
            p, kept = row_at(corner, y, frame), kept_at(tile, y, L)
            for i in range(K):
                end_tangent_row(state, width * y + (2 + TANGENT * i) * L, L, frame, planes, transmittances, i, p, kept)
        tile = next_tile(counter, lists, frame, tile)


@formula
def end_tangent_row(state, b, L, frame, planes, transmittances, i, p, kept):
    """Add the background's part to a row of tangent i, and write it to the planes."""
    dT = load(state, b + DT * L)
    store(transmittances, i * frame.size + kept, dT)
    dimage = plus(load3(state, b + DIMAGE * L, L), dT, frame.background)
    store_planes(planes, 4 * i * frame.size + p, frame, dimage, -dT)


@formula
def tangent_row(state, b, L, alpha, w, w_dq, colour, dcolour):
    """Advance T' and image' of a row of pixels by one splat.  w_dq: w q', 0 where the cap holds."""
    dT, dimage = step_tangent(load(state, b + DT * L), load3(state, b + DIMAGE * L, L), alpha, w, w_dq, colour, dcolour)
    store(state, b + DT * L, dT)
    store3(state, b + DIMAGE * L, L, dimage)


@formula
def tangent_single(params, tangents, lists, e, k, x0, y0, frame, state):
    """Advance the rows of a tile by intersection e, number k of the tile, for one tangent."""
    L = lanes(params)
    splat, u, terms, colour, index, top, bottom = intersection(params, lists, e, k, x0, y0)
    dterms, dcolour = tangent_terms(tangents, splat * SPLAT, u)
    for y in range(top, bottom):
        b = (2 + TANGENT) * L * y
        v = row_v(frame, L, y, terms)
        # alpha and T as in `forward`
        alpha, uncapped = alpha_row(v, terms, index < load(state, b + STOP * L), frame.cap)
        before = load(state, b + T * L)
        store(state, b + T * L, fma(-alpha, before, before))
        # q' = the tangent's quadratic in v, 0 where the cap holds
        dq = select(uncapped <= frame.free, quadratic(v, dterms), 0.0)
        w = alpha * before
        tangent_row(state, b + 2 * L, L, alpha, w, w * dq, colour, dcolour)


@formula
def tangent_block(params, tangents, K, lists, e, k, x0, y0, frame, state, shared):
    """Advance the rows of a tile by intersection e, number k of the tile, for K tangents."""
    L = lanes(params)
    width = (2 + TANGENT * K) * L
    splat, u, terms, colour, index, top, bottom = intersection(params, lists, e, k, x0, y0)
    # first what all tangents share: alpha, w, and w without the cap's pixels
    for y in range(top, bottom):
        b = width * y
        alpha, uncapped = alpha_row(row_v(frame, L, y, terms), terms, index < load(state, b + STOP * L), frame.cap)
        before = load(state, b + T * L)
        store(state, b + T * L, fma(-alpha, before, before))
        w = alpha * before
        free = select(uncapped <= frame.free, w, 0.0)
        store3(shared, 3 * L * y, L, (alpha, w, free))
    # then each tangent over the rows, which are in the cache
    for i in range(K):
        dterms, dcolour = tangent_terms(tangents, (splat * K + i) * SPLAT, u)
        for y in range(top, bottom):
            dq = quadratic(row_v(frame, L, y, terms), dterms)
            alpha, w, free = load3(shared, 3 * L * y, L)
            tangent_row(state, width * y + (2 + TANGENT * i) * L, L, alpha, w, free * dq, colour, dcolour)


@kernel
def backward_tangent(counter, params, tangents, lists, frame, pixels, v_planes, transmittances, dv_planes, sums):
    """The nine sums of the tangent of `backward` for K tangents, (intersections, K, SPLAT).

    v_planes: the cotangent, 4 planes; dv_planes: its tangents, (K, 4 planes); transmittances: those that `tangent` wrote.
    """
    L = lanes(params)
    K = transmittances.size // frame.size
    width = (BACKWARD + BACKWARD_TANGENT * K) * L
    state = scratch(params, width * TILE_ROWS)
    shared = scratch(params, 4 * L * TILE_ROWS)  # a row: w, beta, r R, and alpha without the cap
    tile = next_tile(counter, lists, frame, -1)
    while tile >= 0:
        x0, y0, corner = corner_of(tile, L, frame.columns, frame.stride)
        for y in range(TILE_ROWS):
            p, kept = row_at(corner, y, frame), kept_at(tile, y, L)
            begin_backward_row(state, width * y, L, frame, pixels, v_planes, p, kept)
            for i in range(K):
                b = width * y + (BACKWARD + BACKWARD_TANGENT * i) * L
                begin_tangent_row(state, b, L, frame, pixels, v_planes, transmittances, dv_planes, i, p, kept)
        first, count = intersections_of(lists, tile)
        plain = dark(v_planes, 0, 4, corner, frame)
        if plain and dark(dv_planes, 0, 4 * K, corner, frame):
            clear_sums(lists, first, count, K * SPLAT, sums)
            count = 0
        for k in range(count - 1, -1, -1):
            later = first + max(k - AHEAD, 0)
            splat = np.int64(lists.splat[later])
            prefetch(params, splat * PARAMS)
            for i in range(K):
                prefetch(tangents, (splat * K + i) * SPLAT)
                prefetch(sums, (np.int64(lists.accumulator[later]) * K + i) * SPLAT)
            if K == 1:
                backward_tangent_single(params, tangents, lists, first + k, k, x0, y0, frame, state, sums)
            else:
                backward_tangent_block(params, tangents, K, lists, first + k, k, x0, y0, frame, state, shared, sums)
        tile = next_tile(counter, lists, frame, tile)


@formula
def begin_tangent_row(state, b, L, frame, pixels, v_planes, transmittances, dv_planes, i, p, kept):
    """Start tau, R' and v_image' of tangent i behind all splats, for the row of pixels at p."""
    last, dT = load(pixels.transmittance, kept), load(transmittances, i * frame.size + kept)
    v_pixel = load_cotangent(v_planes, p, frame)
    dv_pixel = load_cotangent(dv_planes, 4 * i * frame.size + p, frame)
    # tau = T' / T, and R = T (v_image . background + ...) differentiated
    store(state, b + TAU * L, dT / last)
    rest = dT * behind_all(v_pixel, frame.background) + last * behind_all(dv_pixel, frame.background)
    store(state, b + DREST * L, rest)
    store3(state, b + DGRAD * L, L, dv_pixel)


@formula
def backward_row(state, b, L, alpha, v_image, colour):
    """Undo a splat in T and R of a row; its w, beta and r R."""
    R = load(state, b + REST * L)
    before, rest, w, beta, r, _we = step_back(alpha, load(state, b + T * L), R, v_image, colour)
    store(state, b + T * L, before)
    store(state, b + REST * L, rest)
    return w, beta, r * R


@formula
def backward_tangent_row(state, b, L, w, beta, rR, dq, v_image, colour, dcolour):
    """Undo a splat in tau and R' of a row; its s', which does not yet heed the cap, and h."""
    tau, dR, dv_image = load(state, b + TAU * L), load(state, b + DREST * L), load3(state, b + DGRAD * L, L)
    tau, dR, ds, h = step_backward_tangent(tau, dR, dv_image, w, beta, rR, dq, v_image, colour, dcolour)
    store(state, b + TAU * L, tau)
    store(state, b + DREST * L, dR)
    return ds, h


@formula
def backward_tangent_single(params, tangents, lists, e, k, x0, y0, frame, state, sums):
    """Undo intersection e, number k of its tile, and write its sums, for one tangent."""
    L = lanes(params)
    splat, u, terms, colour, index, top, bottom = intersection(params, lists, e, k, x0, y0)
    dterms, dcolour = tangent_terms(tangents, splat * SPLAT, u)
    moments = no_moments(params)
    for y in range(top, bottom):
        b = (BACKWARD + BACKWARD_TANGENT) * L * y
        v = row_v(frame, L, y, terms)
        # undo the splat in T and R
        alpha, uncapped = alpha_row(v, terms, index < load(state, b + STOP * L), frame.cap)
        v_image = load3(state, b + GRAD * L, L)
        w, beta, rR = backward_row(state, b, L, alpha, v_image, colour)
        # and in tau and R', for s' and h
        dq = select(uncapped <= frame.free, quadratic(v, dterms), 0.0)
        ds, h = backward_tangent_row(state, b + BACKWARD * L, L, w, beta, rR, dq, v_image, colour, dcolour)
        # s' is 0 where the cap holds; h belongs to the colour
        moments = add_row(moments, v, select(uncapped <= frame.free, ds, 0.0), w, h)
    store_moments(sums, np.int64(lists.accumulator[e]), moments, u)


@formula
def backward_tangent_block(params, tangents, K, lists, e, k, x0, y0, frame, state, shared, sums):
    """Undo intersection e, number k of its tile, and write its sums, for K tangents."""
    L = lanes(params)
    width = (BACKWARD + BACKWARD_TANGENT * K) * L
    splat, u, terms, colour, index, top, bottom = intersection(params, lists, e, k, x0, y0)
    # first what all tangents share: w, beta, r R, and alpha without the cap
    for y in range(top, bottom):
        b, x = width * y, 4 * L * y
        alpha, uncapped = alpha_row(row_v(frame, L, y, terms), terms, index < load(state, b + STOP * L), frame.cap)
        store3(shared, x, L, backward_row(state, b, L, alpha, load3(state, b + GRAD * L, L), colour))
        store(shared, x + 3 * L, uncapped)
    # then the sums of each tangent
    for i in range(K):
        dterms, dcolour = tangent_terms(tangents, (splat * K + i) * SPLAT, u)
        moments = no_moments(params)
        for y in range(top, bottom):
            b, x = width * y, 4 * L * y
            v = row_v(frame, L, y, terms)
            w, beta, rR = load3(shared, x, L)
            free, v_image = load(shared, x + 3 * L) <= frame.free, load3(state, b + GRAD * L, L)
            dq = select(free, quadratic(v, dterms), 0.0)
            b += (BACKWARD + BACKWARD_TANGENT * i) * L
            ds, h = backward_tangent_row(state, b, L, w, beta, rR, dq, v_image, colour, dcolour)
            moments = add_row(moments, v, select(free, ds, 0.0), w, h)
        store_moments(sums, np.int64(lists.accumulator[e]) * K + i, moments, u)
