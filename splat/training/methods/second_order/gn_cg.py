"""gn-cg: Gauss-Newton, or Newton, over all parameters and views at once, by preconditioned conjugate gradients.

(A + lambda) y = b (`steps.py`) to a residual of rtol, or with so many products, which are exact.  The preconditioner M is of
the Gaussians' own blocks; that of published methods, 3DGS-LM (Hoellein et al., ICCV 2025) and LM-RS (arXiv 2504.12905), is the
diagonal of J^T J.  Where conjugate gradients meet negative curvature they end with what they have, and lambda rises.
"""

from dataclasses import dataclass
from typing import Literal

from landscape.linalg import column_dots
from landscape.operators.cg import conjugate_gradients
from splat.model.typed import Length, Share
from splat.training.methods.second_order.steps import LocalModel, Proposal, SecondOrder, SecondOrderMethod


@dataclass(frozen=True)
class GaussNewtonCG(SecondOrder):
    """rtol, products: when conjugate gradients end.  preconditioner: the blocks, or their diagonals alone (Jacobi)."""

    name: Literal["gn-cg"] = "gn-cg"
    preconditioner: Literal["blocks", "diagonal"] = "blocks"
    rtol: Share = 0.1
    products: Length = 20

    def create(self, seed: int) -> "GaussNewtonCGMethod":
        return GaussNewtonCGMethod(self, seed)


class GaussNewtonCGMethod(SecondOrderMethod[GaussNewtonCG]):
    def propose(self, local: LocalModel, damping: float) -> Proposal:
        settings = self.settings
        M = local.metric.inverse(damping, diagonal=settings.preconditioner == "diagonal")
        found = conjugate_gradients(local.A, local.b, M, damping, settings.rtol, settings.products)
        y, curved = found.x, found.Ax - damping * found.x
        fall = float(column_dots((local.b - curved / 2)[:, None], y[:, None]))
        return Proposal(y, fall, found.reason == "negative curvature")
