"""The tolerances of the kernels, and how errors are measured.

IMAGE and DERIVATIVE are the relative errors promised for the kernels against the float64 specification.
"""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

IMAGE = {torch.float32: 1e-6, torch.float64: 1e-12}
DERIVATIVE = {torch.float32: 1e-5, torch.float64: 1e-12}
DTYPES = (torch.float32, torch.float64)
NUMPY = {torch.float32: np.float32, torch.float64: np.float64}


def relative_error(got: Tensor | np.ndarray, expected: Tensor | np.ndarray) -> float:
    """|got - expected| / |expected| in the 2-norm; infinite where got is not finite or of another shape."""
    got, expected = (torch.as_tensor(each).detach().cpu().double() for each in (got, expected))
    if got.shape != expected.shape or not torch.isfinite(got).all():
        return float("inf")
    difference, size = float((got - expected).norm()), float(expected.norm())
    return difference / size if size else difference


def errors_by_block(got: Tensor, expected: Tensor, blocks: Mapping[str, slice]) -> dict[str, float]:
    """The relative error of every attribute's rows."""
    return {name: relative_error(got[rows], expected[rows]) for name, rows in blocks.items()}
