"""The Hessian's blocks of single Gaussians, taken apart: where the search for the ends of the spectrum begins, and goes.

Steep eigenvectors of a scene live on one or two Gaussians, and the block of a Gaussian's own rows, but for its colours, is
known exactly (`linearize.OwnBlocks`); of its colours the diagonal is.  Their eigenvectors, at right angles to the quaternions'
lengths as in `curvature.SceneHessian`, are where to begin, and with the eigenvalues they are what Davidson's method wants to
know of the Hessian (`landscape.davidson`).

Where the loss couples pixels, its curvature l'' is known pixel by pixel only, which is too much: SSIM does not care for what
changes a window evenly.  Of what the pixels say each attribute keeps the share COUPLING, between two attributes the root of
both: about what `traces.exact_traces` finds on fern (8,000 to 44,000 Gaussians of four methods: positions 0.83 to 0.95,
rotations 0.77 to 0.84, the others 0.11 to 0.35).  The two largest and the smallest eigenvalue of fern (8,000 Gaussians, 3
views) to 10% then take 21 products in 7 passes over the pixels instead of 26 in 12, and a recurrence from the steepest of them
35 in 34; to 0.1% 34 in 18, 42 in 26 and 49 in 48.  Where the ends are of like magnitude a recurrence needs fewer vectors
(`lead`): 18 where Davidson's method takes 29 on 60 Gaussians all over each other, and 7 where it takes 17 on a fern with ends
26 times apart.
"""

from collections.abc import Callable
from math import inf

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from splat.curvature import SceneObjective
from splat.linearize import GEOMETRY_COLUMNS, OwnBlocks
from splat.raster.threads import over_range

COUPLING = {"means": 0.9, "log_scales": 0.3, "quats": 0.8, "opacity_logits": 0.3, "sh": 0.2}
SPARE = 2  # starts at each end beside one for each wanted pair
APART = 30.0  # the ratio of two ends from which a recurrence needs more passes and time than Davidson's method
CHUNK = 65_536  # Gaussians at a time


class OwnDirections:
    """An `Approximation` of the scene's Hessian, or of its block of one attribute but colours; in a metric, of D H D.

    own: of the Hessian, or of its Gauss-Newton part; pixelwise: of that part, where the loss couples pixels.  attribute: all by
    default; scale: D, above 0, 1 by default.  values: (n, w), of the blocks, ascending; vectors: (n, w, w), theirs, in columns,
    0 for a quaternion's length; sh: (n, m), the diagonal of the colours, none for one attribute.
    """

    def __init__(
        self,
        objective: SceneObjective,
        own: OwnBlocks,
        pixelwise: OwnBlocks | None = None,
        attribute: str | None = None,
        scale: Float[Tensor, " p"] | None = None,
    ):
        self._like, n = objective.active.flat, len(objective.active)
        D = objective.active.with_flat(torch.ones_like(self._like) if scale is None else scale)
        units = torch.cat([getattr(D, name).reshape(n, -1) for name in GEOMETRY_COLUMNS], dim=1)
        radial = torch.zeros_like(units)
        radial[:, GEOMETRY_COLUMNS["quats"]] = objective.active.quats
        geometry, sh = (own.geometry, own.sh) if pixelwise is None else _softened(own, pixelwise)
        self.sh: Float[Tensor, "n m"] = (sh * D.sh.square()).flatten(1)
        self._blocks, self._columns = objective.blocks, GEOMETRY_COLUMNS
        if attribute is not None:
            columns, self.sh = GEOMETRY_COLUMNS[attribute], self.sh[:, :0]
            units, radial, geometry = units[:, columns], radial[:, columns], geometry[:, columns, columns]
            rows, self._columns = units.numel(), {attribute: slice(0, units.shape[1])}
            self._blocks = {attribute: slice(0, rows), "sh": slice(rows, rows)}
        self.values: Float64[Tensor, "n w"] = torch.empty_like(units, dtype=torch.float64)
        self.vectors: Float[Tensor, "n w w"] = torch.empty_like(geometry, memory_format=torch.contiguous_format)

        def decompose(first: int, last: int) -> None:
            for i in range(first, last, CHUNK):
                rows = slice(i, min(i + CHUNK, last))
                self.values[rows], self.vectors[rows] = _decomposed(geometry[rows], radial[rows], units[rows])

        if geometry.device.type == "cpu":  # torch itself takes one thread for a batch
            over_range(n, decompose)
        else:
            decompose(0, n)

    def steepest(self, largest: int, smallest: int) -> Float[Tensor, "p k"]:
        """Unit vectors: of the largest eigenvalues of all blocks but colours', descending, and of the smallest, ascending."""
        length = self.vectors.norm(dim=1) < 0.5  # of the quaternion, which has no curvature and is left out
        values, most = self.values.masked_fill(length, inf).flatten(), int((~length).sum())
        bottom = values.topk(min(smallest, most), largest=False).indices
        top = values.masked_fill(length.flatten(), -inf).topk(min(largest, most)).indices
        chosen = torch.cat([top, bottom])
        geometry = self._like.new_zeros(*self.values.shape, len(chosen))
        gaussians, columns = chosen // self.values.shape[1], chosen % self.values.shape[1]
        geometry[gaussians, :, torch.arange(len(chosen), device=chosen.device)] = self.vectors[gaussians, :, columns]
        return self._joined(geometry, self._like.new_zeros(*self.sh.shape, len(chosen)))

    def lead(self, largest: int, smallest: int) -> tuple[Float[Tensor, "p k"], "OwnDirections | None"]:
        """Where to begin the search for so many pairs, and what it is to follow: None for a recurrence (`landscape.eigen`).

        A recurrence sees both ends with each product, and needs about the root of the ratio of their magnitudes more of them
        than where they are alike.  Davidson's method aims at each: with SPARE starts more at both ends, as which of them is the
        steepest is not certain.
        """
        magnitudes = self.values.max().abs(), self.values.min().abs()
        if not (largest and smallest) or float(min(magnitudes)) * APART > float(max(magnitudes)):
            return self.steepest(largest, smallest), None
        return self.steepest(largest + SPARE, smallest + SPARE), self

    def function(self, f: Callable[[Tensor], Tensor], V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        """f(D) V, where V is."""
        home, V = V.device, V.to(self._like)
        n, k = len(self.values), V.shape[1]
        geometry = torch.cat([V[self._blocks[name]].reshape(n, -1, k) for name in self._columns], dim=1)
        geometry = self.vectors @ (f(self.values).to(V)[:, :, None] * (self.vectors.mT @ geometry))
        return self._joined(geometry, f(self.sh)[:, :, None] * V[self._blocks["sh"]].view(*self.sh.shape, k)).to(home)

    def _joined(self, geometry: Float[Tensor, "n w k"], sh: Float[Tensor, "n m k"]) -> Float[Tensor, "p k"]:
        """Vectors laid out as the scene's parameters, or the attribute's."""
        result = self._like.new_empty(self.values.numel() + self.sh.numel(), geometry.shape[2])
        for name, columns in self._columns.items():
            result[self._blocks[name]] = geometry[:, columns].reshape(-1, geometry.shape[2])
        result[self._blocks["sh"]] = sh.reshape(-1, geometry.shape[2])
        return result


def _softened(own: OwnBlocks, pixelwise: OwnBlocks) -> tuple[Float[Tensor, "n 11 11"], Float[Tensor, "n k 3"]]:
    """The blocks with the shares COUPLING of the pixelwise part."""
    root = own.geometry.new_empty(own.geometry.shape[1])
    for name, columns in GEOMETRY_COLUMNS.items():
        root[columns] = COUPLING[name] ** 0.5
    geometry = own.geometry - (1 - root[:, None] * root) * pixelwise.geometry
    return geometry, own.sh - (1 - COUPLING["sh"]) * pixelwise.sh


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
