"""The second derivative of a loss, split into the coupling of pixels by windows and the pixelwise rest (`formulas.py`)."""

from typing import NamedTuple

import numpy as np

from splat.backend.cpu.jit import kernel
from splat.backend.cpu.simd import broadcast, lanes, load, store
from splat.losses.cpu.sweeps import feed, seconds_at, seconds_row
from splat.losses.cpu.window import REACH, bordered_rows, part_of, ring_buffer
from splat.losses.formulas import SECONDS, pixel_curvature


class Coupling(NamedTuple):
    """l'' = sum over windows' centres of M . seconds M, M the window's means of v, 2 r v and (y - c) v, plus uncoupled v^2.

    image, target, uncoupled: three flat planes; seconds: SECONDS plane sets, 0 in their padding.
    """

    image: np.ndarray
    target: np.ndarray
    seconds: np.ndarray
    uncoupled: np.ndarray


@kernel
def second_rows(start, stop, frame, loss, x, y, target, blurred_sp, seconds, uncoupled):
    """Fill seconds and uncoupled of `Coupling`, for a loss with SSIM."""
    rows, second, own = bordered_rows(x, 3, frame), bordered_rows(x, SECONDS, frame), ring_buffer(x, 3, frame)
    size = 3 * frame.plane_rows * frame.stride
    for channel in range(3):
        top, first, _last, rows_ahead = part_of(start, stop, channel, REACH, frame)
        for ahead in rows_ahead:
            feed(None, 0, x, y, top, ahead, frame, rows, own, 0)
            row = ahead - REACH
            if row < first:
                continue
            at = top + row * frame.stride
            seconds_row(own, row, top, frame, loss.margin, target, second)
            for i in range(0, frame.stride, lanes(x)):
                residual, found = load(x, at + i) - load(y, at + i), seconds_at(second, i, frame)
                for j in range(SECONDS):
                    store(seconds, j * size + at + i, -loss.structural * found[j])
                curvature = pixel_curvature(residual, loss.kind, loss.eps, broadcast(x, loss.pixel))
                store(uncoupled, at + i, curvature - 2.0 * loss.structural * load(blurred_sp, at + i))
            for i in range(frame.width, frame.stride):
                uncoupled[at + i] = 0
                for j in range(SECONDS):
                    seconds[j * size + at + i] = 0
