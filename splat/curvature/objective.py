"""The loss of a scene over a set of views, as a function of the Gaussians' stored parameters.

    L(theta) = 1/M sum_m l(I_m(theta)) + R(theta)

theta: the parameters of the active Gaussians, laid out like `Gaussians.flat`; I_m: the render of view m; l: the loss against
its picture; R: regularisers of opacities and scales, where there are any (`losses/regularizers.py`).  Parameters that no l can
depend on are removed and counted: Gaussians that touch no pixel of any view, and SH bands not in use; their share of R is a
constant.  Quaternions are normalised: this changes no image, and makes the trace of their block of the Hessian, which scales
with 1/|q|^2, well defined.

Processes can share the views (`landscape.Ranks`): every rank has some of the views, and all Gaussians.

    ranks = Ranks.joined()
    objective = SceneObjective(gaussians, scene.load(ranks.share(names)), ranks=ranks)

Loss, gradient, blocks and products with the Hessian are then those of all views, the same on every rank, and every rank has to
call the objective's methods in the same order.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Float64, Shaped
from torch import Tensor

from landscape.errors import InputError
from landscape.operators.distributed import ALONE, Ranks
from landscape.results import Progress
from splat.backend.memory import free_memory
from splat.curvature.gaussian_blocks import PerGaussianBlocks
from splat.curvature.linearize import KeptViews, LinearizedView
from splat.losses.reference import LossSettings
from splat.losses.regularizers import Regularizers
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.backend import backend_of
from splat.render.forward import background_of, rasterize_view, touches
from splat.scenes.view import View

GEOMETRY_BLOCK = 11 * 11  # numbers of a Gaussian's block without SH
KEPT_BLOCKS = 4  # sets of blocks: approximate and exact ones, each of the Hessian and of a Gauss-Newton part
COPIES = 5  # of a vector in a product: the argument, its projection, the sum over views, a view's product, the result
BASIS, BATCH = 8, 4  # vectors of the smallest basis of an eigensolver, and in its products


class NothingInSight(InputError):
    """No view sees any of the Gaussians: there is no Hessian."""


@dataclass(frozen=True)
class ActiveCounts:
    """Numbers of Gaussians and parameters, given and active; L is exactly flat in the others.

    active_gaussians: those that touch a pixel of some view.  parameters: stored numbers of all Gaussians.  active_parameters:
    those of the active ones in the SH bands in use, less one for the length of each quaternion.  radial_quaternions: number of
    such lengths.  views: of all processes.
    """

    gaussians: int
    active_gaussians: int
    parameters: int
    active_parameters: int
    sh_degree: int
    active_sh_degree: int
    radial_quaternions: int
    views: int

    @classmethod
    def of(cls, gaussians: Gaussians, active: Gaussians, views: int) -> "ActiveCounts":
        """gaussians: all that are given, with all their SH bands; active: with those in use."""
        return cls(
            gaussians=len(gaussians),
            active_gaussians=len(active),
            parameters=gaussians.flat.numel(),
            active_parameters=active.flat.numel() - len(active),
            sh_degree=gaussians.sh_degree,
            active_sh_degree=active.sh_degree,
            radial_quaternions=len(active),
            views=views,
        )


@dataclass(frozen=True)
class Needs:
    """Estimated bytes.

    vector: of a vector over the active parameters.  view: of the largest linearised view.  product: of a product, for each of
    its vectors.  blocks: of the diagonal blocks of Gaussians that are kept.  making_blocks: of the pass that computes them.
    """

    vector: int
    view: int
    product: int
    blocks: int
    making_blocks: int

    @property
    def beside(self) -> int:
        """Bytes needed in addition to linearised views: blocks, a small basis, and a product or the blocks' pass."""
        return self.blocks + BASIS * self.vector + max(BATCH * self.product, self.making_blocks)


class SceneObjective:
    """The mean loss L over views as a function of the active Gaussians' stored parameters.

    gaussians: not modified.  loss_settings: l and R.  background: RGB in [0, 1], black by default.  sh_degree: of the bands in
    use, by default that of the Gaussians.
    memory: bytes for linearized views and the workspace of their products (`KeptViews`); by default half of what is free,
    divided among the ranks that share a CPU.  It decides how long products take, not their values.
    keep_unseen: all Gaussians are active, for steps so long that Gaussians out of sight may come into sight.
    ranks: processes that share the views; `views` are those of this one.

    active: the Gaussians that touch a pixel of some view, with unit quaternions; L is studied at `active.flat` (p,).  mask:
    which of the given Gaussians are active.  counts: how many Gaussians and parameters are.

    Raises NothingInSight where no Gaussian is seen, InputError where there is no view or no Gaussian, a parameter or the
    background is not finite, or ranks have different Gaussians or settings.

    >>> from splat import SyntheticSettings, synthetic_scene
    >>> made = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12))
    >>> objective = SceneObjective(made.truth, made.scene.load())
    >>> round(objective.loss(objective.active.flat), 6), objective.gradient.shape == objective.active.flat.shape
    (0.0, True)
    """

    def __init__(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        loss_settings: LossSettings = LossSettings(),
        background: Float[Tensor, "3"] | None = None,
        settings: RenderSettings = RenderSettings(),
        sh_degree: int | None = None,
        memory: int | None = None,
        keep_unseen: bool = False,
        ranks: Ranks = ALONE,
    ):
        if not views:
            raise InputError("expected at least one view, got none")
        gaussians.require_finite()
        gaussians = gaussians.with_flat(gaussians.flat.detach())
        degree = gaussians.sh_degree if sh_degree is None else sh_degree
        _require_same(ranks, gaussians, degree, loss_settings, background, settings, keep_unseen)
        self.views, self.loss_settings, self.ranks = tuple(views), loss_settings, ranks
        self._views_of_ranks = [int(count) for count in ranks.gather(torch.tensor(len(views)))]
        # products give the same bits each time, even where the training's steps do not
        self.settings = replace(settings, accumulation="deterministic")
        self.background = background_of(gaussians, background)
        self._losses = [
            backend_of(gaussians.flat).view_loss(view.image, loss_settings, gaussians.flat) for view in views
        ]
        used = gaussians.select(torch.arange(len(gaussians)), degree)
        seen, self._sizes = self._first_look(used)
        if not seen.any():
            raise NothingInSight(f"expected Gaussians in sight, got {len(gaussians)} of which no view sees any")
        self.mask: Bool[Tensor, " n"] = torch.ones_like(seen) if keep_unseen else seen
        self.active = used.select(self.mask)
        quats = self.active.quats
        quats /= quats.norm(dim=1, keepdim=True)
        self._unseen = 0.0  # share of the inactive ones in R
        if loss_settings.opacity_reg or loss_settings.scale_reg:  # else they need not be copied
            self._unseen = Regularizers(used.select(~self.mask), loss_settings, len(gaussians)).value
        self.counts = ActiveCounts.of(gaussians, self.active, sum(self._views_of_ranks))
        self._memory = self._memory_of_views() if memory is None else memory

    def _first_look(self, gaussians: Gaussians) -> tuple[Bool[Tensor, " n"], tuple[int, int, int]]:
        """Mask of those that touch a pixel of some view of any rank; `LinearizedView.size_of` the largest view of this one."""
        seen, sizes = gaussians.flat.new_zeros(len(gaussians), dtype=torch.bool), (0, 0, 0)
        for view in self.views:
            raster = rasterize_view(gaussians, view.camera, self.background, self.settings, finite=True)
            seen |= touches(raster)
            sizes = max(sizes, LinearizedView.size_of(raster, gaussians, self.settings))
        return self.ranks.any(seen), sizes

    def _memory_of_views(self) -> int:
        """Bytes free to this rank, less those needed beside the views: those of one view at least, half of the free at most."""
        device = self.active.flat.device
        free = free_memory(device) // (1 if device.type == "cuda" else self.ranks.size)
        return min(free // 2, max(free - self.needs.beside, self.needs.view))

    @property
    def needs(self) -> "Needs":
        """Estimated memory of the largest view, its products, and the blocks of the Gaussians."""
        view, workspace, sums = self._sizes
        n, flat = len(self.active), self.active.flat
        blocks = n * flat.element_size() * (GEOMETRY_BLOCK + 3 * (self.active.sh_degree + 1) ** 2)
        product, making_blocks = workspace + COPIES * flat.nbytes, max(sums + blocks, 3 * blocks)
        return Needs(flat.nbytes, view, product, KEPT_BLOCKS * blocks, making_blocks)

    @property
    def couples_pixels(self) -> bool:
        """Whether the loss has second derivatives across pixels, as SSIM has."""
        return self.loss_settings.ssim_weight > 0

    @property
    def view_numbers(self) -> range:
        """Indices of this rank's views among all views."""
        first = sum(self._views_of_ranks[: self.ranks.rank])
        return range(first, first + len(self.views))

    @property
    def blocks(self) -> Mapping[str, slice]:
        """The rows of each attribute."""
        return self.active.blocks

    @property
    def block_dims(self) -> dict[str, int]:
        """The dimension of each attribute's block, without the lengths of the quaternions."""
        dims = {name: rows.stop - rows.start for name, rows in self.blocks.items()}
        return {**dims, "quats": dims["quats"] - len(self.active)}

    def evaluate(self, flat: Float[Tensor, " p"]) -> tuple[float, Hashable]:
        """(L, smooth piece) at other parameters of the active Gaussians.

        Splats are sorted anew.  The smooth piece identifies the splats that each tile draws and their order: L may be
        discontinuous between two points whose pieces differ.  Changes no state, and may run in several threads at once.
        """
        gaussians = self.active.with_flat(flat.to(self.active.flat.device))
        gaussians.require_finite()
        losses, pieces = zip(*(self.evaluate_view(index, gaussians) for index in range(len(self.views))), strict=True)
        mean = self.mean_over_views(torch.tensor(sum(losses), dtype=torch.float64))
        return float(mean), tuple(int(piece) for piece in self.ranks.gather(torch.tensor(hash(pieces))))

    def evaluate_view(self, index: int, gaussians: Gaussians) -> tuple[float, Hashable]:
        """(l + R, smooth piece) of one view of this rank, at finite Gaussians in place of the active ones."""
        raster = rasterize_view(gaussians, self.views[index].camera, self.background, self.settings, finite=True)
        return self._losses[index].value(raster.planes) + self.regularizers(gaussians).value, raster.draw_order

    def regularizers(self, gaussians: Gaussians) -> Regularizers:
        """R at these Gaussians in place of the active ones; its value includes the share of the inactive ones."""
        found = Regularizers(gaussians, self.loss_settings, self.counts.gaussians)
        found.value += self._unseen
        return found

    @property
    def loss_of_active(self) -> LossSettings:
        """The loss for a scene of the active Gaussians alone: weights of R are scaled, since its means are over all."""
        share, loss = self.counts.active_gaussians / self.counts.gaussians, self.loss_settings
        return replace(loss, opacity_reg=share * loss.opacity_reg, scale_reg=share * loss.scale_reg)

    def loss(self, flat: Float[Tensor, " p"]) -> float:
        """L at other parameters of the active Gaussians; see `evaluate`."""
        return self.evaluate(flat)[0]

    def mean_over_views(self, total: Tensor) -> Tensor:
        """The mean over all views, from the sum over this rank's views."""
        return self.ranks.sum(total) / self.counts.views

    def of_all_views(self, rows: Shaped[Tensor, "m ..."]) -> Shaped[Tensor, "_ ..."]:
        """The rows of all views, one a view, from those of this rank's views."""
        whole = rows.new_zeros(self.counts.views, *rows.shape[1:])
        whole[self.view_numbers.start : self.view_numbers.stop] = rows
        return self.ranks.sum(whole)

    def gather_rows(self, rows: Float[Tensor, "n m d"]) -> Float[Tensor, "n _ d"]:
        """The rows of all views, from those of this rank's views; every view has the same number of them."""
        each = rows.shape[1] // len(self.views)
        counts = [count * each for count in self._views_of_ranks]
        padded = torch.nn.functional.pad(rows, (0, 0, 0, max(counts) - rows.shape[1]))
        parts = self.ranks.gather(padded)
        return torch.cat([part[:, :count] for part, count in zip(parts, counts, strict=True)], dim=1)

    @cached_property
    def linearized(self) -> KeptViews:
        """This rank's views, linearized at the active Gaussians; made on first use."""
        return KeptViews(self.linearizer(self.active), len(self.views), self._memory)

    def release(self) -> None:
        """Free the linearized views; the next use makes them anew."""
        vars(self).pop("linearized", None)

    def linearizer(self, gaussians: Gaussians) -> Callable[[int], LinearizedView]:
        """A function that linearizes the view of an index at these Gaussians.

        It holds no reference to this objective: a reference cycle would keep the objective until the garbage collector runs.
        """
        cameras, losses = [view.camera for view in self.views], self._losses
        background, settings, regularizers = self.background, self.settings, self.regularizers(gaussians)
        return lambda index: LinearizedView(
            gaussians, cameras[index], losses[index], background, settings, regularizers
        )

    @cached_property
    def losses(self) -> Float64[Tensor, " m"]:
        """The loss of every view at the active Gaussians."""
        return self.of_all_views(torch.tensor([view.value for view in self.linearized], dtype=torch.float64))

    @cached_property
    def gradient(self) -> Float[Tensor, " p"]:
        """The gradient of L at the active Gaussians."""
        total = torch.zeros_like(self.active.flat)
        for view in self.linearized:
            total += view.gradient
        return self.mean_over_views(total)

    def block_diagonal(
        self, *, gauss_newton: bool = False, approximate: bool = False, traced: bool = True
    ) -> PerGaussianBlocks:
        """The block of every Gaussian in the Hessian of L, or in its Gauss-Newton part: exact, on the CPU.

        approximate: with the diagonal of the loss's l'' in place of l'', without SSIM's window.
        traced: with the traces of every view, `PerGaussianBlocks.views`.
        """
        return self.block_diagonals(approximate=approximate, parts=(gauss_newton,), traced=traced)[0]

    def block_diagonals(
        self,
        *,
        approximate: bool = False,
        parts: Sequence[bool] = (False, True),
        traced: bool = True,
        progress: Progress | None = None,
    ) -> list[PerGaussianBlocks]:
        """`block_diagonal` for each of parts (True: Gauss-Newton), which share passes over the pixels."""
        totals: list[PerGaussianBlocks] = []
        traces: list[list[dict[str, float]]] = []
        for done, view in enumerate(self.linearized, start=1):
            found = view.block_diagonals(approximate=approximate, parts=parts)
            traces.append([each.traces(self.active.quats) if traced else {} for each in found])
            for total, each in zip(totals, found, strict=False):  # none before the first view
                total.add(each)
            totals = totals or found
            if progress:
                progress(done, len(self.views), "blocks of every Gaussian")
        return [self._mean_of_blocks(total, [each[i] for each in traces]) for i, total in enumerate(totals)]

    def _mean_of_blocks(self, total: PerGaussianBlocks, traces: Sequence[Mapping[str, float]]) -> PerGaussianBlocks:
        """The mean over all views, from the sum over this rank's views and the traces of each."""
        rows = self.of_all_views(torch.tensor([list(each.values()) for each in traces], dtype=torch.float64))
        views = [dict(zip(traces[0], row, strict=True)) for row in rows.tolist()]
        return PerGaussianBlocks(self.mean_over_views(total.geometry), self.mean_over_views(total.sh), views)

    @cached_property
    def exact_blocks(self) -> list[PerGaussianBlocks]:
        """The blocks of the Hessian and of its Gauss-Newton part."""
        return self.block_diagonals()

    @cached_property
    def approximate_blocks(self) -> tuple[PerGaussianBlocks, PerGaussianBlocks | None]:
        """The approximate blocks of the Hessian and, where the loss couples pixels, `pixelwise_blocks`."""
        return self.block_diagonal(approximate=True), self.pixelwise_blocks if self.couples_pixels else None

    @cached_property
    def pixelwise_blocks(self) -> PerGaussianBlocks:
        """The blocks of the Gauss-Newton part with the diagonal of l'' in place of l''."""
        return self.block_diagonal(gauss_newton=True, approximate=True)


def _require_same(ranks: Ranks, gaussians: Gaussians, *settings: object) -> None:
    """Raise InputError on all ranks unless they have the same Gaussians and settings."""
    ranks.require_same("set-up", (len(gaussians), gaussians.flat.dtype, *settings))
    ranks.require_same_vectors(gaussians.flat[:, None])
    if gaussians.filter_widths is not None:
        ranks.require_same_vectors(gaussians.filter_widths[:, None])
