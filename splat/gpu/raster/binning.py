"""Tile lists on the GPU: which splats touch which tiles of an image, in order of depth.

The same ellipses as on the CPU (`binning.py`, whose formulas are compiled here for Triton), in even steps: no
thread has more work for a larger splat:

    strips     of every splat, the columns of tiles of its box: a count, a prefix sum, one item a strip
    intersections    of every strip, its rows of tiles inside the ellipse: a count, a prefix sum, one item an intersection
    sort       intersections are made in order of depth (ties in the order of the splats), so a stable radix sort by tile leaves
               them in order of (tile, depth); tile numbers are 16 bits wide where they fit, which halves the passes

Before that sort the intersections of a splat lie side by side: their places there number the accumulators of their sums.
Two sizes are read back: the numbers of strips and of intersections.
"""

# pyright: reportGeneralTypeIssues=false
# (Triton tells type checkers little of its language)

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float, Int
from torch import Tensor

from landscape.errors import InputError
from splat.gpu.language.compile import jit, launch, sized
from splat.gpu.language.formula import triton_formula
from splat.render import formulas

WIDTH, HEIGHT = 16, 16  # of a tile, in pixels
BLOCK = 256
LIMIT = 2**31  # places and accumulators of intersections are 32 bits wide

ellipse_of, box_of = triton_formula(formulas.ellipse_of), triton_formula(formulas.box_of)
rows_of_strip = triton_formula(formulas.rows_of_strip)


class Lists(NamedTuple):
    """Splats that touch each tile.  An intersection is a splat in a tile; those of a tile are in order of depth.

    start: (tiles + 1,) first intersection of each tile; tile, splat: (intersections,); place: (intersections,) their numbers,
    splat by splat; splat_start: (n + 1,) first place of the splats in order of depth; order: (n,) which splats these are.
    """

    start: Int[Tensor, "tiles_1"]
    tile: Int[Tensor, "intersections"]
    splat: Int[Tensor, "intersections"]
    place: Int[Tensor, "intersections"]
    splat_start: Int[Tensor, "n_1"]
    order: Int[Tensor, "n"]


class Accumulators(NamedTuple):
    """Places of the sums of the intersections that some pixel reaches.

    place: (intersections,), without meaning for those that none reaches; first, last: (n,), splat i's are first[i] ..
    last[i] - 1.
    """

    place: Int[Tensor, "intersections"]
    first: Int[Tensor, "n"]
    last: Int[Tensor, "n"]


@jit
def load_six(array, at, inside):
    """Six numbers side by side."""
    found = ()
    for j in tl.static_range(6):
        found = found + (tl.load(array + at + j, inside, other=0.0),)
    return found


@jit
def load_splat(splats, i, inside):
    """Mean, conic and opacity of the splats i; nowhere drawn outside."""
    return load_six(splats, i.to(tl.int64) * 9, inside)


@sized("n")
def count_strips(
    order, drawn, splats, limits, first, count, n, width, height, WIDTH: tl.constexpr, BLOCK: tl.constexpr
):
    """The first column of tiles of each splat's box and their number, in order of depth.  limits: alpha_min, contour."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    s = tl.load(order + i, inside, other=0)
    splat = load_splat(splats, s, inside)
    ellipse = ellipse_of(splat, tl.load(limits), tl.load(limits + 1))
    x0, x1, y0, y1 = box_of(splat, ellipse, width, height)
    some = (x0 <= x1) & (y0 <= y1) & (tl.load(drawn + s, inside, other=0) != 0)
    x0, x1 = x0.to(tl.int32), x1.to(tl.int32)
    tl.store(first + i, x0 // WIDTH, inside)
    tl.store(count + i, tl.where(some, x1 // WIDTH - x0 // WIDTH + 1, 0), inside)


@sized("strips", "columns")
def count_rows(
    strip_rank, order, splats, limits, first_column, strip_start, first, count, strips, columns, width, height,
    WIDTH: tl.constexpr, HEIGHT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The first tile of each strip and the number of its tiles, one under the other."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < strips
    rank = tl.load(strip_rank + i, inside, other=0)
    splat = load_splat(splats, tl.load(order + rank, inside, other=0), inside)
    column = (tl.load(first_column + rank, inside, other=0) + i - tl.load(strip_start + rank, inside, other=0)).to(
        tl.int32
    )
    ellipse = ellipse_of(splat, tl.load(limits), tl.load(limits + 1))
    y0, y1 = rows_of_strip(splat, ellipse, column, WIDTH, width, height)
    y0, y1 = y0.to(tl.int32), y1.to(tl.int32)
    tl.store(first + i, y0 // HEIGHT * columns + column, inside)
    tl.store(count + i, tl.where(y0 <= y1, y1 // HEIGHT - y0 // HEIGHT + 1, 0), inside)


@sized("intersections", "columns")
def list_intersections(
    strip_of, strip_rank, order, first_of, first_tile, tile, splat, intersections, columns, BLOCK: tl.constexpr
):
    """The tile and the splat of every intersection."""
    e = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = e < intersections
    strip = tl.load(strip_of + e, inside, other=0)
    down = (e - tl.load(first_of + strip, inside, other=0)).to(tl.int32)
    tl.store(tile + e, tl.load(first_tile + strip, inside, other=0) + down * columns, inside)
    tl.store(splat + e, tl.load(order + tl.load(strip_rank + strip, inside, other=0), inside, other=0), inside)


def grid(size: int, block: int = BLOCK) -> tuple[int]:
    return (triton.cdiv(size, block),)


def starts(count: Int[Tensor, "n"]) -> Int[Tensor, "n_1"]:
    """The prefix sum of counts, from 0 to their total."""
    start = torch.zeros(len(count) + 1, dtype=torch.int64, device=count.device)
    torch.cumsum(count, 0, out=start[1:])
    return start


def repeated(count: Int[Tensor, "n"], start: Int[Tensor, "n_1"]) -> Int[Tensor, "total"]:
    """The index i, count[i] times over; reads the total back.  ValueError where it is beyond what the kernels count to."""
    total = int(start[-1])
    if total >= LIMIT:
        raise InputError(
            f"expected fewer than 2^31 tiles that splats touch in a view, got {total}; render smaller images, or Gaussians "
            "that are fewer or smaller"
        )
    return torch.repeat_interleave(count, output_size=total)


def bin_splats(
    splats: Float[Tensor, "n 9"],
    depths: Float[Tensor, "n"],
    drawn: Bool[Tensor, "n"],
    width: int,
    height: int,
    limits: Float[Tensor, "2"],
) -> Lists:
    """The tile lists of a view; limits: alpha_min and the contour's distance, in double precision."""
    n, device = len(splats), splats.device
    columns = triton.cdiv(width, WIDTH)
    tiles = columns * triton.cdiv(height, HEIGHT)
    order = torch.argsort(depths, stable=True).to(torch.int32)
    first_column, count = (torch.empty(n, dtype=torch.int32, device=device) for _ in range(2))
    launch(
        count_strips, grid(n), order, drawn.to(torch.int8), splats, limits, first_column, count, n, width, height,
        WIDTH=WIDTH, BLOCK=BLOCK,
    )  # fmt: skip
    strip_start = starts(count)
    strip_rank = repeated(count, strip_start)
    strips = len(strip_rank)
    first_tile, rows = (torch.empty(strips, dtype=torch.int32, device=device) for _ in range(2))
    launch(
        count_rows, grid(strips), strip_rank, order, splats, limits, first_column, strip_start, first_tile, rows, strips,
        columns, width, height, WIDTH=WIDTH, HEIGHT=HEIGHT, BLOCK=BLOCK,
    )  # fmt: skip
    first_of = starts(rows)
    strip_of = repeated(rows, first_of)
    intersections = len(strip_of)
    tile = torch.empty(intersections, dtype=torch.int16 if tiles < 2**15 else torch.int32, device=device)
    splat = torch.empty(intersections, dtype=torch.int32, device=device)
    launch(
        list_intersections, grid(intersections), strip_of, strip_rank, order, first_of, first_tile, tile, splat,
        intersections, columns,
        BLOCK=BLOCK,
    )  # fmt: skip
    tile, place = torch.sort(tile, stable=True)
    start = torch.searchsorted(tile, torch.arange(tiles + 1, dtype=tile.dtype, device=device), out_int32=True)
    return Lists(start, tile, splat[place], place.to(torch.int32), first_of[strip_start], order)


def kept_intersections(lists: Lists, reached: Int[Tensor, "tiles"]) -> Bool[Tensor, "intersections"]:
    """Mask of the intersections that some pixel reaches, given their number in each tile."""
    tile = lists.tile.to(torch.int32)
    index = torch.arange(len(tile), dtype=torch.int32, device=tile.device)
    return index < (lists.start[:-1] + reached)[tile]


def number_accumulators(lists: Lists, reached: Int[Tensor, "tiles"]) -> Accumulators:
    """The accumulators of the intersections that some pixel reaches, splat by splat."""
    kept, n = kept_intersections(lists, reached), len(lists.order)
    by_place = torch.empty_like(kept)
    by_place[lists.place] = kept
    number = starts(by_place)
    edges = number[lists.splat_start]
    first, last = (torch.empty(n, dtype=torch.int64, device=kept.device) for _ in range(2))
    first[lists.order], last[lists.order] = edges[:-1], edges[1:]
    return Accumulators(number[lists.place].to(torch.int32), first, last)
