"""Information of views about each Gaussian: blocks of J^T J, which need cameras and no photographs, and gains by further views.

J is the Jacobian of a view's image, all its pixels and channels: under noise of one size in each channel J^T J is the Fisher
information of the parameters, and twice the Gauss-Newton part of half the squared error.  Of every Gaussian the 10 x 10 of its
geometry and opacity is kept, without the quaternion's length, and the diagonal of its SH, in stored parameters.  With B the sum
over the views seen so far and a prior, and C that of a candidate, by Gaussian:

    d           ln det (B + C) - ln det B, summed: D-optimality, twice the nats that the candidate tells about the scene
    t           tr B^-1 C
    e           ln of how much the least eigenvalue of B grows, in units of the prior, summed
    d_diagonal  d of the diagonals alone
    published   FisherRF's score (Jiang et al. 2024): sum of c / (b + 1e-6) over all parameters but rotations, as its code does.
                Its b and c are squares of the derivatives' *sum over the channels*, where opposite channels cancel.  Here they
                are those of Gaussians whose red is the sum of their channels: the same unless a channel is clamped at 0

Prior: precisions that are PRIOR times the mean of the training views' diagonals, one for each attribute.  It stands for what
is known without any view, and decides what a Gaussian that none has seen yet is worth.

Uncertainty of a view: the variance of its pixels, J B^-1 J^T, given the prior and the information of the training views as B: a
Laplace approximation whose precision is block-diagonal over Gaussians, or diagonal.  Vectors u with the covariance B^-1 are
pushed forward:

    variance of a pixel = E sum_c (J u)_c^2        over samples of u; its relative standard error is sqrt(2 / samples) at most
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.results import Progress
from splat.curvature.fields import complement, eigenvalues, on_complement
from splat.curvature.gaussian_blocks import GEOMETRY_COLUMNS, PerGaussianBlocks
from splat.curvature.linearize import VECTORS, LinearizedView
from splat.losses.reference import LossSettings
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.harmonics import Y00
from splat.model.settings import RenderSettings
from splat.render.backend import backend_of

GAINS = ("d", "t", "e", "d_diagonal", "published")
PRIOR = 1e-3
FISHERRF_LAMBDA = 1e-6
UNTURNED = [*range(6), 10]  # of the 11 columns of a Gaussian's geometry: those of mean, log-scales and opacity
COLUMNS = {"means": slice(0, 3), "log_scales": slice(3, 6), "quats": slice(6, 9), "opacity_logits": slice(9, 10)}


@dataclass(frozen=True, eq=False)
class Information:
    """Information about n Gaussians.  geometry: positive semi-definite.  summed: FisherRF's diagonal."""

    geometry: Float64[Tensor, "n 10 10"]
    sh: Float64[Tensor, "n k 3"]
    summed: Float64[Tensor, "n q"]

    def __add__(self, other: "Information") -> "Information":
        return Information(self.geometry + other.geometry, self.sh + other.sh, self.summed + other.summed)

    @property
    def diagonal(self) -> Float64[Tensor, "n q"]:
        return torch.cat([self.geometry.diagonal(dim1=1, dim2=2), self.sh.flatten(1)], dim=1)


def information(
    gaussians: Gaussians, camera: Camera, background: Float[Tensor, "3"], settings: RenderSettings = RenderSettings()
) -> Information:
    """J^T J of one view of Gaussians with unit quaternions: two passes over the pixels.

    >>> from splat import SyntheticSettings, synthetic_scene
    >>> made = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12))
    >>> found = information(made.truth, made.scene.frames[0].camera, torch.zeros(3))
    >>> found.geometry.shape[1:], bool((found.diagonal >= 0).all())
    (torch.Size([10, 10]), True)
    """
    quats = gaussians.quats.double()
    blocks = _squares(gaussians, camera, background, settings)
    values, vectors = torch.linalg.eigh(on_complement(blocks.geometry.double(), quats))
    geometry = (vectors * values.clamp_min(0)[:, None]) @ vectors.mT
    red = background.sum() * background.new_tensor([1.0, 0.0, 0.0])
    grey = _squares(channel_sum(gaussians), camera, red, settings)
    own, sh = grey.geometry.double().diagonal(dim1=1, dim2=2)[:, UNTURNED], blocks.sh.double()
    return Information(geometry, sh, torch.cat([own.clamp_min(0), sh.flatten(1)], dim=1))


def informations(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    background: Float[Tensor, "3"],
    settings: RenderSettings,
    report: Progress | None = None,
) -> dict[str, Information]:
    """Information of each camera about the Gaussians."""
    gaussians, found = gaussians.aligned_to(gaussians), {}
    for name, camera in cameras.items():
        found[name] = information(gaussians, camera, background, settings)
        if report:
            report(len(found), len(cameras), "views")
    return found


def prior_of(seen: Information) -> Information:
    """The prior's precisions, from the information of the training views."""
    diagonal, geometry = seen.geometry.diagonal(dim1=1, dim2=2), torch.zeros_like(seen.geometry)
    for columns in COLUMNS.values():
        geometry.diagonal(dim1=1, dim2=2)[:, columns] = PRIOR * diagonal[:, columns].mean()
    return Information(geometry, torch.full_like(seen.sh, PRIOR * float(seen.sh.mean())), torch.zeros_like(seen.summed))


def gains(seen: Information, prior: Information, candidate: Information) -> dict[str, float]:
    """Gain of a candidate over the views seen, by every criterion."""
    return {name: float(each.sum()) for name, each in gains_of_each(seen, prior, candidate).items()}


def gains_of_each(seen: Information, prior: Information, candidate: Information) -> dict[str, Float64[Tensor, " n"]]:
    """The part of every Gaussian in the gains."""
    before = seen + prior
    after, root = before + candidate, prior.geometry.diagonal(dim1=1, dim2=2).rsqrt()
    least = [eigenvalues(root[:, :, None] * each.geometry * root[:, None, :])[:, 0] for each in (before, after)]
    solved = torch.linalg.solve(before.geometry, candidate.geometry).diagonal(dim1=1, dim2=2)
    return {
        "d": after.geometry.logdet() - before.geometry.logdet() + (after.sh / before.sh).log().sum(dim=(1, 2)),
        "t": solved.sum(dim=1) + (candidate.sh / before.sh).sum(dim=(1, 2)),
        "e": (least[1] / least[0]).log(),
        "d_diagonal": (after.diagonal / before.diagonal).log().sum(dim=1),
        "published": (candidate.summed / (seen.summed + FISHERRF_LAMBDA)).sum(dim=1),
    }


def channel_sum(gaussians: Gaussians) -> Gaussians:
    """Gaussians whose red is the sum of their three channels, and whose other channels are black."""
    sh = torch.zeros_like(gaussians.sh)
    sh[:, :, 0] = gaussians.sh.sum(dim=2)
    sh[:, 0] += torch.tensor([1.0, -0.5, -0.5]).to(sh) / Y00  # a channel is 1/2 + Y00 times its first coefficient
    return Gaussians.pack(gaussians.attributes | {"sh": sh}).with_filter(gaussians.filter_widths)


def _squares(
    gaussians: Gaussians, camera: Camera, background: Float[Tensor, "3"], settings: RenderSettings
) -> PerGaussianBlocks:
    """The blocks of J^T J: the mean of squared errors has l'' = 2 / (3 h w)."""
    nothing = torch.zeros(3, camera.height, camera.width)
    loss = backend_of(gaussians.flat).view_loss(nothing, LossSettings("l2", ssim_weight=0), gaussians.flat)
    view = LinearizedView(gaussians, camera, loss, background.to(gaussians.flat), settings)
    blocks, pixels = view.block_diagonals(parts=(True,))[0], 1.5 * camera.height * camera.width
    return PerGaussianBlocks(pixels * blocks.geometry, pixels * blocks.sh)


def pushed(
    total: Information, gaussians: Gaussians, Z: Float64[Tensor, "n q k"], *, diagonal: bool
) -> Float[Tensor, "p k"]:
    """B^-1/2 Z as changes of the stored parameters of Gaussians with unit quaternions.

    total: B.  Z: of the ten of the geometry and of the SH.  diagonal: B is its diagonal.
    """
    geometry, vectors = total.geometry, Z.shape[2]
    if diagonal:
        geometry = torch.diag_embed(geometry.diagonal(dim1=1, dim2=2))
    root = torch.linalg.cholesky(geometry)
    moved = complement(gaussians.quats.double()) @ torch.linalg.solve_triangular(root.mT, Z[:, :10], upper=True)
    result, rows = Z.new_empty(gaussians.flat.numel(), vectors), gaussians.blocks
    for name, columns in GEOMETRY_COLUMNS.items():
        result[rows[name]] = moved[:, columns].reshape(-1, vectors)
    result[rows["sh"]] = (Z[:, 10:] * total.sh.flatten(1).rsqrt()[:, :, None]).reshape(-1, vectors)
    return result.to(gaussians.flat)


def pixel_variance(
    view: LinearizedView, total: Information, generator: torch.Generator, samples: int = 64, *, diagonal: bool = False
) -> Float64[Tensor, "h w"]:
    """The variance of each pixel, summed over the channels, over that of a channel's noise.  total, diagonal: see `pushed`."""
    gaussians, numbers = view.gaussians, 10 + total.sh[0].numel()
    variance = torch.zeros((), dtype=torch.float64)
    for start in range(0, samples, VECTORS):
        count = min(VECTORS, samples - start)
        Z = torch.randn(len(gaussians), numbers, count, generator=generator, dtype=torch.float64)
        moved = view.jvp(pushed(total, gaussians, Z, diagonal=diagonal))[:, :3]
        variance = variance + moved.double().square().sum(dim=(0, 1))
    return variance / samples
