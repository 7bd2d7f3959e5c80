"""The Hessian of a scene's loss, or its Gauss-Newton part, as an operator of `landscape`: P H P.

H is the mean of the views' Hessians.  P projects out the directions in which L is exactly flat (`active_spaces.py`); Gaussians
that no view sees have already been left out by `SceneObjective`.
"""

from collections.abc import Sequence
from functools import cached_property

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.operators.operator import require_vectors
from splat.curvature.linearize import VECTORS
from splat.curvature.null.active_spaces import Projector, projector_of
from splat.curvature.objective import SceneObjective


class ViewSum:
    """The sum of the Hessians, or Gauss-Newton parts, of the views: an operator of `landscape` on their device.

    indices: of the views that are summed; all by default.  ssim_window: False for the pixel-diagonal of the losses' l'' in
    place of l''.
    """

    def __init__(
        self,
        objective: SceneObjective,
        *,
        gauss_newton: bool = False,
        indices: Sequence[int] | None = None,
        ssim_window: bool = True,
    ):
        self.objective, self.gauss_newton, self.ssim_window = objective, gauss_newton, ssim_window
        self.indices = range(len(objective.views)) if indices is None else indices
        self.dim, self.dtype, self.blocks = objective.active.flat.numel(), objective.active.flat.dtype, objective.blocks

    def apply(self, V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        require_vectors(V, self.dim, self.dtype)
        parts = [part.contiguous() for part in V.split(VECTORS, dim=1)]
        totals = [torch.zeros_like(part, dtype=self.dtype) for part in parts]
        for view in map(self.objective.linearized.__getitem__, self.indices):
            product = view.ggn if self.gauss_newton else view.hvp
            for part, total in zip(parts, totals, strict=True):
                if view.affects(part):
                    product(part, total, ssim_window=self.ssim_window)
        return torch.cat(totals, dim=1) if len(totals) > 1 else totals[0]

    def forms(self, V: Float[Tensor, "p k"]) -> Float64[Tensor, "m k"]:
        """v . H_m v for each view m and each column v; 0 for views that are not summed."""
        found = torch.zeros(len(self.objective.views), V.shape[1], dtype=torch.float64)
        for index in self.indices:
            view = self.objective.linearized[index]
            product = view.ggn if self.gauss_newton else view.hvp
            found[index] = (V.double() * product(V, ssim_window=self.ssim_window)).sum(dim=0).cpu()
        return found


class SceneHessian:
    """H of L, or its Gauss-Newton part J^T l'' J, on the complement of its exact null space: P H P.

    A `landscape` operator: `dim` = p, `blocks` (the attributes), `dtype`, and `apply(V)`, which gives its result on V's device.

    For the Hessian, P removes the lengths of the quaternions (null where the gradient vanishes, and by choice elsewhere) and
    the SH directions that no view sees; for Gauss-Newton, all directions that no view sees.  keep_null: P = 1 instead.
    indices: only the part of H due to these views, as for a `landscape.DistributedOperator`, which adds the parts of several
    processes.  ssim_window: see `ViewSum`.

    views: H without P, summed over the views.  projector: P.

    >>> import torch
    >>> from splat import SceneObjective, SyntheticSettings, synthetic_scene
    >>> made = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12))
    >>> H = SceneHessian(SceneObjective(made.truth, made.scene.load()))
    >>> H.apply(torch.ones(H.dim, 2)).shape == (H.dim, 2), H.rank < H.dim
    (True, True)
    """

    def __init__(
        self,
        objective: SceneObjective,
        *,
        gauss_newton: bool = False,
        keep_null: bool = False,
        indices: Sequence[int] | None = None,
        ssim_window: bool = True,
    ):
        self.objective, self.gauss_newton, self.keep_null = objective, gauss_newton, keep_null
        self.views = ViewSum(objective, gauss_newton=gauss_newton, indices=indices, ssim_window=ssim_window)
        self.dim, self.dtype, self.blocks = self.views.dim, self.views.dtype, self.views.blocks

    @cached_property
    def projector(self) -> Projector:
        return projector_of(self.objective, gauss_newton=self.gauss_newton)

    @property
    def rank(self) -> int:
        """The dimension of the range of P."""
        return self.dim if self.keep_null else self.projector.rank

    def project(self, V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        """P V."""
        return V if self.keep_null else self.projector.apply(V)

    def apply(self, V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        require_vectors(V, self.dim, self.dtype)
        return self.project(self.views.apply(self._argument(V)) / len(self.objective.views)).to(V.device)

    def _argument(self, V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        """Vectors with the same H V as P V, at less cost than P."""
        V = V.to(self.objective.active.flat.device)
        return V if self.keep_null else self.projector.without_lengths(V)

    def by_view(self, V: Float[Tensor, "p k"]) -> Float64[Tensor, "m k"]:
        """v . P H_m P v of every view's part of H and each column: their mean over the views is v . P H P v."""
        return self.views.forms(self._argument(V))
