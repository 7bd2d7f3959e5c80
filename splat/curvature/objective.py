"""The loss of a scene over a set of views, as a function of the Gaussians' stored parameters.

    L(theta) = 1/M sum_m l(I_m(theta)) + R(theta)

theta: the parameters of the active Gaussians, laid out like `Gaussians.flat`; I_m: the render of view m, of M; l: the loss
against its picture; R: regularisers of opacities and scales, where there are any (`losses/regularizers.py`).  Parameters that
no l depends on nearby are removed and counted: Gaussians that touch no pixel of any view, and SH bands not in use; their share
of R is a constant.  Quaternions are normalised: this changes no image, and makes the trace of their block of the Hessian, which
scales with 1/|q|^2, well defined.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from landscape.errors import InputError
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


class NothingInSight(InputError):
    """No view sees any of the Gaussians: there is no Hessian."""


@dataclass(frozen=True)
class ActiveCounts:
    """Numbers of Gaussians and parameters, given and active; images do not depend on the others.

    visible_gaussians: those that touch a pixel of a view; with keep_unseen all.  parameters: stored numbers of all Gaussians.
    active_parameters: those of the active ones in the SH bands in use, less one for the length of each quaternion.
    """

    gaussians: int
    visible_gaussians: int
    parameters: int
    active_parameters: int
    sh_degree_stored: int
    sh_degree_active: int
    views: int


class SceneObjective:
    """The mean loss L over views as a function of the active Gaussians' stored parameters.

    gaussians: not modified.  loss_settings: l and R.  background: RGB in [0, 1], black by default.  sh_degree: of the bands in
    use, by default that of the Gaussians.
    memory: bytes for linearized views and the workspace of their products (`KeptViews`); None: half of the free memory.
    It decides how long products take, not their values.
    keep_unseen: all Gaussians are active, for steps so long that Gaussians out of sight may come into sight.

    active: the Gaussians that touch a pixel of some view (with keep_unseen all), with unit quaternions; L is studied at
    `active.flat` (p,), the lengths of the quaternions included.  mask: which of the given Gaussians are active.  counts:
    numbers of Gaussians and parameters, given and active.

    Raises NothingInSight where no Gaussian is seen, InputError where there is no view or no Gaussian, or a parameter or the
    background is not finite.

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
    ):
        if not views:
            raise InputError("expected at least one view, got none")
        gaussians.require_finite()
        gaussians = gaussians.with_flat(gaussians.flat.detach())
        degree = gaussians.sh_degree if sh_degree is None else sh_degree
        self.views, self.loss_settings, self.memory = tuple(views), loss_settings, memory
        # products give the same bits each time, even where the training's steps do not
        self.settings = replace(settings, accumulation="deterministic")
        self.background = background_of(gaussians, background)
        backend, like = backend_of(gaussians.flat), gaussians.flat
        self._losses = [backend.view_loss(view.image, loss_settings, like) for view in views]
        used = gaussians.select(torch.arange(len(gaussians)), degree)
        seen = used.flat.new_zeros(len(used), dtype=torch.bool)
        for view in views:
            seen |= touches(rasterize_view(used, view.camera, self.background, self.settings, finite=True))
        if not seen.any():
            raise NothingInSight(f"expected Gaussians in sight, got {len(gaussians)} that no view sees")
        self.mask: Bool[Tensor, " n"] = torch.ones_like(seen) if keep_unseen else seen
        self.active = used.select(self.mask)
        quats = self.active.quats  # in active.flat, which `select` has copied
        quats /= quats.norm(dim=1, keepdim=True)
        self._unseen = 0.0  # share of the inactive ones in R
        if loss_settings.opacity_reg or loss_settings.scale_reg:  # else they need not be copied
            self._unseen = Regularizers(used.select(~self.mask), loss_settings, len(gaussians)).value
        n, given, kept = len(self.active), gaussians.flat.numel(), self.active.flat.numel()
        degrees = gaussians.sh_degree, self.active.sh_degree
        self.counts = ActiveCounts(len(gaussians), n, given, kept - n, *degrees, len(views))

    @property
    def couples_pixels(self) -> bool:
        """Whether the loss has second derivatives across pixels, as SSIM has."""
        return self.loss_settings.ssim_weight > 0

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
        """Evaluate (L, smooth piece) at other parameters of the active Gaussians.

        Splats are sorted anew.  The smooth piece identifies the splats that each tile draws and their order.  Between two
        points whose pieces differ L may jump; where they are equal it still can, at alpha_min or a stop within a tile.  Changes
        no state, and may run in several threads at once.
        """
        gaussians = self.active.with_flat(flat.to(self.active.flat.device))
        gaussians.require_finite()
        losses, pieces = zip(*(self.evaluate_view(index, gaussians) for index in range(len(self.views))), strict=True)
        return sum(losses) / len(self.views), pieces

    def evaluate_view(self, index: int, gaussians: Gaussians) -> tuple[float, Hashable]:
        """(l + R, smooth piece) of one view, at finite Gaussians in place of the active ones."""
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
        share, loss = self.counts.visible_gaussians / self.counts.gaussians, self.loss_settings
        return replace(loss, opacity_reg=share * loss.opacity_reg, scale_reg=share * loss.scale_reg)

    def loss(self, flat: Float[Tensor, " p"]) -> float:
        """L at other parameters of the active Gaussians; see `evaluate`."""
        return self.evaluate(flat)[0]

    @cached_property
    def linearized(self) -> KeptViews:
        """The views, linearized at the active Gaussians; made on first use."""
        memory = free_memory(self.active.flat.device) // 2 if self.memory is None else self.memory
        return KeptViews(self.linearizer(self.active), len(self.views), memory)

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
    def losses(self) -> Float64[Tensor, " M"]:
        """l + R of every view at the active Gaussians."""
        return torch.tensor([view.value for view in self.linearized], dtype=torch.float64)

    @cached_property
    def gradient(self) -> Float[Tensor, " p"]:
        """The gradient of L at the active Gaussians."""
        total = torch.zeros_like(self.active.flat)
        for view in self.linearized:
            total += view.gradient
        return total / len(self.views)

    def rays(self, index: int) -> Float[Tensor, "n 3"]:
        """Unit vectors from the centre of a view's camera to the means of the active Gaussians, as in Eq. (7)."""
        means = self.active.means
        return F.normalize(means - self.views[index].camera.centre.to(means), dim=1)

    def block_diagonal(
        self, *, gauss_newton: bool = False, approximate: bool = False, traced: bool = True
    ) -> PerGaussianBlocks:
        """The block of every Gaussian in the Hessian of L, or in its Gauss-Newton part; exact ones with SSIM on the CPU only.

        approximate: with the diagonal of the loss's l'' in place of l'', without SSIM's window.
        traced: with the traces of every view by itself, `PerGaussianBlocks.views`; blocks are means over the views.
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
        space = []
        for done, view in enumerate(self.linearized, start=1):
            found = view.block_diagonals(approximate=approximate, parts=parts, space=space)
            rays = self.rays(done - 1) if traced else None
            traces.append(
                [{} if rays is None else each.traces(self.active.quats) | each.by_rays(rays) for each in found]
            )
            if done == 1:
                totals = found
            else:
                for total, each in zip(totals, found, strict=True):
                    total.add(each)
            if progress:
                progress(done, len(self.views), "blocks of every Gaussian")
        count = len(self.views)
        return [
            PerGaussianBlocks(total.geometry / count, total.sh / count, [each[i] for each in traces])
            for i, total in enumerate(totals)
        ]

    @cached_property
    def exact_blocks(self) -> PerGaussianBlocks:
        """The blocks of the Hessian."""
        return self.block_diagonal()

    @cached_property
    def exact_gauss_newton_blocks(self) -> PerGaussianBlocks:
        """The blocks of its Gauss-Newton part."""
        return self.block_diagonal(gauss_newton=True)

    @cached_property
    def approximate_blocks(self) -> tuple[PerGaussianBlocks, PerGaussianBlocks | None]:
        """The approximate blocks of the Hessian and, where the loss couples pixels, `pixelwise_blocks`."""
        return self.block_diagonal(approximate=True), self.pixelwise_blocks if self.couples_pixels else None

    def known_blocks(self, *, exact: bool) -> tuple[PerGaussianBlocks, PerGaussianBlocks | None]:
        """`exact_blocks`, which leave nothing to sample, or `approximate_blocks`."""
        return (self.exact_blocks, None) if exact else self.approximate_blocks

    @cached_property
    def pixelwise_blocks(self) -> PerGaussianBlocks:
        """The blocks of the Gauss-Newton part with the diagonal of l'' in place of l''."""
        return self.block_diagonal(gauss_newton=True, approximate=True)
