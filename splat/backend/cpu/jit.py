"""Compilation of the CPU's kernels; they are kept by `kernel_cache.py`, and their vectors are those of `simd.py`.

`kernel` marks what Python calls, without its lock; `formula` what kernels and other formulas call, inlined.  Division by 0
gives infinity, and indices are not checked.
"""

from numba import njit

kernel = njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)
formula = njit(cache=True, forceinline=True, error_model="numpy", boundscheck=False)
