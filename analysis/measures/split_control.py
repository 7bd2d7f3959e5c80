"""The split control: the same scene with every Gaussian split into two coincident halves, so that only their number changes.

No two halves reproduce an opacity o < 1 at every pixel.  With g = exp(-r^2 / 2) the Gaussian's profile, its alpha is o g; two
coincident halves of opacity x and profile g^k (each scale divided by sqrt k) have together

    1 - (1 - x g^k)^2 = 2 x g^k - x^2 g^(2k)

`halves` takes the x and k that are nearest to o g in the mean square over the plane.  With u = r^2 / 2, dA = 2 pi du, that is

    minimise  int_0^inf (2 x e^(-k u) - x^2 e^(-2 k u) - o e^(-u))^2 du
            = 2 x^2 / k - 4 x^3 / (3 k) + x^4 / (4 k) - 4 x o / (k + 1) + 2 x^2 o / (2 k + 1) + o^2 / 2

Its root, relative to that of o g, is 0.2% at o = 0.1, 1.4% at 0.5, 3.6% at 0.9 (halves of o / 2: 1.8, 8.8, 15.9%).  What the
images change by, with blur and thresholds, is measured and kept beside the Gaussians.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import inf, log10

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.optimize import minimize
from torch import Tensor

from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.forward import rasterize_view

KNOTS = np.linspace(0, 1, 65)  # opacities at which x / o and k are found; linear in between


@dataclass(frozen=True, eq=False)
class SplitControl:
    """gaussians: first halves in the order of the given ones, then second halves; rms: change of the images."""

    gaussians: Gaussians
    rms: float

    @property
    def psnr(self) -> float:
        """PSNR of the split scene's images against the given scene's, dB."""
        return -20 * log10(self.rms) if self.rms else inf


def halves(opacity: Float64[Tensor, " n"]) -> tuple[Float64[Tensor, " n"], Float64[Tensor, " n"]]:
    """Opacity x and sharpness k of two coincident halves of a Gaussian.

    >>> x, k = halves(torch.tensor([1e-6, 0.5], dtype=torch.float64))
    >>> [round(v, 4) for v in (x / torch.tensor([1e-6, 0.5])).tolist()], [round(v, 4) for v in k.tolist()]
    ([0.5, 0.5711], [1.0, 1.0703])
    """
    at, table = opacity.cpu().numpy(), _table().T
    ratio, sharpness = (torch.from_numpy(np.interp(at, KNOTS, column)).to(opacity.device) for column in table)
    return opacity * ratio, sharpness


def _error(unknowns: np.ndarray, o: float) -> float:
    """The mean squared error over o^2, of x = o unknowns[0] and k = unknowns[1]."""
    r, k = unknowns
    x = r * o
    square = 2 * r * r / k - 4 * r * r * x / (3 * k) + r * r * x * x / (4 * k)
    return square - 4 * r / (k + 1) + 2 * r * x / (2 * k + 1) + 0.5


@cache
def _table() -> np.ndarray:
    """x / o and k at the knots; at o = 0 the halves are the Gaussian at half its opacity."""
    rows = [np.array([0.5, 1.0])]
    for o in KNOTS[1:]:
        rows.append(minimize(_error, rows[-1], args=(o,), tol=1e-14, method="Nelder-Mead").x)
    return np.stack(rows)


@torch.no_grad()
def split_in_two(gaussians: Gaussians) -> Gaussians:
    """Every Gaussian replaced by its two halves: first halves in order, then second halves."""
    count = len(gaussians)
    result = gaussians.select(torch.arange(count).repeat(2))
    x, k = halves(gaussians.opacity_logits.double().sigmoid())
    result.opacity_logits.copy_(torch.logit(x.clamp_min(torch.finfo(x.dtype).tiny)).repeat(2))
    result.log_scales.sub_((k.log() / 2).repeat(2)[:, None])
    return result


def split_control(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    background: Float[Tensor, "3"] | None = None,
    settings: RenderSettings = RenderSettings(),
) -> SplitControl:
    """Split every Gaussian, and measure what that does to the images."""
    if not cameras:
        raise ValueError("expected at least one camera to compare images in, got none")
    background = torch.zeros(3) if background is None else background
    result, squares, values = split_in_two(gaussians), 0.0, 0
    for camera in cameras:
        before, after = (_image(some, camera, background, settings) for some in (gaussians, result))
        change = after - before
        squares, values = squares + float(change.square().sum()), values + change.numel()
    return SplitControl(result, (squares / values) ** 0.5)


def _image(gaussians: Gaussians, camera: Camera, background: Tensor, settings: RenderSettings) -> Tensor:
    raster = rasterize_view(gaussians, camera, background, settings)
    return raster.crop(raster.planes[:3]).double()
