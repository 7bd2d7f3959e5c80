"""Compile Triton kernels for an H100 or H200 (sm_90) without a GPU, in a process of their own."""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest


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


def compile_kernel(kernel: Any, types: dict[str, str], constants: dict[str, Any], num_warps: int) -> tuple[int, int]:
    """Registers and bytes of stack (where registers are spilled) a thread of a kernel.

    types: of its parameters by name, 32-bit integers where none is given.
    """
    import triton
    from triton.compiler import ASTSource

    signature = {name: "constexpr" if name in constants else types.get(name, "i32") for name in kernel.arg_names}
    source = ASTSource(kernel, signature, constants)
    options = {"num_warps": num_warps, "enable_fp_fusion": True}
    assembly = triton.compile(source, target=target(), options=options).asm
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(assembly["cubin"])
        file.flush()
        reader = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
        usage = subprocess.run([reader, "--dump-resource-usage", file.name], capture_output=True, text=True, check=True)
    registers, stack = re.findall(r"REG:(\d+) STACK:(\d+)", usage.stdout)[0]
    return int(registers), int(stack)


def run_as_script(path: str) -> list[str]:
    """The lines that a test file prints when it is run as a script, where kernels can be compiled."""
    triton = pytest.importorskip("triton", reason="the kernels for GPUs need triton; pip install -e '.[gpu]'")
    if not (Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "ptxas").exists():
        pytest.skip("this build of triton has no assembler for NVIDIA GPUs")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "TRITON_INTERPRET": "0"}
    done = subprocess.run([sys.executable, path], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()
