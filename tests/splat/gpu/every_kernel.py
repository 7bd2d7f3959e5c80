"""Every kernel compiles for GPUs, without one, and those of the rasterizer keep their numbers in registers.

That takes the best part of a minute: `make test-release` runs it.  On a GPU the tests marked `cuda` compile them all.
"""

from importlib.metadata import version

from tests.splat.gpu.ahead_of_time import compile_kernel, run_as_script

INTEGERS = (
    "order start reached splat_of accumulators stop first_column count strip_rank strip_of first_tile splat moves"
)
REALS = "packed planes transmittance v_planes sums tangents transmittances dv_planes curvature moments product"
DOUBLES = dict.fromkeys(("lens", "splats", "bar", "distances", "losses"), "*fp64")
NUMBERS = "n m K height width start count v_stride out_stride steps"
PLAIN = dict.fromkeys(NUMBERS.split(), "i32") | {"index": "*i64", "drawn": "*i1", "a": "fp32", "b": "fp32"} | DOUBLES


def of_raster(real: str) -> dict[str, str]:
    """The types of the rasterizer's parameters by name; numbers that are not here are integers."""
    pointers = dict.fromkeys(INTEGERS.split(), "*i32") | dict.fromkeys(("strip_start", "first_of", "last"), "*i64")
    pointers |= dict.fromkeys(("frame", "splats", "limits", "totals"), "*fp64")
    return pointers | dict.fromkeys(REALS.split(), f"*{real}") | {"drawn": "*i8", "moved": "*i8"}


def rasterizer() -> list[tuple]:
    """Its kernels with the types of their parameters, their constants and their warps, as `raster.py` launches them."""
    from splat.gpu.raster import binning, blocks, compositing, packing
    from splat.gpu.raster.raster import BLOCK, LAUNCH, ROWS, SIDE_BY_SIDE, TILE, TOGETHER
    from splat.render.formulas import SPLAT

    single, double = of_raster("fp32"), of_raster("fp64")  # the latter for a probe's own check
    tiled, several = LAUNCH["num_warps"], TILE | {"K": TOGETHER}
    strips = {"BLOCK": binning.BLOCK, "WIDTH": binning.WIDTH}
    summed = {"WIDTH": SPLAT, "PADDED": 16, "TOGETHER": SIDE_BY_SIDE // 16, "BLOCK": ROWS}
    found = [
        (binning.count_strips, single | {"first": "*i32"}, strips, 4),
        (binning.count_rows, single | {"first": "*i32"}, strips | {"HEIGHT": binning.HEIGHT}, 4),
        (binning.list_intersections, single | {"tile": "*i16"}, {"BLOCK": binning.BLOCK}, 4),
        (packing.pack_splats, single, {"BLOCK": BLOCK}, 4),
        (packing.reduce_sums, single | {"first": "*i64"}, summed, 1),
        (packing.reduce_tangents, single, {"BLOCK": BLOCK}, 4),
        (compositing.backward, single, TILE | {"ATOMIC": True}, tiled),
    ]
    for types in (single, double):
        found += [
            (compositing.forward, types, TILE, tiled),
            (compositing.backward, types, TILE | {"ATOMIC": False}, tiled),
            (compositing.tangent, types, several, tiled),
            (compositing.backward_tangent, types, several | {"ATOMIC": False}, tiled),
            (blocks.block_moments, types, TILE | {"ATOMIC": False}, tiled),
        ]
    return found


def others() -> list[tuple]:
    """The kernels of the projection, of the losses and of Adam."""
    from splat.gpu import adam, loss_kernels, projection_kernels

    few, lanes, wide = {"BLOCK": 128}, {"BLOCK": 8}, {"BLOCK": 16, "VECTORS": 8}
    bands, ssim, pixels = {"BANDS": 4}, {"KIND": 1, "SSIM": True}, {"BLOCK": 256}
    given = [
        (projection_kernels.project_splats, few | bands),
        (projection_kernels.project_adjoint, few | bands),
        (projection_kernels.linearize_geometry, lanes),
        (projection_kernels.push_forward, wide | bands),
        (projection_kernels.pull_back, wide | bands | {"SECOND_ORDER": True}),
    ]
    given = [(kernel, constants | {"ANTIALIASED": on}) for on in (False, True) for kernel, constants in given]
    given += [
        (projection_kernels.linearize_colour, lanes | bands),
        (projection_kernels.convert, few | {"WAY": 3}),
        (loss_kernels.blur_along, pixels),
        (loss_kernels.feed, pixels | {"FIELDS": 3}),
        (loss_kernels.feed, pixels | {"FIELDS": 2}),
        (loss_kernels.moments_along, pixels),
        (loss_kernels.moments_down, pixels),
        (loss_kernels.differentiate, pixels | {"SLOPES": True, "SECOND": True, "MARGIN": 5}),
        (loss_kernels.finish_gradient, pixels | ssim | {"SLOPES": True}),
        (loss_kernels.curve, pixels),
        (loss_kernels.finish_product, pixels | ssim),
        (loss_kernels.forms, pixels | ssim),
        (loss_kernels.finish_diagonal, pixels | ssim),
        (loss_kernels.differentiate_pair, pixels | {"MARGIN": 5}),
        (loss_kernels.finish_pair, pixels | ssim),
        (adam._step, {"BLOCK": 1024, "BETA1": 0.9, "BETA2": 0.999, "EPS": 1e-15, "GRID": 1e-28}),
    ]
    more = {"convert": ("out",), "forms": ("full", "pixelwise"), "_step": ("numbers",)}
    found = []
    for kernel, constants in given:
        special = PLAIN | dict.fromkeys(more.get(kernel.__name__, ()), "*fp64")
        found.append((kernel, {name: special.get(name, "*fp32") for name in kernel.arg_names}, constants, 4))
    return found


def test_every_kernel_compiles_and_the_rasterizer_keeps_its_loops_in_registers():
    lines = [line.split() for line in run_as_script(__file__)]
    assert len(lines) == 17 + 26
    # a number or two, kept outside the loops; Triton 3.6 puts 176 bytes of two curvatures at once there
    most = 16 if tuple(map(int, version("triton").split(".")[:2])) >= (3, 9) else 176
    for name, real, registers, stack in lines:
        assert 16 <= int(registers) <= 255, name
        assert int(stack) <= most or real != "*fp32", name


if __name__ == "__main__":
    for kernel, types, constants, warps in rasterizer() + others():
        print(kernel.__name__, types.get("packed", "-"), *compile_kernel(kernel, types, constants, warps), flush=True)
