"""The compositing kernels of second order: `tangent` (J u), front to back, and `curvature` (of `backward`), back to front.

K tangents share the primal quantities of a splat's rows (`formulas.py`); `_single` is the code for K = 1, in one loop.
"""

import numpy as np

from splat.backend.cpu.jit import formula, kernel
from splat.backend.cpu.planes import TILE_ROWS, scratch
from splat.backend.cpu.simd import broadcast, fma, lanes, load, prefetch, select, store
from splat.raster.cpu.compositing import begin_backward_row
from splat.raster.cpu.tile import (
    AHEAD,
    CAPPED,
    DRED,
    PARAMS,
    RED,
    SUMS,
    TANGENTS,
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
    tangent_terms,
)
from splat.raster.formulas import alpha_row, behind_all, quadratic, step_back, step_curvature, step_tangent

# --- tangent: J u -----------------------------------------------------------------------------------------------------


@kernel
def tangent(counter, params, tangents, lists, frame, pixels, planes, transmittances):
    """J u for K tangents: their planes (K, 4 planes) and the tangents of the final transmittance (K planes)."""
    L = lanes(params)
    K = transmittances.size // frame.size
    width = (2 + 4 * K) * L
    state = scratch(params, width * TILE_ROWS)  # a row: T, stop, for each tangent T', image' (3)
    shared = scratch(params, 3 * L * TILE_ROWS)  # a row: alpha, w, w where the cap does not hold
    tile = next_tile(counter, lists)
    while tile >= 0:
        x0, y0, corner = corner_of(tile, L, frame.columns, frame.stride)
        for y in range(TILE_ROWS):
            b = width * y
            store(state, b, 1.0)
            store(state, b + L, load(pixels.stop, corner + y * frame.stride))
            for j in range(2, 2 + 4 * K):
                store(state, b + j * L, 0.0)
        first, count = reached(lists, tile, pixels, corner, frame.stride)
        for k in range(count):
            later = np.int64(lists.splat[first + min(k + AHEAD, count - 1)])
            prefetch(params, later * PARAMS)
            for i in range(K):
                prefetch(tangents, (later * K + i) * TANGENTS)
            if K == 1:
                tangent_entry_single(params, tangents, lists, first + k, k, x0, y0, frame, state)
            else:
                tangent_entry_block(params, tangents, K, lists, first + k, k, x0, y0, frame, state, shared)
        for y in range(TILE_ROWS):
            p = corner + y * frame.stride
            for i in range(K):
                end_tangent_row(state, width * y + (2 + 4 * i) * L, L, frame, planes, transmittances, i, p)
        tile = next_tile(counter, lists)


@formula
def end_tangent_row(state, b, L, frame, planes, transmittances, i, p):
    dT = load(state, b)
    store(transmittances, i * frame.size + p, dT)
    for c in range(3):
        store(planes, (4 * i + c) * frame.size + p, load(state, b + (1 + c) * L) + dT * frame.background[c])
    store(planes, (4 * i + 3) * frame.size + p, -dT)


@formula
def tangent_row(state, b, L, alpha, w, w_dq, colour, dcolour):
    dT, dimage = step_tangent(load(state, b), load3(state, b + L, L), alpha, w, w_dq, colour, dcolour)
    store(state, b, dT)
    store3(state, b + L, L, dimage)


@formula
def tangent_entry_single(params, tangents, lists, e, k, x0, y0, frame, state):
    L = lanes(params)
    splat = np.int64(lists.splat[e])
    o = splat * PARAMS
    u, terms = alpha_terms(params, o, x0, y0)
    colour, dcolour = broadcast3(params, o + RED), broadcast3(tangents, splat * TANGENTS + DRED)
    dterms = tangent_terms(tangents, splat * TANGENTS, u)
    capped = lists.rows[e] & CAPPED
    index = broadcast(params, k)
    top, bottom = row_range(lists.rows[e])
    for y in range(top, bottom):
        b = 6 * L * y
        v = row_v(frame, L, y, terms)
        alpha, uncapped = alpha_row(v, terms, index < load(state, b + L), frame.cap)
        T = load(state, b)
        w = alpha * T
        store(state, b, fma(-alpha, T, T))
        dq = quadratic(v, dterms)
        if capped:
            dq = select(uncapped <= frame.cap, dq, 0.0)
        tangent_row(state, b + 2 * L, L, alpha, w, w * dq, colour, dcolour)


@formula
def tangent_entry_block(params, tangents, K, lists, e, k, x0, y0, frame, state, shared):
    L = lanes(params)
    width = (2 + 4 * K) * L
    splat = np.int64(lists.splat[e])
    o = splat * PARAMS
    u, terms = alpha_terms(params, o, x0, y0)
    colour = broadcast3(params, o + RED)
    index = broadcast(params, k)
    top, bottom = row_range(lists.rows[e])
    for y in range(top, bottom):
        b = width * y
        alpha, uncapped = alpha_row(row_v(frame, L, y, terms), terms, index < load(state, b + L), frame.cap)
        T = load(state, b)
        w = alpha * T
        store(state, b, fma(-alpha, T, T))
        free = select(uncapped <= frame.cap, w, 0.0) if lists.rows[e] & CAPPED else w
        store3(shared, 3 * L * y, L, (alpha, w, free))
    for i in range(K):
        j = (splat * K + i) * TANGENTS
        dterms, dcolour = tangent_terms(tangents, j, u), broadcast3(tangents, j + DRED)
        for y in range(top, bottom):
            dq = quadratic(row_v(frame, L, y, terms), dterms)
            alpha, w, free = load3(shared, 3 * L * y, L)
            tangent_row(state, width * y + (2 + 4 * i) * L, L, alpha, w, free * dq, colour, dcolour)


# --- curvature: the tangent of backward -------------------------------------------------------------------------------


@kernel
def curvature(counter, params, tangents, lists, frame, pixels, cotangent, transmittances, cotangents, sums):
    """Moments of the tangent of `backward` for K tangents, (entries, K, SUMS).

    cotangent: g, 4 planes; cotangents: g' of every tangent, (K, 4 planes); transmittances: as `tangent` left them.
    """
    L = lanes(params)
    K = transmittances.size // frame.size
    width = (6 + 5 * K) * L
    state = scratch(params, width * TILE_ROWS)  # a row: T, R, g (3), stop, for each tangent tau, R', g' (3)
    shared = scratch(params, 4 * L * TILE_ROWS)  # a row: w, beta, r R, 1 where the cap does not hold
    tile = next_tile(counter, lists)
    while tile >= 0:
        x0, y0, corner = corner_of(tile, L, frame.columns, frame.stride)
        for y in range(TILE_ROWS):
            p = corner + y * frame.stride
            begin_backward_row(state, width * y, L, frame, pixels, cotangent, p)
            for i in range(K):
                b = width * y + (6 + 5 * i) * L
                begin_curvature_row(state, b, L, frame, pixels, cotangent, transmittances, cotangents, i, p)
        first, count = reached(lists, tile, pixels, corner, frame.stride)
        plain = dark(cotangent, 0, 4, corner, frame.size, frame.stride)
        if plain and dark(cotangents, 0, 4 * K, corner, frame.size, frame.stride):
            clear_entries(lists, first, count, K * SUMS, sums)
            count = 0
        for k in range(count - 1, -1, -1):
            later = first + max(k - AHEAD, 0)
            splat = np.int64(lists.splat[later])
            prefetch(params, splat * PARAMS)
            for i in range(K):
                prefetch(tangents, (splat * K + i) * TANGENTS)
                prefetch(sums, (np.int64(lists.slots[later]) * K + i) * SUMS)
            if K == 1:
                curvature_entry_single(params, tangents, lists, first + k, k, x0, y0, frame, state, sums)
            else:
                curvature_entry_block(params, tangents, K, lists, first + k, k, x0, y0, frame, state, shared, sums)
        tile = next_tile(counter, lists)


@formula
def begin_curvature_row(state, b, L, frame, pixels, cotangent, transmittances, cotangents, i, p):
    q = 4 * i * frame.size + p
    T, dT = load(pixels.transmittance, p), load(transmittances, i * frame.size + p)
    g, dg = load_cotangent(cotangent, p, frame.size), load_cotangent(cotangents, q, frame.size)
    store(state, b, dT / T)
    store(state, b + L, dT * behind_all(g, frame.background) + T * behind_all(dg, frame.background))
    store3(state, b + 2 * L, L, dg)


@formula
def curvature_row(state, b, L, w, beta, rR, dq, g, colour, dcolour):
    """s' and h of a row, and the update of tau and R'."""
    tau, dR, dg = load(state, b), load(state, b + L), load3(state, b + 2 * L, L)
    tau, dR, ds, h = step_curvature(tau, dR, dg, w, beta, rR, dq, g, colour, dcolour)
    store(state, b, tau)
    store(state, b + L, dR)
    return ds, h


@formula
def backward_row(state, b, L, alpha, g, colour):
    """Restore T and advance R; w, beta and r R of a row."""
    R = load(state, b + L)
    T, after, w, beta, r, _we = step_back(alpha, load(state, b), R, g, colour)
    store(state, b, T)
    store(state, b + L, after)
    return w, beta, r * R


@formula
def curvature_entry_single(params, tangents, lists, e, k, x0, y0, frame, state, sums):
    L = lanes(params)
    splat = np.int64(lists.splat[e])
    o = splat * PARAMS
    u, terms = alpha_terms(params, o, x0, y0)
    colour, dcolour = broadcast3(params, o + RED), broadcast3(tangents, splat * TANGENTS + DRED)
    dterms = tangent_terms(tangents, splat * TANGENTS, u)
    capped = lists.rows[e] & CAPPED
    index = broadcast(params, k)
    moments = no_moments(params)
    top, bottom = row_range(lists.rows[e])
    for y in range(top, bottom):
        b = 11 * L * y
        v = row_v(frame, L, y, terms)
        alpha, uncapped = alpha_row(v, terms, index < load(state, b + 5 * L), frame.cap)
        g = load3(state, b + 2 * L, L)
        w, beta, rR = backward_row(state, b, L, alpha, g, colour)
        dq = quadratic(v, dterms)
        if capped:
            dq = select(uncapped <= frame.cap, dq, 0.0)
        ds, h = curvature_row(state, b + 6 * L, L, w, beta, rR, dq, g, colour, dcolour)
        if capped:
            ds = select(uncapped <= frame.cap, ds, 0.0)
        moments = add_row(moments, v, ds, w, h)
    store_moments(sums, np.int64(lists.slots[e]), moments, u)


@formula
def curvature_entry_block(params, tangents, K, lists, e, k, x0, y0, frame, state, shared, sums):
    L = lanes(params)
    width = (6 + 5 * K) * L
    splat = np.int64(lists.splat[e])
    o = splat * PARAMS
    u, terms = alpha_terms(params, o, x0, y0)
    colour = broadcast3(params, o + RED)
    capped = lists.rows[e] & CAPPED
    index = broadcast(params, k)
    top, bottom = row_range(lists.rows[e])
    for y in range(top, bottom):
        b, x = width * y, 4 * L * y
        alpha, uncapped = alpha_row(row_v(frame, L, y, terms), terms, index < load(state, b + 5 * L), frame.cap)
        g = load3(state, b + 2 * L, L)
        store3(shared, x, L, backward_row(state, b, L, alpha, g, colour))
        if capped:
            store(shared, x + 3 * L, select(uncapped <= frame.cap, broadcast(params, 1.0), 0.0))
    for i in range(K):
        j = (splat * K + i) * TANGENTS
        dterms, dcolour = tangent_terms(tangents, j, u), broadcast3(tangents, j + DRED)
        moments = no_moments(params)
        for y in range(top, bottom):
            b, x = width * y, 4 * L * y
            v = row_v(frame, L, y, terms)
            w, beta, rR = load3(shared, x, L)
            g = load3(state, b + 2 * L, L)
            dq = quadratic(v, dterms)
            if capped:
                dq *= load(shared, x + 3 * L)
            ds, h = curvature_row(state, b + (6 + 5 * i) * L, L, w, beta, rR, dq, g, colour, dcolour)
            if capped:
                ds *= load(shared, x + 3 * L)
            moments = add_row(moments, v, ds, w, h)
        store_moments(sums, np.int64(lists.slots[e]) * K + i, moments, u)
