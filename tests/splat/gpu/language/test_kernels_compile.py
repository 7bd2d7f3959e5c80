"""Every kernel of the projection, of the losses, of Adam and of the bench compiles for GPUs, without a GPU."""

from tests.splat.gpu.ahead_of_time import compile_kernel, run_as_script

LONG, INTEGERS = ("index",), ("n", "m", "K", "height", "width", "start", "count", "v_stride", "out_stride", "steps")
DOUBLES = ("lens", "splats", "bar", "distances", "losses")


def types(kernel, double: tuple[str, ...] = ()) -> dict[str, str]:
    """Of the parameters by name, with parameters in float32."""
    special = dict.fromkeys(LONG, "*i64") | dict.fromkeys(INTEGERS, "i32") | {"drawn": "*i1"}
    special |= dict.fromkeys(("a", "b"), "fp32")
    special |= dict.fromkeys((*DOUBLES, *double), "*fp64")
    return {name: special.get(name, "*fp32") for name in kernel.arg_names}


def kernels() -> list[tuple]:
    """Every kernel, its parameters that are in double precision beside the usual ones, and its constants."""
    from splat.gpu import adam
    from splat.gpu import loss_kernels as losses
    from splat.gpu import projection_kernels as projection

    few, lanes, wide = {"BLOCK": 128}, {"BLOCK": 8}, {"BLOCK": 16, "VECTORS": 8}
    bands, ssim, pixels = {"BANDS": 4}, {"KIND": 1, "SSIM": True}, {"BLOCK": 256}
    both = {"SLOPES": True, "SECOND": True}
    return [
        *(
            (kernel, (), common | {"ANTIALIASED": antialiased})
            for antialiased in (False, True)
            for kernel, common in (
                (projection.project_splats, few | bands),
                (projection.project_adjoint, few | bands),
                (projection.linearize_geometry, lanes),
                (projection.push_forward, wide | bands),
                (projection.pull_back, wide | bands | {"SECOND_ORDER": True}),
            )
        ),
        (projection.linearize_colour, (), lanes | bands),
        (projection.convert, ("out",), few | {"WAY": 3}),
        (losses.blur_along, (), pixels),
        (losses.feed, (), pixels | {"FIELDS": 3}),
        (losses.feed, (), pixels | {"FIELDS": 2}),
        (losses.moments_along, (), pixels),
        (losses.moments_down, (), pixels),
        (losses.differentiate, (), pixels | both | {"MARGIN": 5}),
        (losses.finish_gradient, (), pixels | ssim | {"SLOPES": True}),
        (losses.curve, (), pixels),
        (losses.finish_product, (), pixels | ssim),
        (losses.forms, ("full", "pixelwise"), pixels | ssim),
        (losses.finish_diagonal, (), pixels | ssim),
        (losses.differentiate_pair, (), pixels | {"MARGIN": 5}),
        (losses.finish_pair, (), pixels | ssim),
        (adam._step, ("numbers",), {"BLOCK": 1024, "BETA1": 0.9, "BETA2": 0.999, "EPS": 1e-15, "GRID": 1e-28}),
    ]


def test_every_kernel_of_projection_and_losses_compiles():
    lines = run_as_script(__file__)
    assert len(lines) == 26
    for line in lines:
        name, registers, _ = line.split()
        assert 16 <= int(registers) <= 255, name


if __name__ == "__main__":
    for kernel, double, constants in kernels():
        print(kernel.__name__, *compile_kernel(kernel, types(kernel, double), constants, 4), flush=True)
