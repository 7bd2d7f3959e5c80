"""Compilation of the CPU's kernels; they are kept by `kernel_cache.py`, and their vectors are those of `simd.py`.

`kernel` marks what Python calls, without its lock; `formula` what only kernels and other formulas call.  Division by 0 gives
infinity, and indices are not checked.

Numba optimises every function and makes machine code of it, with two wrappers for callers from Python and C.  A formula is
inlined into whom it serves and optimised there, so none of this is done for itself, and it is not kept.
"""

from typing import Any

from numba import njit
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


class _ToInline(JITCodeLibrary):
    """Code that waits for its caller's optimisation: `finalize` links what it calls, and no more."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True

    @property
    def codegen(self) -> Any:
        """Itself, for the one call that Numba makes: where Python's objects are, which no formula has."""
        return self

    def set_env(self, name: str, environment: Any) -> None:
        pass


class _FormulaCompiler(Compiler):
    def __init__(self, typing: Any, target: Any, library: Any, *rest: Any) -> None:
        super().__init__(typing, target, library or _ToInline(target.codegen(), "formula"), *rest)


_NUMBERS: dict[str, Any] = {"error_model": "numpy", "boundscheck": False, "no_cfunc_wrapper": True}
_INLINED: dict[str, Any] = {"forceinline": True, "no_cpython_wrapper": True, "pipeline_class": _FormulaCompiler}
kernel = njit(cache=True, nogil=True, **_NUMBERS)
formula = njit(**_INLINED, **_NUMBERS)
