"""The Hessian of a scene's loss, or its Gauss-Newton part, as an operator of `landscape`: P H P.

P leaves out what is exactly flat (`null_space.py`); what no view sees at all has already been left out by `SceneObjective`.
"""

from collections.abc import Callable
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.operators.operator import require_vectors
from splat.backend.gpu.graphs import CudaGraphCache, CudaGraphs
from splat.curvature.null_space import RowSpace, seen_harmonics, seen_parameters
from splat.curvature.objective import SceneObjective


class SceneHessian:
    """H of L, or its Gauss-Newton part J^T l'' J, on the complement of its exact null space (`null_space.py`): P H P.

    A `landscape` operator: `dim` = p, `blocks` (the attributes), `dtype`, `apply(V)`, which gives its result on V's device.  P
    leaves out, for the Hessian, the lengths of the quaternions (null where the gradient vanishes, and by choice elsewhere) and
    the SH directions that no view sees; for Gauss-Newton all that no view sees.  keep_null: P = 1 instead.

    passes, spared: products of a view with a vector that were made, and that were left out because the vector moves no
    Gaussian that the view draws (V on a few Gaussians, say).
    """

    def __init__(self, objective: SceneObjective, *, gauss_newton: bool = False, keep_null: bool = False):
        self.objective, self.gauss_newton, self.keep_null = objective, gauss_newton, keep_null
        self.dim = objective.active.flat.numel()
        self.blocks = objective.blocks
        self.dtype = objective.active.flat.dtype
        self.passes, self.spared = 0, 0

    @cached_property
    def _row_space(self) -> RowSpace:
        n, bands = len(self.objective.active), self.objective.active.sh.shape[1]
        held = [view.held for view in self.objective.linearized]
        seen = seen_parameters if self.gauss_newton else seen_harmonics
        return seen(held, n, bands, self.objective.stacked)

    @property
    def rank(self) -> int:
        """The dimension of what P keeps."""
        if self.keep_null:
            return self.dim
        seen = int(self._row_space.rank.sum())
        n = len(self.objective.active)
        return seen if self.gauss_newton else 10 * n + 3 * seen  # mean 3, log-scales 3, quaternion 3, logit 1

    def project(self, V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        """P V."""
        if self.keep_null:
            return V
        return self._projected(V, self._row_space, self.objective.active.quats)

    def scaled_projector(self, scale: Float[Tensor, " p"]) -> Callable[[Tensor], Tensor]:
        """Of D P H P D, D = diag(scale) > 0 and alike for the channels of a colour: the orthogonal projector onto all D P x."""
        if self.keep_null:
            return self.project
        n, quats = len(self.objective.active), self.objective.active.quats
        parts = {name: scale[rows].view(n, -1) for name, rows in self.blocks.items()}
        space = self._row_space.scaled(
            torch.cat([*parts.values()], dim=1) if self.gauss_newton else parts["sh"][:, ::3]
        )
        radial = torch.nn.functional.normalize(quats / parts["quats"], dim=1)
        return lambda V: self._projected(V, space, radial)

    def _projected(self, V: Tensor, seen: RowSpace, radial: Tensor) -> Tensor:
        """What of V is seen; of the Hessian: the part of V in the seen harmonics and at right angles to `radial`."""
        n, K = len(self.objective.active), V.shape[1]
        if self.gauss_newton:
            parts = [V[rows].reshape(n, -1, K) for rows in self.blocks.values()]
            sizes = [part.shape[1] for part in parts]
            kept = seen.project(torch.cat(parts, dim=1)).split(sizes, dim=1)
            return torch.cat([part.reshape(-1, K) for part in kept])
        V = V.clone()
        turns, harmonics = V[self.blocks["quats"]].view(n, 4, K), V[self.blocks["sh"]]
        turns -= radial[:, :, None] * (radial[:, :, None] * turns).sum(dim=1, keepdim=True)
        harmonics.copy_(seen.project(harmonics.view(n, -1, 3 * K)).reshape(-1, K))
        return V

    def apply(self, V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        require_vectors(V, self.dim)
        home, V = V.device, self.project(V.to(self.objective.active.flat.device))
        spared = self.spared
        total = self._recordings(self.launched, V) if self.objective.recordable(V.shape[1]) else self.launched(V)
        self.passes += V.shape[1] * len(self.objective.views) - (self.spared - spared)
        return self.project(self.objective.mean(total)).to(home)

    @cached_property
    def _recordings(self) -> CudaGraphCache:
        return CudaGraphCache(CudaGraphs(self.objective.active.flat.device))

    def launched(self, V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        """The views' products, added up; not recorded."""
        total = torch.zeros_like(V, dtype=self.dtype)
        at_once = self.objective.memory_plan.vectors
        for view in self.objective.linearized:
            for start in range(0, V.shape[1], at_once):
                some = V[:, start : start + at_once]
                if not view.affects(some):
                    self.spared += some.shape[1]
                    continue
                total[:, start : start + at_once] += view.ggn(some) if self.gauss_newton else view.hvp(some)
        return total
