"""Tensors on the CPU for the GPU's path: `Backend` of the CPU is that of CUDA, whose kernels `tests.ptx` runs."""

import pytest

from splat.render.backend import BACKENDS, CPU


def emulate(monkeypatch: pytest.MonkeyPatch, on: bool = True) -> None:
    """From now on, to the end of a test: the GPU's kernels for tensors on the CPU, or (on=False) the CPU's own again."""
    from splat.gpu.backend import CUDA  # needs triton

    monkeypatch.setitem(BACKENDS, "cpu", CUDA if on else CPU)
