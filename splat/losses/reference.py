"""Settings of the image losses, their window, and metrics.  In plain torch the losses are in `tests/splat/photometric.py`.

Images are (3, h, w) in [0, 1].  Every loss is a mean over pixels and channels.

    l1          |r|                            r = image - target
    charbonnier sqrt(r^2 + eps^2)              a smooth l1; its second derivative is eps^2 / (r^2 + eps^2)^(3/2)
    l2          r^2
    SSIM        11 x 11 Gaussian window, sigma 1.5, C1 = 0.01^2, C2 = 0.03^2; beyond the image are zeros, as in 3DGS (padded),
                or windows that reach beyond it do not count (valid)
    photometric (1 - lambda) pixel + lambda (1 - SSIM), lambda = 0.2: StableGS's Eq. (2) as 3DGS weighs it;
                literal: pixel + lambda (1 - SSIM), the same as printed
"""

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.errors import InputError
from splat.model.typed import NonNegative, Positive, Settings, Share

WINDOW, SIGMA = 11, 1.5
REACH = WINDOW // 2
C1, C2 = 0.01**2, 0.03**2
PixelLoss = Literal["l1", "charbonnier", "l2"]
Border = Literal["padded", "valid"]


@dataclass(frozen=True)
class LossSettings(Settings):
    """Loss of a view: the pixel loss, and ssim_weight = lambda in [0, 1], of 1 - SSIM.

    eps: Charbonnier's, in units of intensity.  literal: the pixel loss has the weight 1 instead of 1 - lambda.
    border: whether SSIM's windows may reach beyond the image.
    opacity_reg, scale_reg: weights of the mean opacity and the mean scale, in the loss of a scene (`losses/regularizers.py`).

    >>> LossSettings("l2", ssim_weight=0.2).pixel_weight
    0.8
    """

    pixel: PixelLoss = "l1"
    ssim_weight: Share = 0.2
    eps: Positive = 0.01
    literal: bool = False
    border: Border = "padded"
    opacity_reg: NonNegative = 0.0
    scale_reg: NonNegative = 0.0

    @property
    def margin(self) -> int:
        """Pixels at every side of the image round which no window counts."""
        return REACH if self.border == "valid" else 0

    def structural(self, height: int, width: int) -> float:
        """The weight of 1 - SSIM of one value of a channel.  InputError where no window fits into the image."""
        rows, columns = height - 2 * self.margin, width - 2 * self.margin
        if not self.ssim_weight:
            return 0.0
        if min(rows, columns) < 1:
            raise InputError(
                f"expected pictures of at least {WINDOW} px a side, the size of SSIM's window, got {width} x {height}; "
                "reduce less"
            )
        return self.ssim_weight / (3 * rows * columns)

    @property
    def pixel_weight(self) -> float:
        return 1.0 if self.literal else 1.0 - self.ssim_weight


def window(dtype: torch.dtype) -> Float[Tensor, "11"]:
    """The normalised 1-D Gaussian; the 2-D window is its outer product."""
    offset = torch.arange(WINDOW, dtype=torch.float64) - REACH
    weight = torch.exp(-(offset**2) / (2 * SIGMA**2))
    return (weight / weight.sum()).to(dtype)


def beyond(length: int) -> Float64[Tensor, " length"]:
    """The weight of the 1-D window outside of a line of so many pixels, round each of them; exactly 0 in the middle."""
    place = torch.arange(length)[:, None] + torch.arange(WINDOW) - REACH
    return ((place < 0) | (place >= length)).double() @ window(torch.float64)


def blur(fields: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
    """The window's weighted mean round every pixel; zero outside the image.  Its own adjoint."""
    weight, channels = window(fields.dtype).to(fields.device), fields.shape[0]
    rows = F.conv2d(
        fields[None], weight.view(1, 1, 1, -1).expand(channels, 1, 1, -1), padding=(0, REACH), groups=channels
    )
    return F.conv2d(rows, weight.view(1, 1, -1, 1).expand(channels, 1, -1, 1), padding=(REACH, 0), groups=channels)[0]


def ssim_map(image: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"]) -> Float[Tensor, "3 h w"]:
    """Structural similarity of every pixel and channel (Wang et al. 2004)."""
    mu_x, mu_y, xx, yy, xy = blur(torch.cat([image, target, image * image, target * target, image * target])).chunk(5)
    var_x, var_y, cov = xx - mu_x * mu_x, yy - mu_y * mu_y, xy - mu_x * mu_y
    luminance = (2 * mu_x * mu_y + C1) / (mu_x * mu_x + mu_y * mu_y + C1)
    return luminance * (2 * cov + C2) / (var_x + var_y + C2)


def psnr(image: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"]) -> float:
    """Peak signal-to-noise ratio in dB, peak 1, of the image clamped to [0, 1]; infinite for equal images."""
    return float(-10 * torch.log10((image.clamp(0, 1) - target).square().mean()))


def ssim(image: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"]) -> float:
    """Mean structural similarity over pixels and channels, of the image clamped to [0, 1]."""
    return float(ssim_map(image.clamp(0, 1), target).mean())
