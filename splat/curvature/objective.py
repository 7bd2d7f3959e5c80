"""The loss of a scene over a set of views as an objective, and its Hessian as an operator of `landscape`.

`SceneObjective` holds what stands still: views, loss, background, thresholds, and which Gaussians matter.  Removed from the
operator, exactly, and counted: Gaussians that touch no pixel of any view, SH bands not in use, the radial direction of each
quaternion (a null direction of the image), and directions that no view sees (`null_space.py`).  Quaternions are brought to
unit length first: the image does not change, and the trace of their block, which scales with 1/|q|^2, gets a meaning.

    L(theta) = 1/M sum_m l(I_m(theta)),   theta the stored parameters of the active Gaussians, laid out like Gaussians.flat
"""

from collections.abc import Hashable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from operator import add

import psutil
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splat.curvature.gaussian_blocks import PerGaussianBlocks
from splat.curvature.linearize import LinearizedView
from splat.losses.autograd import loss_against
from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.forward import rasterize_view, touches
from splat.scenes.view import View

MOST_VECTORS = 8  # beyond it a block of vectors gains no more: it has left the second-level cache
RECORDED = 1 << 28  # bytes of workspace, up to which a GPU has made a view's product before its kernels are launched


class NothingInSight(ValueError):
    """No view sees any of the Gaussians: there is no Hessian."""


def free_memory(device: torch.device) -> int:
    """Free bytes where the Gaussians are; on a GPU with those that torch holds for tensors to come."""
    if device.type != "cuda":
        return psutil.virtual_memory().available
    held = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return torch.cuda.mem_get_info(device)[0] + held


@dataclass(frozen=True)
class ActiveCounts:
    """What of a set of Gaussians is left in the operator, and what was removed as exactly flat.

    active_gaussians: those that touch a pixel of some view.  parameters, active_parameters: stored numbers of all, and of the
    active ones in the SH bands in use, less one for each quaternion, whose length does not count.  radial_quaternions: how
    many such lengths were removed.
    """

    gaussians: int
    active_gaussians: int
    parameters: int
    active_parameters: int
    sh_degree: int
    active_sh_degree: int
    radial_quaternions: int
    views: int


@dataclass(frozen=True)
class MemoryPlan:
    """What a memory budget decides: `kept` of the `views` stay linearised, the others are linearised anew for every product.

    vectors: how many vectors a product takes at a time.
    """

    kept: int
    views: int
    vectors: int


class SceneObjective:
    """The mean loss L over views as a function of the active Gaussians' stored parameters.

    gaussians: those of the checkpoint; sh_degree: of the bands in use (theirs by default).  background: RGB in [0, 1], black by
    default.  `active` are the Gaussians that touch a pixel of some view, with unit quaternions: `active.flat` (p,) is the point
    at which L is studied; `mask` says which of the given ones they are, `counts` how many of what was removed.
    memory: bytes that linearised views and the workspace of their products may take (half of what is free by default); see
    `memory_plan`.  keep_unseen: all Gaussians are active, for steps so long that they may bring into sight what no view sees
    here.  Raises NothingInSight where no Gaussian is seen, ValueError where there is no view or a parameter is not finite.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        loss: LossSettings = LossSettings(),
        background: Float[Tensor, "3"] | None = None,
        settings: RenderSettings = RenderSettings(),
        sh_degree: int | None = None,
        memory: int | None = None,
        keep_unseen: bool = False,
    ):
        if not views:
            raise ValueError("expected at least one view, got none")
        gaussians.require_finite()
        flat, degree = gaussians.flat, gaussians.sh_degree if sh_degree is None else sh_degree
        self.views = tuple(views)
        # products are repeatable, however the training's steps were made
        self.settings = replace(settings, sums="ordered")
        self.background = flat.new_zeros(3) if background is None else background.to(flat)
        self.couples_pixels = loss.ssim_weight > 0
        self._losses = [loss_against(view.image, loss, flat) for view in views]
        everyone = gaussians.select(torch.arange(len(gaussians)), degree)
        self.mask: Bool[Tensor, " n"] = self._support(everyone)
        if not self.mask.any():
            raise NothingInSight(f"expected Gaussians in sight, got {len(gaussians)} of which no view sees any")
        if keep_unseen:
            self.mask = torch.ones_like(self.mask)
        active = everyone.select(self.mask)
        quats = active.quats
        quats /= quats.norm(dim=1, keepdim=True)
        self.active = active
        self.counts = ActiveCounts(
            gaussians=len(gaussians),
            active_gaussians=len(active),
            parameters=flat.numel(),
            active_parameters=active.flat.numel() - len(active),
            sh_degree=gaussians.sh_degree,
            active_sh_degree=degree,
            radial_quaternions=len(active),
            views=len(views),
        )
        self._memory = free_memory(flat.device) // 2 if memory is None else memory
        self._kept: dict[int, LinearizedView] = {}

    def _support(self, gaussians: Gaussians) -> Bool[Tensor, " n"]:
        seen = gaussians.flat.new_zeros(len(gaussians), dtype=torch.bool)
        for view in self.views:
            seen |= touches(rasterize_view(gaussians, view.camera, self.background, self.settings, finite=True))
        return seen

    def of_views(self, count: int) -> "SceneObjective":
        """The objective over the first `count` views alone; what is held still is shared."""
        part = copy(self)
        part.views, part._losses = self.views[:count], self._losses[:count]
        part.counts = replace(self.counts, views=count)
        part.memory_plan = replace(self.memory_plan, kept=min(self.memory_plan.kept, count), views=count)
        for name in ("gradient", "gaussian_blocks", "pixelwise_blocks"):  # those of all views
            part.__dict__.pop(name, None)
        return part

    collective = False  # whether processes share the views, and so have to call every method together, one at a time

    @property
    def view_numbers(self) -> range:
        """Where the views that this process holds stand among all views: here they are all."""
        return range(len(self.views))

    @property
    def blocks(self) -> Mapping[str, slice]:
        return self.active.blocks

    def evaluate(self, flat: Float[Tensor, " p"]) -> tuple[float, Hashable]:
        """L at other parameters of the active Gaussians, and the smooth piece of L that they lie in.

        L is rendered and sorted anew; the piece is a signature of which splats each tile draws, in which order.  Changes
        nothing, and may run in several threads at once.
        """
        gaussians = self.active.with_flat(flat.to(self.active.flat.device))
        gaussians.require_finite()
        losses, pieces = zip(*(self.evaluate_view(index, gaussians) for index in range(len(self.views))), strict=True)
        return float(self.mean(torch.tensor(sum(losses), dtype=torch.float64))), self.joined(hash(pieces))

    def evaluate_view(self, index: int, gaussians: Gaussians) -> tuple[float, Hashable]:
        """The same of one view that this process holds, at finite Gaussians in place of the active ones."""
        raster = rasterize_view(gaussians, self.views[index].camera, self.background, self.settings, finite=True)
        return self._losses[index].value(raster.planes), raster.order

    def loss(self, flat: Float[Tensor, " p"]) -> float:
        """L alone, as of `evaluate`."""
        return self.evaluate(flat)[0]

    def signature(self, flat: Float[Tensor, " p"]) -> Hashable:
        """The smooth piece alone, as of `evaluate`."""
        return self.evaluate(flat)[1]

    def mean(self, total: Tensor) -> Tensor:
        """The mean over all views, given the sum over those that this process holds: here all of them."""
        return total / len(self.views)

    def total(self, count: int) -> int:
        """The sum over the processes that share the views, given this one's part."""
        return count

    def stacked(self, rows: Float[Tensor, "n m d"]) -> Float[Tensor, "n _ d"]:
        """The rows of all views, given those of the views that this process holds: here all of them."""
        return rows

    def joined(self, piece: int) -> Hashable:
        """The piece of L, given that of the views that this process holds: here all of them."""
        return piece

    @cached_property
    def memory_plan(self) -> "MemoryPlan":
        """Which views are kept linearised and how many vectors a product takes at a time; linearises the first view."""
        first = self.linearize(0)
        self._kept[0] = first
        spare = self._memory - first.bytes - first.workspace(1)
        per_vector = max(first.workspace(2) - first.workspace(1), 1)
        more = min(max(spare // first.bytes, 0), len(self.views) - 1)
        vectors = 1 + max(spare - more * first.bytes, 0) // per_vector
        return MemoryPlan(1 + int(more), len(self.views), int(min(vectors, MOST_VECTORS)))

    @property
    def linearized(self) -> Iterator[LinearizedView]:
        """Every view held still at the active Gaussians: kept after the first time, or rebuilt, as `memory_plan` says."""
        kept = self.memory_plan.kept
        for index in range(len(self.views)):
            if index < kept and index not in self._kept:
                self._kept[index] = self.linearize(index)
            yield self._kept[index] if index < kept else self.linearize(index)

    def recordable(self, vectors: int) -> bool:
        """Whether products with so many vectors are worth a recording: of views on a GPU, all kept, and small."""
        plan = self.memory_plan
        if self.active.flat.device.type != "cuda" or plan.kept < plan.views:
            return False
        return self._kept[0].workspace(min(vectors, plan.vectors)) <= RECORDED

    def linearize(self, index: int, gaussians: Gaussians | None = None) -> LinearizedView:
        """A view held still at the active Gaussians or, for comparison, at others; nothing is kept."""
        camera, at = self.views[index].camera, self.active if gaussians is None else gaussians
        return LinearizedView(at, camera, self._losses[index], self.background, self.settings)

    @cached_property
    def gradient(self) -> Float[Tensor, " p"]:
        """The gradient of L at the active Gaussians."""
        return self.mean(torch.stack([view.gradient for view in self.linearized]).sum(dim=0))

    def block_diagonal(self, *, gauss_newton: bool = False) -> PerGaussianBlocks:
        """Every Gaussian's own block of the Hessian of L, or of its Gauss-Newton part.

        Exact but for the coupling of pixels by SSIM: the loss's curvature l'' enters pixel by pixel.
        """
        parts = (view.block_diagonal(gauss_newton=gauss_newton) for view in self.linearized)
        total = reduce(add, parts)
        return PerGaussianBlocks(self.mean(total.geometry), self.mean(total.sh))

    @cached_property
    def gaussian_blocks(self) -> tuple[PerGaussianBlocks, PerGaussianBlocks | None]:
        """Own blocks of the Hessian and, where the loss couples pixels, of what it is pixel by pixel alone."""
        return self.block_diagonal(), self.pixelwise_blocks if self.couples_pixels else None

    @cached_property
    def pixelwise_blocks(self) -> PerGaussianBlocks:
        """Own blocks of the Gauss-Newton part as it is pixel by pixel: all of it, where the loss does not couple pixels."""
        return self.block_diagonal(gauss_newton=True)
