"""The loss of a scene over a set of views, as a function of the Gaussians' stored parameters.

    L(theta) = 1/M sum_m l(I_m(theta)) + R(theta)

theta: the parameters of the active Gaussians, laid out like `Gaussians.flat`; I_m: the render of view m; l: the loss against
its picture; R: regularisers of opacities and scales, where there are any (`losses/regularizers.py`).  Parameters that no l can
depend on are removed and counted: Gaussians that touch no pixel of any view, and SH bands not in use; their share of R is a
constant.  Quaternions are brought to unit length: the image does not change, and the trace of their block of the Hessian, which
scales with 1/|q|^2, gets a meaning.

Processes can share the views (`landscape.Ranks`): every rank holds some views and all Gaussians.

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
from splat.backend.memory import free_memory, give_back_freed
from splat.curvature.gaussian_blocks import PerGaussianBlocks
from splat.curvature.linearize import KeptViews, LinearizedView
from splat.losses.autograd import loss_against
from splat.losses.reference import LossSettings
from splat.losses.regularizers import Regularizers
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.forward import background_of, rasterize_view, touches
from splat.scenes.view import View

OWN_BLOCK = 11 * 11  # numbers of a Gaussian's block without SH
KEPT_BLOCKS = 4  # approximate and exact ones, each of the Hessian and of a Gauss-Newton part
COPIES = 5  # of a vector, in a product: itself, without its null part, the sum, a view's, the result
FEWEST, AT_ONCE = 8, 4  # vectors of a small basis; of a product


class NothingInSight(InputError):
    """No view sees any of the Gaussians: there is no Hessian."""


@dataclass(frozen=True)
class ActiveCounts:
    """Counts of what is left of a set of Gaussians in the objective, and of what was removed because L is exactly flat there.

    active_gaussians: those that touch a pixel of some view.  parameters: stored numbers of all Gaussians.  active_parameters:
    those of the active ones in the SH bands in use, less one for each quaternion, whose length does not count.
    radial_quaternions: how many such lengths were removed.  views: of all processes.
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
class Needs:
    """Estimated bytes of a vector over the active parameters, a linearised view, a product for each of its vectors, the kept
    diagonal blocks of Gaussians, and the pass that makes them.
    """

    vector: int
    view: int
    product: int
    blocks: int
    making_blocks: int

    @property
    def beside(self) -> int:
        """Memory needed beside linearised views: blocks, a small basis, and the larger of a product and the blocks' pass."""
        return self.blocks + FEWEST * self.vector + max(AT_ONCE * self.product, self.making_blocks)


class SceneObjective:
    """The mean loss L over views as a function of the active Gaussians' stored parameters.

    gaussians: n, none of them changed.  loss_settings: l.  background: RGB in [0, 1], black by default.  sh_degree: of the
    bands in use, those of the Gaussians by default.
    memory: bytes for linearized views and the workspace of their products (`KeptViews`); by default half of what is free, or an
    even part of it where several ranks share a CPU.  It decides how long products take, not their values.
    keep_unseen: all Gaussians are active, for steps so long that they may bring into sight what no view sees at first.
    ranks: processes that share the views; `views` are those of this one.

    active: the Gaussians that touch a pixel of some view, with unit quaternions; L is studied at `active.flat` (p,).  mask:
    which of the given Gaussians they are.  counts: how much was removed.

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
        flat, degree = gaussians.flat, gaussians.sh_degree if sh_degree is None else sh_degree
        setup = (len(gaussians), flat.dtype, degree, loss_settings, background, settings, keep_unseen)
        ranks.require_same("set-up", setup)
        ranks.require_same_vectors(flat[:, None])
        if gaussians.filter_widths is not None:
            ranks.require_same_vectors(gaussians.filter_widths[:, None])
        self.views, self.loss_settings, self.ranks = tuple(views), loss_settings, ranks
        self._views_of_ranks = [int(count) for count in ranks.gather(torch.tensor(len(views)))]
        # products are repeatable, however the training's steps were made
        self.settings = replace(settings, accumulation="deterministic")
        self.background = background_of(gaussians, background)
        self._losses = [loss_against(view.image, loss_settings, flat) for view in views]
        used = gaussians.select(torch.arange(len(gaussians)), degree)
        self.mask: Bool[Tensor, " n"] = self._seen(used)
        if not self.mask.any():
            raise NothingInSight(f"expected Gaussians in sight, got {len(gaussians)} of which no view sees any")
        if keep_unseen:
            self.mask = torch.ones_like(self.mask)
        self.active = used.select(self.mask)
        regularized = loss_settings.opacity_reg or loss_settings.scale_reg
        self._unseen = (
            Regularizers(used.select(~self.mask), loss_settings, len(gaussians)).value if regularized else 0.0
        )
        quats = self.active.quats
        quats /= quats.norm(dim=1, keepdim=True)
        self.counts = ActiveCounts(
            gaussians=len(gaussians),
            active_gaussians=len(self.active),
            parameters=flat.numel(),
            active_parameters=self.active.flat.numel() - len(self.active),
            sh_degree=gaussians.sh_degree,
            active_sh_degree=degree,
            radial_quaternions=len(self.active),
            views=sum(self._views_of_ranks),
        )
        sharing = 1 if flat.device.type == "cuda" else ranks.size
        if memory is None:
            free = free_memory(flat.device) // sharing
            memory = min(free // 2, max(free - self.needs.beside, self.needs.view))
        self._memory = memory

    def _seen(self, gaussians: Gaussians) -> Bool[Tensor, " n"]:
        """Mask of the Gaussians that touch a pixel of some view of any rank."""
        seen, self._sizes = gaussians.flat.new_zeros(len(gaussians), dtype=torch.bool), (0, 0, 0)
        for view in self.views:
            raster = rasterize_view(gaussians, view.camera, self.background, self.settings, finite=True)
            seen |= touches(raster)
            self._sizes = max(self._sizes, LinearizedView.size_of(raster, gaussians, self.settings))
        return self.ranks.any(seen)

    @property
    def needs(self) -> "Needs":
        """About what the largest view and its products take."""
        view, workspace, blocks = self._sizes
        n, flat = len(self.active), self.active.flat
        own = n * flat.element_size() * (OWN_BLOCK + 3 * (self.active.sh_degree + 1) ** 2)
        return Needs(flat.nbytes, view, workspace + COPIES * flat.nbytes, KEPT_BLOCKS * own, max(blocks + own, 3 * own))

    @property
    def couples_pixels(self) -> bool:
        """Whether the loss has second derivatives across pixels, as SSIM has."""
        return self.loss_settings.ssim_weight > 0

    @property
    def view_numbers(self) -> range:
        """Places of this rank's views among all views."""
        first = sum(self._views_of_ranks[: self.ranks.rank])
        return range(first, first + len(self.views))

    @property
    def blocks(self) -> Mapping[str, slice]:
        """The rows of each attribute."""
        return self.active.blocks

    def evaluate(self, flat: Float[Tensor, " p"]) -> tuple[float, Hashable]:
        """(L, smooth piece) at other parameters of the active Gaussians.

        Splats are rendered and sorted anew.  The smooth piece stands for the splats that each tile draws and their order: L may
        be discontinuous between two points whose pieces differ.  Changes nothing, and may run in several threads at once.
        """
        gaussians = self.active.with_flat(flat.to(self.active.flat.device))
        gaussians.require_finite()
        losses, pieces = zip(*(self.evaluate_view(index, gaussians) for index in range(len(self.views))), strict=True)
        mean = self.mean_over_views(torch.tensor(sum(losses), dtype=torch.float64))
        return float(mean), self.gather_pieces(hash(pieces))

    def evaluate_view(self, index: int, gaussians: Gaussians) -> tuple[float, Hashable]:
        """(l, smooth piece) of one view of this rank, at finite Gaussians in place of the active ones."""
        raster = rasterize_view(gaussians, self.views[index].camera, self.background, self.settings, finite=True)
        return self._losses[index].value(raster.planes) + self.regularizers(gaussians).value, raster.draw_order

    def regularizers(self, gaussians: Gaussians) -> Regularizers:
        """R at Gaussians in place of the active ones, of whose value those out of sight have their share."""
        found = Regularizers(gaussians, self.loss_settings, self.counts.gaussians)
        found.value += self._unseen
        return found

    @property
    def loss_of_active(self) -> LossSettings:
        """The loss as that of a scene of the active Gaussians alone: with their share in the means of R."""
        share, loss = self.counts.active_gaussians / self.counts.gaussians, self.loss_settings
        return replace(loss, opacity_reg=share * loss.opacity_reg, scale_reg=share * loss.scale_reg)

    def loss(self, flat: Float[Tensor, " p"]) -> float:
        """L alone, as of `evaluate`."""
        return self.evaluate(flat)[0]

    def mean_over_views(self, total: Tensor) -> Tensor:
        """The mean over all views, given the sum over this rank's views."""
        return self.ranks.sum(total) / self.counts.views

    def of_all_views(self, rows: Shaped[Tensor, "m ..."]) -> Shaped[Tensor, "_ ..."]:
        """A row for every view of all processes, given those of this rank's views."""
        whole = rows.new_zeros(self.counts.views, *rows.shape[1:])
        whole[self.view_numbers.start : self.view_numbers.stop] = rows
        return self.ranks.sum(whole)

    def gather_rows(self, rows: Float[Tensor, "n m d"]) -> Float[Tensor, "n _ d"]:
        """The rows of all views, given those of this rank's views: as many for each view."""
        each = rows.shape[1] // len(self.views)
        counts = [count * each for count in self._views_of_ranks]
        padded = torch.nn.functional.pad(rows, (0, 0, 0, max(counts) - rows.shape[1]))
        parts = self.ranks.gather(padded)
        return torch.cat([part[:, :count] for part, count in zip(parts, counts, strict=True)], dim=1)

    def gather_pieces(self, piece: int) -> Hashable:
        """The smooth piece of L over all views, given that over this rank's views."""
        return tuple(int(each) for each in self.ranks.gather(torch.tensor(piece)))

    @cached_property
    def linearized(self) -> KeptViews:
        """This rank's views, linearized at the active Gaussians; made on first use."""
        return KeptViews(self.linearizer(self.active), len(self.views), self._memory)

    def release(self) -> None:
        """Free the linearized views, also for other processes; they are made anew on their next use."""
        vars(self).pop("linearized", None)
        give_back_freed()

    def linearizer(self, gaussians: Gaussians) -> Callable[[int], LinearizedView]:
        """Function that linearizes the view of an index, at the active Gaussians or, for comparison, at others.

        It does not refer to this objective, which would otherwise be freed only when Python looks for circles.
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

        approximate: with the diagonal of the loss's l'' in place of l'', without the coupling of pixels by SSIM.
        traced: with the traces of every view.
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
        """`block_diagonal` of several parts at once; parts: which are Gauss-Newton."""
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
        """The mean over all views, given the sum over this process's and the traces of each."""
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
