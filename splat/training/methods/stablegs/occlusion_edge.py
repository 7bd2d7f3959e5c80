"""The dominant occlusion edge of a depth map (StableGS, Eq. (16)).

depth           sum of weight times z over sum of weight, along +z of the camera: the mean depth D, world units
gradient        Sobel, world units per pixel, (d/dx, d/dy): +x right, +y down
pixels in use   those whose 3 x 3 neighbourhood is covered everywhere (alpha at least COVERED): at the border to empty
                space there is no second surface whose order could be wrong, and the mean depth of faint pixels is noise
edges           the share STRONGEST of the pixels in use with the largest gradient, if it is above FLAT
structure       S = sum over edges of grad D grad D^T, with eigenvalues a >= b; its first eigenvector is the normal
"""

from math import atan2, ceil, cos, sin

import torch
from jaxtyping import Float
from torch import Tensor

COVERED = 0.5
STRONGEST = 0.05
FLAT = 1e-4  # relative gradient of depth, per pixel: above round-off of compositing hundreds of splats in float32


@torch.no_grad()
def dominant_edge(depth: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"]) -> Float[Tensor, "2"]:
    """Unit normal (x, y) of the strongest depth edges, across them in the image.

    depth (not divided by alpha), alpha: of `splat.render.render.render(..., depth=True)`.  The result is detached from
    autograd.  The sign of the normal is arbitrary: x >= 0.  Without edges it is 0.
    """
    gradient, relative = _gradients(depth, alpha)
    steep = relative > FLAT
    if not bool(steep.any()):
        return depth.new_zeros(2)
    length = gradient.norm(dim=1)
    threshold = length.kthvalue(len(length) - ceil(STRONGEST * len(length)) + 1).values
    x, y = gradient[steep & (length >= threshold)].double().unbind(-1)
    xx, xy, yy = float(x @ x), float(x @ y), float(y @ y)
    angle = atan2(2 * xy, xx - yy) / 2  # of the first eigenvector of [[xx, xy], [xy, yy]], in [-90, 90] degrees
    return depth.new_tensor([cos(angle), sin(angle)])


def _gradients(
    depth: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"]
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, " n"]]:
    """Gradient of the mean depth at the pixels in use, and its length relative to the depth."""
    if min(depth.shape) < 3:
        return depth.new_zeros(0, 2), depth.new_zeros(0)
    mean = depth / alpha.clamp_min(COVERED)
    faintest = -torch.nn.functional.max_pool2d(-alpha[None], 3, stride=1)[0]
    use = faintest >= COVERED
    gradient = _sobel(mean)[:, use].T
    return gradient, gradient.norm(dim=1) / mean[1:-1, 1:-1][use]


def _sobel(x: Float[Tensor, "h w"]) -> Float[Tensor, "2 h-2 w-2"]:
    """d/dx and d/dy, exact on a plane; by slices, since convolutions on a GPU round to 10 bits (TF32), far above FLAT."""
    across, down = x[:, 2:] - x[:, :-2], x[2:] - x[:-2]
    dx = across[:-2] + 2 * across[1:-1] + across[2:]
    dy = down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:]
    return torch.stack([dx, dy]) / 8
