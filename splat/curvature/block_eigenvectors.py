"""Eigenvectors of the Hessian's diagonal blocks of Gaussians: start vectors for a search of both ends of the spectrum.

Eigenvectors of a scene with extreme eigenvalues have their weight on one or two Gaussians.  So those of a Gaussian's block of
geometry and opacity (`PerGaussianBlocks`), orthogonal to the quaternion as in `SceneHessian`, are close to them.

Coupling of pixels.  Approximate blocks have the diagonal of SSIM's l'' alone.  They are too large, because SSIM ignores changes
that are uniform over a window.  The window's blur B (a Gaussian, standard deviation sigma px) keeps the share
rho = |B u|^2 / |u|^2 of an image u; this share of the pixelwise part is removed.  A splat that moves across its narrower axis
changes the image by the slope of a Gaussian, so with its conic C (px^-2) and the larger eigenvalue c of C

    rho = 1 / ((1 + sigma^2 c) sqrt(det(1 + sigma^2 C)))

averaged over the views that draw it.  The share (1 - rho) / (1 - rho_1) of the pixelwise part is kept; rho_1 is that of a
single pixel, which the diagonal of l'' leaves out already.  Of the curvature of an L2 loss beside SSIM this removes too much.

Start vectors.  A Krylov method that starts at one eigenvector misses every extreme eigenvector that is orthogonal to it, so it
is given several (WARM_START) from either end.
"""

from math import inf, pi

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from splat.backend.cpu.threads import over_batch
from splat.curvature.gaussian_blocks import GEOMETRY_COLUMNS, PerGaussianBlocks
from splat.curvature.objective import SceneObjective
from splat.losses.reference import SIGMA
from splat.model.camera import Camera
from splat.projection.formulas import lens_of
from splat.render.backend import backend_of

RHO_OF_A_PIXEL = 1 / (4 * pi * SIGMA**2)
CHUNK = 8192  # blocks decomposed at a time: CUDA refuses 32,768, and takes up to 1 MB of memory for each
WARM_START = 2, 4  # eigenvectors of the largest and of the smallest eigenvalues; negative ones lie closer together
FEW = 256  # blocks that are decomposed in any case
BOUND_SLACK = 1e-5  # relative rounding error of a norm
# eigenvalues, the Gaussians that they belong to, and eigenvectors
Ends = tuple[Float64[Tensor, " k"], Int[Tensor, " k"], Float[Tensor, "k w"]]


class BlockEigenvectors:
    """Eigenpairs of the Gaussians' diagonal blocks of the scene's Hessian H, or of D H D.

    blocks: of H, or of its Gauss-Newton part.  pixelwise: blocks of the Gauss-Newton part with the diagonal of l'', where the
    loss couples pixels.  attribute: one other than "sh"; by default all but "sh".  scale: diagonal of D > 0, 1 by default.
    """

    def __init__(
        self,
        objective: SceneObjective,
        blocks: PerGaussianBlocks,
        pixelwise: PerGaussianBlocks | None = None,
        attribute: str | None = None,
        scale: Float[Tensor, " p"] | None = None,
    ):
        self._like, n = objective.active.flat, len(objective.active)
        D = objective.active.with_flat(torch.ones_like(self._like) if scale is None else scale)
        units = torch.cat([getattr(D, name).reshape(n, -1) for name in GEOMETRY_COLUMNS], dim=1)
        radial = torch.zeros_like(units)
        radial[:, GEOMETRY_COLUMNS["quats"]] = objective.active.quats
        geometry = blocks.geometry
        if pixelwise is not None:
            removed = 1 - _kept_share(objective)
            geometry = geometry - removed[:, None, None].to(geometry) * pixelwise.geometry
        self._blocks, self._columns, self._rows = objective.blocks, GEOMETRY_COLUMNS, self._like.numel()
        if attribute is not None:
            columns = GEOMETRY_COLUMNS[attribute]
            units, radial, geometry = units[:, columns], radial[:, columns], geometry[:, columns, columns]
            self._rows, self._columns = units.numel(), {attribute: slice(0, units.shape[1])}
            self._blocks = {attribute: slice(0, self._rows)}
        self._geometry, self._radial, self._units = geometry, radial, units

    def pairs(self, gaussians: Int[Tensor, " m"]) -> tuple[Float64[Tensor, "m w"], Float[Tensor, "m w w"]]:
        """Ascending eigenvalues and eigenvectors (in columns) of these Gaussians' blocks; 0 for a quaternion's length."""
        return eigendecomposed(*(x[gaussians] for x in (self._geometry, self._radial, self._units)))

    def steepest(self, largest: int, smallest: int) -> Float[Tensor, "p k"]:
        """Unit eigenvectors of the largest eigenvalues of all blocks, descending, then of the smallest, ascending."""
        _, gaussians, vectors = self._ends(largest, smallest)
        geometry = self._like.new_zeros(*self._units.shape, len(gaussians))
        geometry[gaussians, :, torch.arange(len(gaussians), device=gaussians.device)] = vectors
        result = self._like.new_zeros(self._rows, len(gaussians))
        for name, columns in self._columns.items():
            result[self._blocks[name]] = geometry[:, columns].reshape(-1, len(gaussians))
        return result

    def warm_start(self) -> Float[Tensor, "p k"]:
        """Start vectors for a search of both ends."""
        return self.steepest(*WARM_START)

    def _ends(self, largest: int, smallest: int) -> Ends:
        """The extreme eigenpairs of all blocks, by eigendecomposition of as few as possible.

        No eigenvalue exceeds its block's Frobenius norm in size.  So, with the extremes of the blocks of largest norm known,
        blocks of a norm below all of these are skipped.
        """
        bounds = (self._geometry * self._units[:, :, None] * self._units[:, None, :]).flatten(1).norm(dim=1)
        some = bounds.topk(min(max(FEW, largest, smallest), len(bounds))).indices
        found = self._ends_of(some, largest, smallest)
        least = torch.cat([found[0][:largest], -found[0][largest:]]).min()
        candidates = (bounds * (1 + BOUND_SLACK) >= least).nonzero()[:, 0]
        return found if len(candidates) <= len(some) else self._ends_of(candidates, largest, smallest)

    def _ends_of(self, gaussians: Int[Tensor, " m"], largest: int, smallest: int) -> Ends:
        """The largest eigenpairs of these blocks, descending, and the smallest, ascending."""
        values, vectors = self.pairs(gaussians)
        null = vectors.norm(dim=1) < 0.5  # the quaternion's length, which `eigendecomposed` projects out
        most, width = int((~null).sum()), values.shape[1]
        top = values.masked_fill(null, -inf).flatten().topk(min(largest, most)).indices
        bottom = values.masked_fill(null, inf).flatten().topk(min(smallest, most), largest=False).indices
        chosen = torch.cat([top, bottom])
        block = chosen // width
        return values.flatten()[chosen], gaussians[block], vectors[block, :, chosen % width]


def eigendecomposed(
    blocks: Float[Tensor, "n w w"], radial: Float[Tensor, "n w"], units: Float[Tensor, "n w"]
) -> tuple[Float64[Tensor, "n w"], Float[Tensor, "n w w"]]:
    """Eigenvalues and eigenvectors of D P B P D for blocks B, D = diag(units); P removes the unit vectors `radial`."""
    values = torch.empty_like(units, dtype=torch.float64)
    vectors = torch.empty_like(blocks, memory_format=torch.contiguous_format)

    def decompose(first: int, last: int) -> None:
        for start in range(first, last, CHUNK):
            rows = slice(start, min(start + CHUNK, last))
            r, d = radial[rows].double()[:, :, None], units[rows].double()[:, :, None]
            projected = _across(r, _across(r, blocks[rows].double()).mT)
            values[rows], found = torch.linalg.eigh(d * projected * d.mT)
            vectors[rows] = _across(torch.nn.functional.normalize(r / d, dim=1), found)

    over_batch(len(blocks), decompose, blocks.device)
    return values, vectors


def _across(r: Float64[Tensor, "n w 1"], B: Float64[Tensor, "n w w"]) -> Float64[Tensor, "n w w"]:
    """B's columns without their components along the unit vectors r."""
    return B - r * (r * B).sum(dim=1, keepdim=True)


def _kept_share(objective: SceneObjective) -> Float64[Tensor, " n"]:
    """(1 - rho) / (1 - rho_1) of each Gaussian, rho averaged over the views that draw it."""
    views = torch.stack([_blurred_share(objective, view.camera) for view in objective.views])
    rho, drawn = views.sum(dim=0) / len(views)
    return (1 - rho / drawn) / (1 - RHO_OF_A_PIXEL)


def _blurred_share(objective: SceneObjective, camera: Camera) -> Float64[Tensor, "2 n"]:
    """(rho, 1) of every Gaussian that a view draws; 0 for the others."""
    splats, _, drawn = backend_of(objective.active.flat).project(objective.active, lens_of(camera, objective.settings))
    rho = blurred_share(splats[:, 2:5])
    return torch.where(drawn, torch.stack([rho, torch.ones_like(rho)]), 0)


def blurred_share(conics: Float64[Tensor, "n 3"]) -> Float64[Tensor, " n"]:
    """rho of splats with the conics [[a, b], [b, c]] (px^-2), as rows (a, b, c).

    >>> wide, narrow = blurred_share(torch.tensor([[1e-4, 0.0, 1e-4], [4.0, 0.0, 1e-4]]))
    >>> print(f"{float(wide):.3f} {float(narrow):.3f}")
    1.000 0.032
    """
    a, b, c = SIGMA**2 * conics.T
    larger = (a + c) / 2 + torch.hypot((a - c) / 2, b)
    return 1 / ((1 + larger) * ((1 + a) * (1 + c) - b**2).sqrt())
