"""The loss of one view, linearised: its value and gradient, and exact products of its Hessian with vectors.

The loss is l(C(P(theta))): the projection P gives splats, the compositing C an image I, and l compares it with the photograph.
A prime is a derivative.  With g = l' (the gradient in I) and a = C'^T g,

    gradient  P'^T C'^T g
    J u       C' P' u
    G u       P'^T C'^T l'' C' P' u                                          (Gauss-Newton; l'' may be indefinite: SSIM)
    H u       P'^T [ C'^T l'' C' P' u + (g . C'')(P' u) ] + (a . P'') u

Regularisers are added to value, gradient and H u; they have no part in G u.

P' and a . P'' of the Gaussians that reach a tile before its pixels stop, tile lists, final transmittances, g and a are
computed once.  H U is then two passes over the pixels for k vectors together, the columns of U (p, k), laid out like
`Gaussians.flat`; G U takes one for all vectors, and one more for each.
Taken as constant, as they are piecewise: the order of the splats, the alpha_min cut, where a pixel stops, which clamps hold.

Shapes: p parameters, n splats, k vectors, 9 numbers of a splat (place, inverse covariance, opacity, colour), h x w
pixels of the image, H x W (in shapes) of whole tiles, 4 planes: red, green, blue, accumulated alpha.

Tangents and adjoints of splats are in the coordinates of `projection/whitening.py`.  On a GPU, products do not synchronise with
the device.
"""

from collections.abc import Callable, Iterator, Sequence
from math import prod
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.operators.operator import require_vectors
from splat.curvature.gaussian_blocks import PerGaussianBlocks
from splat.losses.protocols import ViewLoss
from splat.losses.reference import LossSettings
from splat.losses.regularizers import Regularizers
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.formulas import ProjectionJacobian, lens_of, row_shapes
from splat.render.backend import Adjoint, Raster, Tangent, backend_of
from splat.render.formulas import BLOCK_SUMS
from splat.render.forward import rasterize_view, touches

# a linearized loss keeps: target, its moments, gradient, SSIM's blur(S_p) (`losses/formulas.py`), l'', l'' of ones
LOSS_PLANES = 34
DOUBLE_BLOCK = 8 * 9 * 9  # bytes of a 9 x 9 block in double precision
VECTORS = 8  # most vectors in a product at a time: more would not fit into the second-level cache


class LinearizedView:
    """A view's loss, linearised at its Gaussians: `.value`, `.image`, `.gradient`, `.jvp(U)`, `.vjp(G)`, `.hvp(U)`, `.ggn(U)`.

    loss: compares images with the view's, from `Backend.view_loss`.  regularizers: added to the loss; by default
    none.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        loss: ViewLoss,
        background: Float[Tensor, "3"],
        settings: RenderSettings = RenderSettings(),
        regularizers: Regularizers | None = None,
    ):
        self.gaussians = gaussians
        self._regularizers = regularizers or Regularizers(gaussians, LossSettings(), len(gaussians))
        self._raster = rasterize_view(gaussians, camera, background, settings)
        self._loss, self._couples = loss.linearize(self._raster.planes), loss.couples_pixels
        self._adjoint = self._raster.backward(self._loss.gradient)
        self._index = self._raster.touched  # of the Gaussians that reach a tile before its pixels stop
        self._projection = backend_of(gaussians.flat).linearize_projection(
            gaussians, lens_of(camera, settings), self._raster.splats, self._adjoint.moments, self._index
        )

    @property
    def value(self) -> float:
        return self._loss.value + self._regularizers.value

    @property
    def gradient(self) -> Float[Tensor, " p"]:
        """The gradient of the loss, computed anew at each call: keeping it would take p numbers for every view."""
        return self._regularizers.add_gradient(self._pullback([self._adjoint])[:, 0])

    @property
    def image(self) -> Float[Tensor, "3 h w"]:
        return self._raster.crop(self._raster.planes[:3]).clone()

    @staticmethod
    def size_of(raster: Raster, gaussians: Gaussians, settings: RenderSettings) -> tuple[int, int, int]:
        """Estimates, for a view with this raster, of `bytes`, `workspace(1)` and the bytes that `block_diagonals` takes."""
        size, drawn = gaussians.flat.element_size(), len(raster.touched)
        plane = raster.planes[0].nbytes
        rows = row_shapes(antialiased=settings.antialias != "none" or gaussians.filter_widths is not None)
        kept = raster.bytes + size * (drawn * sum(map(prod, rows)) + 9 * len(gaussians)) + LOSS_PLANES * plane
        blocks = size * raster.intersections_reached * BLOCK_SUMS + drawn * DOUBLE_BLOCK
        return kept, raster.workspace(1) + 3 * plane, blocks

    @property
    def intersections(self) -> int:
        """Number of (splat, tile) pairs that a product passes over."""
        return self._raster.intersections_reached

    @property
    def dark_tiles(self) -> int:
        """Number of tiles with splats where the loss has no slope and no pixelwise curvature: backward passes may skip them."""
        return self._raster.dark_tiles(self._adjoint, self._loss.diagonal)

    @property
    def touched(self) -> int:
        """Number of Gaussians that reach a tile of this view before its pixels stop."""
        return len(self._index)

    @property
    def jacobian(self) -> ProjectionJacobian:
        """Derivatives of the projection of the Gaussians with weight in some pixel; takes a pass over the pixels."""
        jacobian = self._projection.jacobian
        visible = touches(self._raster)[jacobian.index]
        return ProjectionJacobian(*(part[visible] for part in jacobian))

    @property
    def bytes(self) -> int:
        """Memory kept for the products; the adjoint's cotangent is the loss's gradient, and is counted with the loss."""
        return self._raster.bytes + self._projection.bytes + self._loss.bytes + self._adjoint.bytes

    def workspace(self, vectors: int) -> int:
        """Bytes that `hvp` of so many vectors takes, without argument, result and a few rows of pixels for each thread."""
        return self._raster.workspace(vectors) + self._loss.workspace(vectors)

    def affects(self, U: Float[Tensor, "p k"]) -> bool:
        """Whether products can be other than 0: some vector changes a Gaussian that is drawn or regularised.

        Always True on a GPU, where the test would synchronise with the device.
        """
        return self._projection.affects(U) or self._regularizers.affects(U)

    def jvp(self, U: Float[Tensor, "p k"]) -> Float[Tensor, "k 4 h w"]:
        """J U: tangents of colour and accumulated alpha."""
        return self._raster.crop(self._tangent(U).planes).contiguous()

    def vjp(self, G: Float[Tensor, "k 4 h w"]) -> Float[Tensor, "p k"]:
        """J^T times cotangents (here G, not Gauss-Newton's) of colour and accumulated alpha."""
        if G.dtype != self.gaussians.flat.dtype:
            raise ValueError(f"expected cotangents of {self.gaussians.flat.dtype}, got {G.dtype}; use G.to(...)")
        return self._pullback([self._raster.backward(self._raster.pad(g)) for g in G])

    def hvp(
        self, U: Float[Tensor, "p k"], total: Float[Tensor, "p k"] | None = None, *, ssim_window: bool = True
    ) -> Float[Tensor, "p k"]:
        """H U; added to total in place, where that is given.  ssim_window: False for the pixel-diagonal of l'' alone."""
        product = self._projection.vjp(self._adjoint_tangent(U, ssim_window), U, total)  # with U it adds (a . P'') U
        return self._regularizers.add_product(product, U)

    def ggn(
        self, U: Float[Tensor, "p k"], total: Float[Tensor, "p k"] | None = None, *, ssim_window: bool = True
    ) -> Float[Tensor, "p k"]:
        """G U, the Gauss-Newton part of H U; total, ssim_window: see `hvp`."""
        cotangents = self._loss_product(self._tangent(U), ssim_window)
        return self._pullback([self._raster.backward(cotangent) for cotangent in cotangents], total)

    def block_diagonals(
        self, *, approximate: bool = False, parts: Sequence[bool] = (False, True), space: list[Any] | None = None
    ) -> list[PerGaussianBlocks]:
        """The diagonal blocks of the Hessian (False) or of its Gauss-Newton part (True), for each of parts; they share a pass.

        approximate: with the pixel-diagonal of l'' in place of l''.  Exact blocks of a loss with SSIM, which couples pixels,
        are made on a CPU only (InputError on a GPU).  space: as of `Raster.coupled_blocks`.
        """
        raster, index = self._raster, self._index
        if approximate or not self._couples:
            curvature, coupled = self._loss.diagonal, None
        else:
            curvature, coupled = raster.coupled_blocks(self._loss, index, [] if space is None else space)
        found = []
        for gauss_newton in parts:
            blocks = self._raster.gaussian_blocks(self._adjoint, curvature, index, gauss_newton)
            if coupled is not None:
                blocks += coupled
            found.append(PerGaussianBlocks(*self._projection.blocks(blocks, not gauss_newton)))
            if not gauss_newton:
                found[-1].add_diagonal(self._regularizers.second)
        return found

    def loss_curvatures(self, U: Float[Tensor, "p k"]) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
        """(J u)^T l'' (J u) of every column u, and the same with the pixel-diagonal of l''; takes no backward pass."""
        return self._loss.curvatures(self._tangent(U).planes)

    def _tangent(self, U: Float[Tensor, "p k"]) -> Tangent:
        flat = self.gaussians.flat
        require_vectors(U, flat.numel(), flat.dtype, flat.device)
        return self._raster.jvp(self._projection.jvp(U))

    def _adjoint_tangent(self, U: Float[Tensor, "p k"], ssim_window: bool) -> Float[Tensor, "n k 9"]:
        """The tangent of the splats' adjoint; a method, so that its planes are freed before `hvp` allocates the result."""
        tangent = self._tangent(U)
        return tangent.backward_tangent(self._adjoint, self._loss_product(tangent, ssim_window))

    def _loss_product(self, tangent: Tangent, ssim_window: bool) -> Float[Tensor, "k 4 H W"]:
        """l'' times the tangents of the image, in their place."""
        planes = tangent.planes
        if ssim_window:
            return self._loss.hvp(planes, out=planes)
        planes[:, :3] *= self._loss.diagonal
        planes[:, 3] = 0  # l does not depend on alpha
        return planes

    def _pullback(self, adjoints: Sequence[Adjoint], total: Float[Tensor, "p k"] | None = None) -> Float[Tensor, "p k"]:
        """P'^T times adjoints of the splats, whose `moments` are cotangents of the 9 numbers."""
        return self._projection.vjp(torch.stack([adjoint.moments for adjoint in adjoints], dim=1), total=total)


class KeptViews:
    """A sequence of linearized views: the first `kept` that are used stay in memory, others are linearized at each use.

    linearize: makes the view of an index.  count: number of views.  memory: bytes for kept views and the workspace of a product
    with VECTORS vectors; it decides `kept`; results do not depend on it.  `first`, the first view, is made at once and always
    kept; its size is taken for that of every view.
    """

    def __init__(self, linearize: Callable[[int], LinearizedView], count: int, memory: int):
        first = linearize(0)
        more = (memory - first.bytes - first.workspace(VECTORS)) // first.bytes
        self.kept = 1 + min(max(more, 0), count - 1)
        self.first = first
        self._linearize, self._count, self._views = linearize, count, {0: first}

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[LinearizedView]:
        return map(self.__getitem__, range(self._count))

    def __getitem__(self, index: int) -> LinearizedView:
        if index in self._views:
            return self._views[index]
        view = self._linearize(index)
        if len(self._views) < self.kept:
            self._views[index] = view
        return view
