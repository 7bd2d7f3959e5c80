"""Stands in for a GPU's driver: Triton compiles for sm_90 and launches as ever, and the machine runs what it launches."""

from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor


def target() -> Any:
    """An H100 or H200, as Triton knows it."""
    from triton.backends.compiler import GPUTarget

    return GPUTarget("cuda", 90, 32)


def stand_in() -> None:
    """A driver for this process, which has not launched anything: all of it that Triton needs to compile and to choose
    kernels.
    """
    from triton.runtime import driver

    driver.set_active(
        SimpleNamespace(  # pyright: ignore[reportArgumentType]
            get_current_device=lambda: 0,
            get_current_stream=lambda _device: 0,
            get_current_target=target,
            utils=SimpleNamespace(unload_module=lambda _module: None),
        )
    )


def install() -> None:
    """The driver, and the machine for what is launched."""
    from triton.compiler.compiler import CompiledKernel

    from tests.ptx import machine

    def handles(kernel: Any) -> None:
        def run(
            x: int, y: int, z: int, _stream: Any, _function: Any, _packed: Any, _launch: Any, *hooks_and_all: Any
        ) -> None:
            arguments = [a for a, constant in zip(hooks_and_all[2:], constants, strict=True) if not constant]
            about = kernel.metadata
            machine.launch(kernel.asm["ptx"], (x, y, z), about.num_warps, about.shared, arguments)

        constants = [(i,) in kernel.src.constants for i in range(len(kernel.src.fn.arg_names))]
        kernel.module = kernel._run = run

    stand_in()
    CompiledKernel._init_handles = handles  # pyright: ignore[reportAttributeAccessIssue]


def unwritten(make: Any) -> Any:
    """Of a function that leaves memory as it is: what nobody wrote is not a number, the least one, or true."""

    def made(*arguments: Any, **named: Any) -> Tensor:
        tensor: Tensor = make(*arguments, **named)
        if tensor.dtype == torch.bool:
            return tensor.fill_(True)
        return tensor.fill_(torch.nan if tensor.is_floating_point() else torch.iinfo(tensor.dtype).min)

    return made
