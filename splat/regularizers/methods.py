"""The methods of training by name."""

from dataclasses import dataclass
from typing import Literal

from splat.regularizers.regularizer import Method
from splat.regularizers.stablegs import StableGS


@dataclass(frozen=True)
class ThreeDGS(Method):
    """3D Gaussian Splatting as it is (Kerbl et al. 2023)."""

    name: Literal["3dgs"] = "3dgs"


MethodSettings = ThreeDGS | StableGS

METHODS: dict[str, type[MethodSettings]] = {method.name: method for method in (ThreeDGS, StableGS)}
