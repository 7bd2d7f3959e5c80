"""Decorators for Triton's kernels and for the functions that they call, and the launch of a kernel."""

from collections.abc import Callable
from typing import Any

import torch
import triton

from splat.gpu.language.formula import Formula

OF_IMAGES = ("width", "height", "columns", "v_stride", "out_stride")  # sizes: a scene's next photograph may have others


class Kernel(triton.JITFunction):
    """A kernel, or a function that kernels call, for which no stale code is taken from Triton's cache.

    Triton finds compiled code by a key made of sources, which do not show the formulas that a function calls: their digests
    are added to it.  No parameter may be called `params`, a name in code that Triton generates.
    """

    @property
    def cache_key(self) -> str:
        called = [self.__globals__.get(name) for name in self.fn.__code__.co_names]
        return super().cache_key + "".join(each.digest for each in called if isinstance(each, Formula))


def jit(function: Callable) -> Any:
    """Decorate a kernel, or a function that kernels call."""
    return sized()(function)


def sized(*names: str) -> Any:
    """Decorate a kernel, naming the parameters that change between launches: counts of Gaussians, vectors or intersections.

    Triton compiles a kernel anew, which takes seconds, where an integer that is not named becomes 1 or a multiple of 16 or
    ceases to be.  Those in OF_IMAGES need not be named.
    """

    def decorated(function: Callable) -> Kernel:
        numbers = [name for name in (*OF_IMAGES, *names) if name not in function.__annotations__]
        return Kernel(function, do_not_specialize=numbers)

    return decorated


def launch(kernel: Any, programs: tuple[int, ...], *arguments: Any, **constants: Any) -> None:
    """Run a kernel on the device of its first argument, which need not be the current one; nothing for no programs."""
    if all(programs):
        with torch.cuda.device_of(arguments[0]):
            kernel[programs](*arguments, enable_fp_fusion=True, **constants)
