"""Diagonal blocks of a Hessian, one for each Gaussian: 11 x 11 for geometry and opacity, and the diagonal for SH.

Rows and columns are stored parameters: mean, log-scales, quaternion w x y z, opacity logit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jaxtyping import Float, Float64
from torch import Tensor

from landscape.results import ShortRepr
from splat.model.gaussians import Gaussians

GEOMETRY_COLUMNS = {
    "means": slice(0, 3), "log_scales": slice(3, 6), "quats": slice(6, 10), "opacity_logits": slice(10, 11),
}  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class PerGaussianBlocks(ShortRepr):
    """A block for every Gaussian: geometry, over the attributes in GEOMETRY_COLUMNS, and the diagonal of its SH.

    views: for a mean over views, the `traces` of each view's blocks, and those `by_rays`; else empty.
    """

    geometry: Float[Tensor, "n 11 11"]
    sh: Float[Tensor, "n k 3"]
    views: Sequence[Mapping[str, float]] = ()

    def add(self, other: "PerGaussianBlocks") -> None:
        """Add other blocks in place."""
        self.geometry.add_(other.geometry)
        self.sh.add_(other.sh)

    def add_diagonal(self, parts: Mapping[str, Float[Tensor, "n ..."]]) -> None:
        """Add a diagonal, given by attribute in GEOMETRY_COLUMNS, in place."""
        for name, part in parts.items():
            self.geometry.diagonal(dim1=1, dim2=2)[:, GEOMETRY_COLUMNS[name]] += part.view(len(part), -1)

    def traces(self, quats: Float[Tensor, "n 4"] | None = None, scale: Gaussians | None = None) -> dict[str, float]:
        """Trace of each attribute's block, summed in double precision.

        quats: unit quaternions; P projects them out, and traces are of P B P.  scale: the diagonal of D, as Gaussians; traces
        are of D P B P D.
        """
        diagonals = self.diagonals if quats is None else self.diagonals_across(quats)
        if scale is not None:
            units = scale.attributes
            diagonals = {name: part * units[name].double().view_as(part).square() for name, part in diagonals.items()}
        return {name: float(part.sum()) for name, part in diagonals.items()}

    def by_rays(self, rays: Float[Tensor, "n 3"]) -> dict[str, float]:
        """Traces of the means' blocks H along rays v, v^T H v ("depth"), and across them, tr H - v^T H v ("lateral")."""
        H, v = self.geometry[:, :3, :3].double(), rays.double()
        depth = float((v[:, None, :] @ H @ v[:, :, None]).sum())
        return {"depth": depth, "lateral": float(H.diagonal(dim1=1, dim2=2).sum()) - depth}

    @property
    def diagonals(self) -> dict[str, Float64[Tensor, "n ..."]]:
        """The diagonal, attribute by attribute."""
        diagonal = self.geometry.diagonal(dim1=1, dim2=2).double()
        return {**{name: diagonal[:, columns] for name, columns in GEOMETRY_COLUMNS.items()}, "sh": self.sh.double()}

    def diagonals_across(self, quats: Float[Tensor, "n 4"]) -> dict[str, Float64[Tensor, "n ..."]]:
        """The diagonal of P B P, where P projects out the unit quaternions quats."""
        q, columns, diagonals = quats.double(), GEOMETRY_COLUMNS["quats"], self.diagonals
        along = (self.geometry[:, columns, columns].double() @ q[:, :, None])[:, :, 0]
        turns = diagonals["quats"] - 2 * q * along + q.square() * (q * along).sum(dim=1, keepdim=True)
        return {**diagonals, "quats": turns}
