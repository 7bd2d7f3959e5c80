"""Tile lists for GPUs hold exactly what is drawn, in order of depth."""

import numpy as np
import pytest
import torch

pytest.importorskip("triton", reason="the kernels for GPUs need triton; pip install -e '.[gpu]'")

from splat.gpu.raster.binning import HEIGHT, WIDTH, bin_splats, number_accumulators, repeated, starts
from tests.splat.render.compositing_cases import CASES, truth
from tests.splat.render.cpu.test_binning import active_pixels


def lists_of(name: str, device: torch.device):
    expected, settings = truth(name), CASES[name].settings
    contour = np.inf if settings.contour_sigma is None else settings.contour_sigma
    limits = torch.tensor([settings.alpha_min, contour], dtype=torch.float64, device=device)
    splats, depths, drawn = expected.splats.to(device), expected.depths.to(device), expected.drawn.to(device)
    return bin_splats(splats, depths, drawn, *expected.case.size, limits)


@pytest.mark.parametrize("name", ["typical", "opaque", "three sigma", "equal depths", "less than a tile", "one column"])
def test_tile_lists_hold_the_tiles_that_a_splat_is_drawn_in_and_hardly_any_other(name, device):
    lists, (width, height), depths = lists_of(name, device), truth(name).case.size, truth(name).depths.tolist()
    columns, rows = -(-width // WIDTH), -(-height // HEIGHT)
    n = truth(name).case.n
    padded = np.zeros((n, rows * HEIGHT, columns * WIDTH), bool)
    padded[:, :height, :width] = active_pixels(name)
    drawn = padded.reshape(n, rows, HEIGHT, columns, WIDTH).any(axis=(2, 4)).reshape(n, -1)
    listed = np.zeros_like(drawn)
    listed[lists.splat.cpu(), lists.tile.cpu()] = True
    assert not (drawn & ~listed).any()
    assert drawn.sum() > 0.95 * listed.sum() == 0.95 * len(lists.splat)
    for tile in range(columns * rows):
        entries = slice(lists.start[tile], lists.start[tile + 1])
        keys = [(depths[i], i) for i in lists.splat[entries].tolist()]
        assert keys == sorted(keys) and (lists.tile[entries] == tile).all()


def test_the_intersections_that_are_reached_are_numbered_splat_by_splat(device):
    lists = lists_of("opaque", device)
    per_tile = lists.start.diff()
    reached = per_tile - per_tile // 3
    found = number_accumulators(lists, reached)
    kept = torch.cat([torch.arange(int(a), int(a + r)) for a, r in zip(lists.start[:-1], reached, strict=True)])
    place, splat = found.place.cpu()[kept], lists.splat.cpu().long()[kept]
    assert len(kept) < len(lists.splat) and sorted(place.tolist()) == list(range(len(kept)))
    assert ((found.first.cpu()[splat] <= place) & (place < found.last.cpu()[splat])).all()
    assert (found.last - found.first).sum() == len(kept)


def test_more_intersections_than_32_bits_number_are_refused():
    count = torch.tensor([2**30, 2**30], dtype=torch.int32)
    with pytest.raises(ValueError, match=r"fewer than 2\^31 tiles.*got 2147483648"):
        repeated(count, starts(count))
