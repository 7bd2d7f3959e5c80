"""The thresholds of the renderer, and how a GPU accumulates sums, in one frozen object.

Every threshold makes the image a discontinuous or merely piecewise smooth function of the parameters.  The default values are
those of the original 3DGS rasterizer (Kerbl et al. 2023).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from landscape.errors import InputError
from splat.model.typed import NonNegative, Positive, Settings

if TYPE_CHECKING:
    import torch

Accumulation = Literal["deterministic", "atomic"]
Antialias = Literal["none", "mip", "mip-plain", "mip-splatting"]


# relative, of float64 alone.  Two splats at the cap leave (1 - 0.99)^2, the floor itself.  In float32 they stop the pixel, here
# and in the CUDA renderers, because 1 - 0.99 rounds down by more than round-off adds; so they must in float64.
TIE = 1e-5


@dataclass(frozen=True)
class RenderSettings(Settings):
    """Thresholds of projection and compositing, and how a GPU accumulates sums.

    blur: variance added to the diagonal of every 2-D covariance, in px^2.
    antialias: what an opacity is multiplied by because of the blur, by whose equation (`splat/projection/antialias.py`).  none:
        1; mip: as 3DGS with --antialiasing; mip-plain: without its floor, as gsplat to 1.5 and Brush (whose blur is 0.1);
        mip-splatting: as that (blur 0.1), and its trainings give every Gaussian a 3-D filter.
    fov_clamp: the projection's Jacobian is taken at x/z and y/z clamped to this multiple of tan(fov / 2).
    near: Gaussians whose centre is nearer than this to the camera plane (world units) are not drawn.
    alpha_max: cap of a Gaussian's alpha in a pixel, below 1 (at 1 the transmittance behind it would be 0).
    alpha_min: a Gaussian is skipped in the pixels where its alpha is below this; 0 draws it in every pixel.
    transmittance_min: a pixel stops before its transmittance would fall below this; 0 never stops.
    contour_sigma: an additional cut at this Mahalanobis distance (the original cuts at 3); None keeps alpha_min's contour.
    gradient_through_cap: pass derivatives in ln alpha through the cap, instead of the true 0; the original CUDA code passes
        those in alpha through, which is the same within 1%.
    accumulation: how a GPU adds up gradients.  deterministic: in a fixed order, with the same bits every time, as on the CPU;
        atomic: in whatever order, which is faster.
    InputError where a value is out of its range.

    >>> RenderSettings(alpha_min=0.0).near
    0.2
    """

    blur: NonNegative = 0.3
    antialias: Antialias = "none"
    fov_clamp: Positive = 1.3
    near: Positive = 0.2
    alpha_max: float = 0.99
    alpha_min: float = 1 / 255
    transmittance_min: float = 1e-4
    contour_sigma: Positive | None = None
    gradient_through_cap: bool = False
    accumulation: Accumulation = "deterministic"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.alpha_max < 1:
            raise InputError(
                f"expected 0 < alpha_max < 1, got {self.alpha_max}: at 1 a Gaussian would hide all behind it exactly, "
                "and the backward pass divides by 1 - alpha; use e.g. 0.999"
            )
        if not 0 <= self.alpha_min < self.alpha_max:
            raise InputError(f"expected 0 <= alpha_min < alpha_max = {self.alpha_max}, got {self.alpha_min}")
        if not 0 <= self.transmittance_min < 1:
            raise InputError(f"expected 0 <= transmittance_min < 1, got {self.transmittance_min}")

    def floor(self, dtype: "torch.dtype") -> float:
        """The transmittance beneath which a pixel of dtype stops: in float64 TIE above transmittance_min."""
        return self.transmittance_min * (1 + TIE if dtype.itemsize == 8 else 1)
