"""The two ways in which a method of second order solves for its step.

newton-blocks: every Gaussian's own damped Newton step, all at once, and one exact minimum along it.

    y = M b,   M = (|blocks| + lambda)^-1       as if each Gaussian were alone (`damped_blocks.py`)
    c          the model's minimum in the plane of y and the last step, from one product of both with the whole Hessian;
               along eigenvectors of negative curvature in that plane its absolute value is taken

The blocks leave out what Gaussians over one pixel have to do with each other, which c restores in part.  The plane is that of
K-FAC (Martens and Grosse 2015, Sec. 7); without momentum it is the line along y.

gn-cg: Gauss-Newton, or Newton, over all parameters and views at once, by preconditioned conjugate gradients.

(A + lambda) y = b (`steps.py`) to a residual of rtol, or with so many products, which are exact.  The preconditioner M is of
the Gaussians' own blocks; that of published methods, 3DGS-LM (Hoellein et al., ICCV 2025) and LM-RS (arXiv 2504.12905), is the
diagonal of J^T J.  Where conjugate gradients meet negative curvature they end with what they have, and lambda rises.
"""

from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import column_dots, gram, norm
from landscape.operators.cg import conjugate_gradients
from landscape.operators.operator import product
from splat.model.gaussians import Gaussians
from splat.model.typed import Length, Share
from splat.training.methods.second_order.steps import LocalModel, Proposal, SecondOrder, SecondOrderMethod


@dataclass(frozen=True)
class NewtonBlocks(SecondOrder):
    """momentum: whether the plane holds the last step."""

    name: Literal["newton-blocks"] = "newton-blocks"
    momentum: bool = True

    def create(self, seed: int) -> "NewtonBlocksMethod":
        return NewtonBlocksMethod(self, seed)


class NewtonBlocksMethod(SecondOrderMethod[NewtonBlocks]):
    """last: the last step, of all stored parameters; None before the first."""

    last: Float[Tensor, " p"] | None = None

    def propose(self, local: LocalModel, damping: float) -> Proposal:
        columns = [local.metric.inverse(damping)(local.b)]
        if self.settings.momentum and self.last is not None and len(self.last) == len(local.mask) * local.each:
            columns.append(local.in_unknowns(self.last.to(local.b)))
        Y = torch.stack([column / norm(column) for column in columns if norm(column) > 0], dim=1)
        curvature, slope = gram(Y, product(local.A, Y)), gram(Y, local.b[:, None])[:, 0]
        c = minimum(curvature + damping * gram(Y, Y), slope)
        return Proposal(Y @ c.to(Y), float(slope @ c - c @ curvature @ c / 2))

    def taken(self, before: Gaussians, after: Gaussians) -> None:
        self.last = after.flat - before.flat

    def state(self) -> dict[str, Any]:
        return {**super().state(), "last": self.last}

    def restore(self, state: dict[str, Any]) -> None:
        super().restore(state)
        self.last = state["last"]
        if not (
            self.last is None or (isinstance(self.last, Tensor) and self.last.ndim == 1 and self.last.isfinite().all())
        ):
            raise InputError("'last': expected a vector of finite numbers")


def minimum(A: Float[Tensor, "k k"], b: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
    """|A|^-1 b, where |A| has the absolute values of A's eigenvalues; nothing along those that rounding may have left of 0.

    >>> minimum(torch.tensor([[2.0, 0.0], [0.0, -4.0]]), torch.tensor([1.0, 1.0])).tolist()
    [0.5, 0.25]
    """
    values, vectors = torch.linalg.eigh(A)
    values, parts = values.abs(), vectors.T @ b
    kept = values > 1e-6 * values.max()
    return vectors @ torch.where(kept, parts / values.where(kept, torch.ones_like(values)), 0.0)


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
