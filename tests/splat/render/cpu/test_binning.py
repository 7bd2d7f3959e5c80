"""Depth order, and tile lists that hold exactly what is drawn."""

import numpy as np
import pytest
import torch

from splat.backend.cpu.jit import kernel
from splat.backend.cpu.memory import PIXEL_ROWS, TILE_ROWS
from splat.backend.cpu.simd import lanes_of
from splat.model.settings import RenderSettings
from splat.render.cpu.binning import bin_splats, depth_order, heaviest_first, radix_argsort
from splat.render.cpu.tile import next_tile
from splat.render.formulas import thresholds_of
from tests.splat.render.compositing_cases import CASES, truth
from tests.splat.tolerances import DTYPES, NUMPY


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_depths_ascend_and_equal_ones_keep_the_order_of_their_index(dtype):
    generator = np.random.default_rng(0)
    depths = np.exp(generator.normal(size=5000) * 20).astype(dtype)
    depths[generator.integers(0, 5000, 2000)] = 3.0
    drawn = generator.random(5000) < 0.8
    index = np.flatnonzero(drawn)
    assert (depth_order(depths, drawn) == index[np.argsort(depths[index], kind="stable")]).all()


@pytest.mark.parametrize("highest", [0, 1, 26, 31])
def test_the_radix_sort_orders_every_bit(highest):
    keys = np.random.default_rng(1).integers(0, 2 ** (highest + 1), 3000, dtype=np.uint32)
    keys[:500] = keys[500:1000] ^ np.uint32(1 << highest)
    expected = np.argsort(keys, kind="stable")
    assert (radix_argsort(keys.copy(), np.arange(3000, dtype=np.int32), highest // 3 + 1) == expected).all()


def test_the_radix_sort_reads_the_bits_by_which_depths_differ(monkeypatch):
    bits, sort = [], "splat.render.cpu.binning.radix_argsort"
    monkeypatch.setattr(sort, lambda keys, index, width: bits.append(width) or index)
    for depths in ([3.0], [1.0, 1.5, 1.25], [0.01, 1e6]):
        depth_order(np.array(depths, np.float32), np.ones(len(depths), bool))
    assert bits == [0, 8, 10]


def test_the_heaviest_row_of_tiles_comes_first():
    assert heaviest_first(np.array([3, 1, 9, 0, 2, 6]), 2).tolist() == [2, 4, 0]


def test_a_faint_splat_whose_determinant_rounds_to_zero_is_in_no_tile():
    splats = np.array([[5.0, 6.0, 1.0, 1.0, 1.0, opacity, 0.5, 0.5, 0.5] for opacity in (1e-12, 0.0, 0.5)])
    thresholds = thresholds_of(RenderSettings(), torch.float64)
    found = bin_splats(splats, np.arange(1.0, 4.0), np.ones(3, bool), 40, 30, thresholds)
    assert set(found.splat) == {2} and found.start[-1] == found.start.size - 1  # what is drawn is in every tile


def active_pixels(name: str) -> np.ndarray:
    """Where each splat is drawn, (n, h, w), in double precision."""
    case, settings = truth(name).case, CASES[name].settings
    (width, height), splats = case.size, truth(name).splats.numpy()
    mx, my, a, b, c, opacity = splats[:, :6].T[:, :, None, None]
    dx, dy = np.arange(width) + 0.5 - mx, np.arange(height)[:, None] + 0.5 - my
    squared = a * dx * dx + 2 * b * dx * dy + c * dy * dy
    active = opacity * np.exp(-squared / 2) >= settings.alpha_min
    if settings.contour_sigma is not None:
        active &= squared <= settings.contour_sigma**2
    return active & truth(name).drawn.numpy()[:, None, None]


@pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])
@pytest.mark.parametrize("name", ["typical", "opaque", "three sigma", "equal depths", "less than a tile", "one column"])
def test_tile_lists_hold_every_active_row_and_hardly_any_other(name, dtype):
    expected, raster = truth(name), truth(name).raster(dtype)
    lists, L, columns = raster.lists, lanes_of(NUMPY[dtype]), raster.frame.columns
    n, (width, height) = expected.case.n, expected.case.size
    padded = np.zeros((n, *raster.plane), bool)
    padded[:, :height, :width] = active_pixels(name)
    # (n, vectors of pixels down the image, columns)
    rows_of_tiles = padded.reshape(n, -1, PIXEL_ROWS, columns, L // PIXEL_ROWS).any(axis=(2, 4))
    listed = np.zeros_like(rows_of_tiles)
    depths = expected.depths.numpy()
    for tile in range(lists.start.size - 1):
        entries = slice(lists.start[tile], lists.start[tile + 1])
        keys = [(depths[i], i) for i in lists.splat[entries]]
        assert keys == sorted(keys) and len(set(keys)) == len(keys)
        for i, packed in zip(lists.splat[entries], lists.rows[entries], strict=True):
            top = tile // columns * TILE_ROWS
            listed[i, top + (packed & 255) : top + (packed >> 8 & 255) + 1, tile % columns] = True
    assert not (rows_of_tiles & ~listed).any()
    # a row may be listed in vain where the ellipse's edge passes between two pixel centres
    assert rows_of_tiles.sum() > 0.75 * listed.sum()


def test_vectors_of_two_rows_of_pixels_hold_fewer_pixels_outside_of_small_splats_than_rows_as_long():
    raster, (width, height), L = truth("typical").raster(DTYPES[0]), truth("typical").case.size, lanes_of(np.float32)
    padded = np.zeros((truth("typical").case.n, *raster.plane), bool)
    padded[:, :height, :width] = active_pixels("typical")
    in_rows = L * padded.reshape(len(padded), -1, L).any(axis=2).sum()
    assert padded.sum() < raster.pairs < in_rows


@kernel
def tiles_taken(counter, lists, frame, taken):
    for k in range(taken.size):
        taken[k] = next_tile(counter, lists, frame, taken[k - 1] if k else -1)


def test_a_thread_takes_the_tiles_of_a_cache_line_one_after_the_other_and_all_once():
    raster = truth("typical").raster(DTYPES[0])
    columns, line = raster.frame.columns, 64 // (4 * lanes_of(np.float32) // PIXEL_ROWS)
    for lists in (raster.lists, raster.reached[0]):
        taken = np.empty(lists.start.size - 1, np.int64)
        tiles_taken(np.zeros(1, np.int64), lists, raster.frame, taken)
        assert sorted(taken) == list(range(taken.size))
        assert all(taken[k] == taken[k - 1] + 1 for k in range(1, taken.size) if taken[k] % columns % line)
        tiles_taken(np.ones(1, np.int64), lists, raster.frame, taken)  # another thread has taken a group
        assert (taken[-min(line, columns) :] == -1).all() and (taken[: -min(line, columns)] >= 0).all()


def test_entries_that_no_pixel_reaches_are_dropped_and_the_others_numbered_splat_by_splat():
    raster = truth("walled").raster(DTYPES[0])
    before, stops = raster.lists, raster.pixels.stop.reshape(raster.lists.start.size - 1, -1).max(axis=1)
    after, start = raster.reached
    assert after.splat.size < before.splat.size
    for tile, stop in enumerate(stops):
        all_of_it = slice(before.start[tile], before.start[tile + 1])
        kept = slice(after.start[tile], after.start[tile + 1])
        reached = int(min(stop, all_of_it.stop - all_of_it.start))
        assert after.splat[kept].tolist() == before.splat[all_of_it][:reached].tolist()
        assert after.rows[kept].tolist() == before.rows[all_of_it][:reached].tolist()
    assert sorted(after.accumulator) == list(range(after.splat.size)) and start[-1] == after.splat.size
    assert ((start[after.splat] <= after.accumulator) & (after.accumulator < start[after.splat + 1])).all()
