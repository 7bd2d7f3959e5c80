"""A GPU's kernels on tensors of the CPU, by Triton's interpreter: the same sources, block by block in NumPy.

What a GPU's own compiler, memory and order of threads add is seen on a GPU alone: `pytest -m cuda`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

from splat.render.backend import BACKENDS, CPU


@contextmanager
def interpreter() -> Iterator[None]:
    """Within the context the interpreter runs what is launched, and formulas give it their operations."""
    from triton.runtime.interpreter import InterpretedFunction, interpreter_builder, interpreter_semantic

    from splat.gpu.language.compile import Kernel
    from splat.gpu.language.formula import Formula

    interpreted, formula = cache(lambda kernel: InterpretedFunction(kernel.fn)), Formula.__call__

    def emitted(self: Formula, *arguments: Any, _semantic: Any = None) -> Any:
        return formula(self, *arguments, _semantic=interpreter_semantic)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Kernel, "run", lambda self, *given, **named: interpreted(self).run(*given, **named))
        # two thirds of the time: what a kernel calls finds Triton's language as the launch has patched it and need not patch
        # it anew; and whether integers overflow is computed for a `device_assert` that the interpreter leaves out
        patch.setattr(Kernel, "__call__", lambda self, *given, **named: interpreted(self).rewrite()(*given, **named))
        patch.setattr(Formula, "__call__", emitted)
        patch.setattr(interpreter_builder, "options", replace(interpreter_builder.options, sanitize_overflow=False))
        yield


def emulate(monkeypatch: pytest.MonkeyPatch, on: bool = True) -> None:
    """From now on, to the end of a test: the GPU's kernels for tensors on the CPU, or (on=False) the CPU's own again."""
    from splat.gpu.backend import CUDA  # needs triton

    monkeypatch.setitem(BACKENDS, "cpu", CUDA if on else CPU)


def unwritten(make: Any) -> Any:
    """A function that makes uninitialised tensors, which then hold NaN, the least integer or True."""

    def made(*arguments: Any, **named: Any) -> Tensor:
        tensor: Tensor = make(*arguments, **named)
        if tensor.dtype == torch.bool:
            return tensor.fill_(True)
        return tensor.fill_(torch.nan if tensor.is_floating_point() else torch.iinfo(tensor.dtype).min)

    return made
