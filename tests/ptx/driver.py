"""A stand-in for a GPU's driver: Triton compiles for sm_90 and launches as usual, and `machine.py` runs what it launches."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor


def target() -> Any:
    """An H100 or H200, as Triton describes it."""
    from triton.backends.compiler import GPUTarget

    return GPUTarget("cuda", 90, 32)


def stand_in() -> None:
    """Give this process a driver with all that Triton needs to compile and to choose kernels."""
    from triton.runtime import driver

    driver.set_active(
        SimpleNamespace(  # pyright: ignore[reportArgumentType]
            get_current_device=lambda: 0,
            get_current_stream=lambda _device: 0,
            get_current_target=target,
            utils=SimpleNamespace(unload_module=lambda _module: None),
        )
    )


@contextmanager
def emulator() -> Iterator[None]:
    """Within the context kernels are launched by the stand-in and run by the machine."""
    from triton.compiler.compiler import CompiledKernel
    from triton.runtime import driver

    before, handles = vars(driver).copy(), CompiledKernel._init_handles
    stand_in()
    CompiledKernel._init_handles = _run_by_the_machine  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        vars(driver).update(before)
        CompiledKernel._init_handles = handles


def _run_by_the_machine(kernel: Any) -> None:
    """In place of loading a compiled kernel: what Triton calls to launch it."""
    from tests.ptx import machine

    constants = [(i,) in kernel.src.constants for i in range(len(kernel.src.fn.arg_names))]

    def run(x: int, y: int, z: int, *told: Any) -> None:  # stream, function, metadata twice, two hooks, arguments
        arguments = [a for a, constant in zip(told[6:], constants, strict=True) if not constant]
        about = kernel.metadata
        machine.launch(kernel.asm["ptx"], (x, y, z), about.num_warps, about.shared, arguments)

    kernel.module = kernel._run = run


def unwritten(make: Any) -> Any:
    """A function that makes uninitialised tensors, which then hold NaN, the least integer or True."""

    def made(*arguments: Any, **named: Any) -> Tensor:
        tensor: Tensor = make(*arguments, **named)
        if tensor.dtype == torch.bool:
            return tensor.fill_(True)
        return tensor.fill_(torch.nan if tensor.is_floating_point() else torch.iinfo(tensor.dtype).min)

    return made
