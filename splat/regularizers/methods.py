"""The methods of training by name.

3dgs            nothing is added
stablegs        images of probed Gaussians, and their agreement from probed viewpoints
sam             the gradient at the worst place near by in the space of parameters
dropgaussian    a growing random share of the Gaussians is left out of each training render
"""

from dataclasses import dataclass
from typing import Literal

from splat.regularizers.dropgaussian import DropGaussian
from splat.regularizers.regularizer import Method
from splat.regularizers.sam import SAM
from splat.regularizers.stablegs import StableGS


@dataclass(frozen=True)
class ThreeDGS(Method):
    """3D Gaussian Splatting as it is (Kerbl et al. 2023)."""

    name: Literal["3dgs"] = "3dgs"


MethodSettings = ThreeDGS | StableGS | SAM | DropGaussian

METHODS: dict[str, type[MethodSettings]] = {method.name: method for method in (ThreeDGS, StableGS, SAM, DropGaussian)}
