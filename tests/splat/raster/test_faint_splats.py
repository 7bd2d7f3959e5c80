"""Opacities so small that the square of their inverse is beyond float64: with alpha_min = 0 they are not culled."""

import numpy as np
import pytest

from splat.projection.whitening import ROUND
from splat.raster.cpu.blocks import SPLAT, splat_block
from splat.raster.formulas import BLOCK_SUMS


@pytest.mark.parametrize("opacity", [1e-160, 1e-304, 5e-324])  # logits of -368, -700, -744
def test_the_own_block_of_a_splat_that_nobody_sees_is_finite(opacity: float) -> None:
    splat = np.array([8.0, 8.0, 0.5, 0.1, 0.4, opacity, 0.2, 0.5, 0.9])
    block = np.zeros((SPLAT, SPLAT))
    # all weights go with the opacity; s cancels in the second derivative in the opacity itself
    moments = np.full(BLOCK_SUMS, opacity)
    splat_block(splat, moments, opacity, opacity, opacity, block)
    assert np.isfinite(block).all()
    assert block[5, 5] == 0
    assert block[5, 0] == pytest.approx(ROUND * min(1.0, opacity / np.finfo(np.float64).tiny))  # ROUND o / o
