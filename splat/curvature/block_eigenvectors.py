"""Eigenvectors of the Hessian's blocks of single Gaussians: where the search for the ends of the spectrum begins.

Steep eigenvectors of a scene live on one or two Gaussians, and the block of a Gaussian's own rows, but for its colours, is
known exactly (`linearize.PerGaussianBlocks`).  Their eigenvectors, at right angles to the quaternions' lengths as in
`curvature.SceneHessian`, are where to begin.

Where the loss couples pixels, its curvature l'' is known pixel by pixel only, which is too much: SSIM does not care for what
changes a window evenly.  Of an image u the window's blur B keeps the share rho = |B u|^2 / |u|^2, and that share of the
pixelwise part does not count.  A splat that is moved across its narrower axis changes by the slope of a Gaussian, so with its
conic C (c: its larger eigenvalue) and the window's sigma

    rho = 1 / ((1 + sigma^2 c) sqrt(det(1 + sigma^2 C)))

on average over the views.  Of the pixelwise part (1 - rho) / (1 - rho_1) is kept; rho_1 is that of a single pixel, which the
diagonal of l'' leaves out already.  (Of an L2 loss's curvature beside SSIM's too much is left out: the pass does not tell them
apart.)  On twelve scenes of 50 to 100 Gaussians this puts the six steepest values at either end off by 4% of the steepest on
average, in place of 27% without it; fern's largest (8,000 Gaussians, 3 views) is estimated as 254 and is 252.

A recurrence from the steepest alone is quick, and may take the neighbour of an end for the end, of which it has nothing: on a
fern of 300 steps, whose two least eigenvalues are 10% apart, in 5 of 5 runs to 1%.  The sum of LEADS directions has some of
either.  Products on average, and how often an end was missed by more than the tolerance, of 144 runs on 24 scenes of 50 to 100
Gaussians:

    to 10%    to 1%      to 0.1%    from
    5.4, 12    9.0, 1    12.1, 0    one of either end
    6.8, 1    10.0, 0    12.9, 0    LEADS
    8.0, 6    11.7, 1    14.6, 0    a random vector
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
from splat.projection.dispatch import projected
from splat.projection.formulas import lens_of

SINGLE = 1 / (4 * pi * SIGMA**2)  # of a pixel alone, what the window's blur keeps
CHUNK = 8192  # Gaussians at a time: CUDA refuses 32,768 blocks and takes up to 1 MB of memory for each
LEADS = 2, 4  # of the largest and of the smallest eigenvalues; negative ones lie closer together
FEW = 256  # Gaussians that are taken apart in any case
BOUND_SLACK = 1e-5  # of a norm, for its rounding
# some eigenvalues of all blocks, the Gaussians whose they are, and the eigenvectors
Ends = tuple[Float64[Tensor, " k"], Int[Tensor, " k"], Float[Tensor, "k w"]]


class BlockEigenvectors:
    """Eigenpairs of the Gaussians' own blocks of the scene's Hessian H; in a metric, of D H D.

    own: the blocks of H, or of its Gauss-Newton part; pixelwise: those of that part, where the loss couples pixels.  attribute:
    any but "sh"; all of these by default.  scale: D, above 0; 1 by default.
    """

    def __init__(
        self,
        objective: SceneObjective,
        own: PerGaussianBlocks,
        pixelwise: PerGaussianBlocks | None = None,
        attribute: str | None = None,
        scale: Float[Tensor, " p"] | None = None,
    ):
        self._like, n = objective.active.flat, len(objective.active)
        D = objective.active.with_flat(torch.ones_like(self._like) if scale is None else scale)
        units = torch.cat([getattr(D, name).reshape(n, -1) for name in GEOMETRY_COLUMNS], dim=1)
        radial = torch.zeros_like(units)
        radial[:, GEOMETRY_COLUMNS["quats"]] = objective.active.quats
        geometry = own.geometry if pixelwise is None else _softened(own, pixelwise, _kept(objective))
        self._blocks, self._columns, self._rows = objective.blocks, GEOMETRY_COLUMNS, self._like.numel()
        if attribute is not None:
            columns = GEOMETRY_COLUMNS[attribute]
            units, radial, geometry = units[:, columns], radial[:, columns], geometry[:, columns, columns]
            self._rows, self._columns = units.numel(), {attribute: slice(0, units.shape[1])}
            self._blocks = {attribute: slice(0, self._rows)}
        self._geometry, self._radial, self._units = geometry, radial, units

    def pairs(self, gaussians: Int[Tensor, " m"]) -> tuple[Float64[Tensor, "m w"], Float[Tensor, "m w w"]]:
        """Eigenvalues of these Gaussians' blocks, ascending, and eigenvectors, in columns; 0 for a quaternion's length."""
        return _taken_apart(*(x[gaussians] for x in (self._geometry, self._radial, self._units)))

    def steepest(self, largest: int, smallest: int) -> Float[Tensor, "p k"]:
        """Unit vectors: of the largest eigenvalues of all blocks but colours', descending, and of the smallest, ascending."""
        _, gaussians, vectors = self._ends(largest, smallest)
        geometry = self._like.new_zeros(*self._units.shape, len(gaussians))
        geometry[gaussians, :, torch.arange(len(gaussians), device=gaussians.device)] = vectors
        result = self._like.new_zeros(self._rows, len(gaussians))
        for name, columns in self._columns.items():
            result[self._blocks[name]] = geometry[:, columns].reshape(-1, len(gaussians))
        return result

    def leads(self) -> Float[Tensor, "p k"]:
        """Where a search for both ends begins."""
        return self.steepest(*LEADS)

    def _ends(self, largest: int, smallest: int) -> Ends:
        """The steepest, with few blocks taken apart.

        No eigenvalue is larger than its block's Frobenius norm: once some of the largest blocks are known, those beneath what
        was found at both ends are left as they are.
        """
        bounds = self._norms()
        some = bounds.topk(min(max(FEW, largest, smallest), len(bounds))).indices
        found = self._ends_of(some, largest, smallest)
        least = torch.cat([found[0][:largest], -found[0][largest:]]).min()
        held = (bounds * (1 + BOUND_SLACK) >= least).nonzero()[:, 0]
        return found if len(held) <= len(some) else self._ends_of(held, largest, smallest)

    def _norms(self) -> Float[Tensor, " n"]:
        """Every block's Frobenius norm; what a quaternion's length has in it counts, too."""
        return (self._geometry * self._units[:, :, None] * self._units[:, None, :]).flatten(1).norm(dim=1)

    def _ends_of(self, gaussians: Int[Tensor, " m"], largest: int, smallest: int) -> Ends:
        values, whose, vectors = _chosen(*self.pairs(gaussians), largest, smallest)
        return values, gaussians[whose], vectors


def _taken_apart(
    blocks: Float[Tensor, "m w w"], radial: Float[Tensor, "m w"], units: Float[Tensor, "m w"]
) -> tuple[Float64[Tensor, "m w"], Float[Tensor, "m w w"]]:
    values = torch.empty_like(units, dtype=torch.float64)
    vectors = torch.empty_like(blocks, memory_format=torch.contiguous_format)

    def decompose(first: int, last: int) -> None:
        for i in range(first, last, CHUNK):
            rows = slice(i, min(i + CHUNK, last))
            values[rows], vectors[rows] = _decomposed(blocks[rows], radial[rows], units[rows])

    over_batch(len(blocks), decompose, blocks.device)
    return values, vectors


def _chosen(values: Float64[Tensor, "m w"], vectors: Float[Tensor, "m w w"], largest: int, smallest: int) -> Ends:
    """Of these blocks' eigenpairs the largest, descending, and the smallest, ascending."""
    length = vectors.norm(dim=1) < 0.5  # of the quaternion, which has no curvature and is left out
    most, width = int((~length).sum()), values.shape[1]
    top = values.masked_fill(length, -inf).flatten().topk(min(largest, most)).indices
    bottom = values.masked_fill(length, inf).flatten().topk(min(smallest, most), largest=False).indices
    chosen = torch.cat([top, bottom])
    whose = chosen // width
    return values.flatten()[chosen], whose, vectors[whose, :, chosen % width]


def _softened(
    own: PerGaussianBlocks, pixelwise: PerGaussianBlocks, kept: Float[Tensor, " n"]
) -> Float[Tensor, "n 11 11"]:
    """The blocks with this share of each Gaussian's pixelwise part."""
    return own.geometry - (1 - kept)[:, None, None].to(own.geometry) * pixelwise.geometry


def _kept(objective: SceneObjective) -> Float64[Tensor, " n"]:
    """The share of a Gaussian's pixelwise part that SSIM's window leaves."""
    views = torch.stack([_evened(objective, view.camera) for view in objective.views])
    rho, drawn = objective.mean(views.sum(dim=0))
    return (1 - rho / drawn) / (1 - SINGLE)


def _evened(objective: SceneObjective, camera: Camera) -> Float64[Tensor, "2 n"]:
    """rho of every Gaussian in a view, and 1; 0 for those behind the camera."""
    splats, _, drawn = projected(objective.active, lens_of(camera, objective.settings))
    rho = evened(splats[:, 2:5])
    return torch.where(drawn, torch.stack([rho, torch.ones_like(rho)]), 0)


def evened(conics: Float64[Tensor, "n 3"]) -> Float64[Tensor, " n"]:
    """rho of splats with these conics a, b, c (px^-2, `projection`): next to nothing is kept of a narrow one.

    >>> wide, narrow = evened(torch.tensor([[1e-4, 0.0, 1e-4], [4.0, 0.0, 1e-4]]))
    >>> print(f"{float(wide):.3f} {float(narrow):.3f}")
    1.000 0.032
    """
    a, b, c = SIGMA**2 * conics.T
    larger = (a + c) / 2 + torch.hypot((a - c) / 2, b)
    return 1 / ((1 + larger) * ((1 + a) * (1 + c) - b**2).sqrt())


def _decomposed(
    blocks: Float[Tensor, "n w w"], radial: Float[Tensor, "n w"], units: Float[Tensor, "n w"]
) -> tuple[Float64[Tensor, "n w"], Float64[Tensor, "n w w"]]:
    """Eigenvalues and vectors of D P B P D, where P projects the quaternions' lengths out."""
    r, d = radial.double()[:, :, None], units.double()[:, :, None]
    values, vectors = torch.linalg.eigh(d * _across(r, _across(r, blocks.double()).mT) * d.mT)
    return values, _across(torch.nn.functional.normalize(r / d, dim=1), vectors)


def _across(r: Float64[Tensor, "n w 1"], B: Float64[Tensor, "n w w"]) -> Float64[Tensor, "n w w"]:
    """B without what it has along the unit vectors r."""
    return B - r * (r * B).sum(dim=1, keepdim=True)
