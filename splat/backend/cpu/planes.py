"""Arrays that start on a cache line, and the height of a tile of pixels."""

import numpy as np

from splat.backend.cpu.jit import formula

TILE_ROWS = 16


@formula
def scratch(like, size):
    """A new array of like's dtype that starts on a cache line."""
    buffer = np.empty(size + 16, like.dtype)
    start = ((64 - (buffer.ctypes.data & 63)) & 63) // buffer.itemsize
    return buffer[start : start + size]


def aligned(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """An uninitialised array that starts on a cache line."""
    size, item = int(np.prod(shape)), np.dtype(dtype).itemsize
    buffer = np.empty(size * item + 64, np.uint8)
    start = -buffer.ctypes.data % 64
    return buffer[start : start + size * item].view(dtype).reshape(shape)
