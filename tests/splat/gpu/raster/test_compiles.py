"""Every kernel of the rasterizer compiles for GPUs, and keeps its numbers in registers."""

from importlib.metadata import version

from tests.splat.gpu.ahead_of_time import compile_kernel, run_as_script

INTEGERS = (
    "order", "start", "reached", "splat_of", "accumulators", "stop", "first_column", "count", "strip_rank", "strip_of",
    "first_tile", "splat", "moves",
)  # fmt: skip
LONG = ("strip_start", "first_of", "last")
DOUBLES = ("frame", "splats", "limits", "totals")
REALS = (
    "packed", "planes", "transmittance", "v_planes", "sums", "tangents", "transmittances", "dv_planes", "curvature",
    "moments", "product",
)  # fmt: skip


def types(real: str) -> dict[str, str]:
    """The types of the kernels' parameters by name."""
    pointers = dict.fromkeys(INTEGERS, "*i32") | dict.fromkeys(LONG, "*i64") | dict.fromkeys(DOUBLES, "*fp64")
    return pointers | dict.fromkeys(REALS, f"*{real}") | {"drawn": "*i8", "moved": "*i8"}


def kernels() -> list[tuple]:
    """Every kernel with the types of its parameters, its constants and its warps, as `cuda.py` launches it."""
    from splat.gpu.raster import binning as cuda_binning
    from splat.gpu.raster import blocks as cuda_blocks
    from splat.gpu.raster import compositing as cuda_compositing
    from splat.gpu.raster import packing as cuda_packing
    from splat.gpu.raster.raster import BLOCK, LAUNCH, ROWS, SIDE_BY_SIDE, TILE, TOGETHER
    from splat.render.formulas import SPLAT

    single, double = types("fp32"), types("fp64")  # the latter for a probe's own check
    tiled, blocked = LAUNCH["num_warps"], {"BLOCK": BLOCK}
    strips = {"BLOCK": cuda_binning.BLOCK, "WIDTH": cuda_binning.WIDTH}
    summed = {"WIDTH": SPLAT, "PADDED": 16, "TOGETHER": SIDE_BY_SIDE // 16, "BLOCK": ROWS}
    to_first = {"first": "*i32"}
    return [
        (cuda_binning.count_strips, single | to_first, strips, 4),
        (cuda_binning.count_rows, single | to_first, strips | {"HEIGHT": cuda_binning.HEIGHT}, 4),
        (cuda_binning.list_intersections, single | {"tile": "*i16"}, {"BLOCK": cuda_binning.BLOCK}, 4),
        (cuda_packing.pack_splats, single, blocked, 4),
        (cuda_packing.reduce_sums, single | {"first": "*i64"}, summed, 1),
        (cuda_packing.reduce_tangents, single, blocked, 4),
        (cuda_compositing.forward, single, TILE, tiled),
        (cuda_compositing.forward, double, TILE, tiled),
        (cuda_compositing.backward, single, TILE | {"ATOMIC": False}, tiled),
        (cuda_compositing.backward, single, TILE | {"ATOMIC": True}, tiled),
        (cuda_compositing.tangent, single, TILE | {"K": TOGETHER}, tiled),
        (cuda_compositing.backward_tangent, single, TILE | {"K": TOGETHER, "ATOMIC": False}, tiled),
        (cuda_blocks.block_moments, single, TILE | {"ATOMIC": False}, tiled),
        (cuda_compositing.backward, double, TILE | {"ATOMIC": False}, tiled),
        (cuda_compositing.tangent, double, TILE | {"K": TOGETHER}, tiled),
        (cuda_compositing.backward_tangent, double, TILE | {"K": TOGETHER, "ATOMIC": False}, tiled),
        (cuda_blocks.block_moments, double, TILE | {"ATOMIC": False}, tiled),
    ]


def test_every_kernel_compiles_and_keeps_its_loops_in_registers():
    lines = run_as_script(__file__)
    assert len(lines) == 17
    # a number or two, kept outside the loops; Triton 3.6 puts 176 bytes of two curvatures at once there
    most = 16 if tuple(map(int, version("triton").split(".")[:2])) >= (3, 9) else 176
    for line in lines:
        name, real, registers, stack = line.split()
        assert 16 <= int(registers) <= 255, name
        assert int(stack) <= most or real == "*fp64", name


if __name__ == "__main__":
    for kernel, parameters, constants, warps in kernels():
        print(kernel.__name__, parameters["packed"], *compile_kernel(kernel, parameters, constants, warps))
