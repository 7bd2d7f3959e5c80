"""A scene's views spread over processes (`landscape.operators.distributed`): every rank holds some views and all Gaussians.

    ranks = Ranks.joined()
    objective = DistributedObjective(gaussians, scene.load(ranks.share(names)), ranks)
    hessian = DistributedHessian(objective)

Loss, gradient, own blocks, the products H V and the projector off the null space are those of all views, the same on every
rank; so are the traces of `exact_traces` and all that `landscape` finds with the operator.
"""

from collections.abc import Hashable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from landscape.operators.distributed import Ranks
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective, free_memory
from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.scenes.view import View


class DistributedObjective(SceneObjective):
    """The mean loss over the views of all ranks; `views` are this rank's.  Its methods are collective.

    memory: for this rank's views; by default half of what is free on its GPU, or on CPUs an even part of half of what is free,
    as if all ranks were on one machine.
    Raises ValueError on all ranks where their Gaussians differ.
    """

    collective = True

    def __init__(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        ranks: Ranks,
        loss: LossSettings = LossSettings(),
        background: Float[Tensor, "3"] | None = None,
        settings: RenderSettings = RenderSettings(),
        sh_degree: int | None = None,
        memory: int | None = None,
    ):
        self.ranks = ranks
        ranks.require_same("set-up", (len(gaussians), gaussians.flat.dtype, sh_degree, loss, background, settings))
        ranks.require_same_vectors(gaussians.flat[:, None])
        self.held_views: list[int] = [int(count) for count in ranks.gather(torch.tensor(len(views)))]
        if memory is None:
            memory = free_memory(gaussians.flat.device) // 2
            memory //= 1 if gaussians.flat.device.type == "cuda" else ranks.size
        super().__init__(gaussians, views, loss, background, settings, sh_degree, memory)
        self.counts = replace(self.counts, views=sum(self.held_views))

    def _support(self, gaussians: Gaussians) -> Bool[Tensor, " n"]:
        return self.ranks.any(super()._support(gaussians))

    @property
    def view_numbers(self) -> range:
        first = sum(self.held_views[: self.ranks.rank])
        return range(first, first + len(self.views))

    def mean(self, total: Tensor) -> Tensor:
        return self.ranks.sum(total) / sum(self.held_views)

    def total(self, count: int) -> int:
        return int(self.ranks.sum(torch.tensor(count)))

    def stacked(self, rows: Float[Tensor, "n m d"]) -> Float[Tensor, "n _ d"]:
        each = rows.shape[1] // len(self.views)
        counts = [count * each for count in self.held_views]
        padded = torch.nn.functional.pad(rows, (0, 0, 0, max(counts) - rows.shape[1]))
        parts = self.ranks.gather(padded)
        return torch.cat([part[:, :count] for part, count in zip(parts, counts, strict=True)], dim=1)

    def joined(self, piece: int) -> Hashable:
        return tuple(int(each) for each in self.ranks.gather(torch.tensor(piece)))


class DistributedHessian(SceneHessian):
    """`SceneHessian` of a `DistributedObjective`.  Collective: every rank applies it to the same vectors."""

    objective: DistributedObjective

    def apply(self, V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        self.objective.ranks.require_same_vectors(V)
        return super().apply(V)
