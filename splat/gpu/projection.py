"""Projection and SH on the GPU: the functions of `cpu.py` and the class of `linear_cpu.py`, on tensors.

Nothing here waits for the device but `project`, once: for the size of the largest Gaussian.
"""

from math import log

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor
from triton import cdiv, next_power_of_2

from splat.gpu import projection_kernels as kernels
from splat.gpu.language.compile import launch
from splat.model.gaussians import Gaussians
from splat.projection.antialias import is_antialiased, log_sizes, widths_of
from splat.projection.formulas import GEOMETRY, Lens, ProjectionJacobian, row_shapes
from splat.projection.reference import LARGEST_SPLAT, require_sizes

BLOCK = 128  # Gaussians that a program takes; for a product, times vectors
FEW = 8  # ... that one takes which holds all their derivatives
WIDEST = 8  # vectors that a program takes at a time
CHUNK = 1 << 16  # Gaussians whose blocks are chained at a time


def _lens_numbers(lens: Lens, device: torch.device) -> Float64[Tensor, " 22"]:
    numbers = [*lens.rotation.tolist(), *lens.centre.tolist(), *lens[2:]]
    return torch.tensor(numbers, dtype=torch.float64).to(device, non_blocking=True)


def _widths(gaussians: Gaussians, lens: Lens) -> Float[Tensor, " n"]:
    """The widths that an antialiased kernel reads; others get a vector that they do not read."""
    widths = widths_of(gaussians, lens)
    return gaussians.flat.detach() if widths is None else widths


def project(gaussians: Gaussians, lens: Lens) -> tuple[Float64[Tensor, "n 9"], Float[Tensor, " n"], Bool[Tensor, " n"]]:
    """Splats in double precision, depths in that of the parameters, and which are drawn; ValueError as `require_sizes`."""
    flat, n = gaussians.flat.detach(), len(gaussians)
    splats, depths = flat.new_empty(n, 9, dtype=torch.float64), flat.new_empty(n)
    drawn = flat.new_empty(n, dtype=torch.bool)
    launch(
        kernels.project_splats, (cdiv(n, BLOCK),),
        flat, _widths(gaussians, lens), _lens_numbers(lens, flat.device), splats, depths, drawn, n, gaussians.sh.shape[1],
        is_antialiased(gaussians, lens), BLOCK,
    )  # fmt: skip
    sizes = log_sizes(gaussians)
    largest = float(sizes.max()) if n else 0.0
    if largest + max(log(max(lens.fx, lens.fy) / lens.near), 0.0) > log(LARGEST_SPLAT):
        require_sizes(lens, *(array.cpu().numpy() for array in (sizes, depths, drawn)))
    return splats, depths, drawn


def project_adjoint(
    gaussians: Gaussians,
    lens: Lens,
    splats: Float64[Tensor, "n 9"],
    drawn: Bool[Tensor, " n"],
    bar: Float64[Tensor, "n 9"],
) -> Float[Tensor, " p"]:
    """The gradient in the flat vector, given the adjoint of the splats."""
    flat, n = gaussians.flat.detach(), len(gaussians)
    gradient = torch.empty_like(flat)
    launch(
        kernels.project_adjoint, (cdiv(n, BLOCK),),
        flat, _widths(gaussians, lens), _lens_numbers(lens, flat.device), splats, drawn, bar.contiguous(), gradient, n,
        gaussians.sh.shape[1], is_antialiased(gaussians, lens), BLOCK,
    )  # fmt: skip
    return gradient


def convert(way: int, splats: Float64[Tensor, "n 9"], numbers: Float[Tensor, "n 9"]) -> Float64[Tensor, "n 9"]:
    """Tangents or adjoints of splats in other coordinates: `whitening.converted`."""
    n, out = len(splats), torch.empty_like(splats)
    launch(kernels.convert, (cdiv(n, BLOCK),), splats, numbers.contiguous(), out, n, way, BLOCK)
    return out


class CudaProjection:
    """The projection of one view, linearised: `projection.protocols.Projection` by Triton kernels."""

    def __init__(
        self,
        gaussians: Gaussians,
        lens: Lens,
        splats: Float64[Tensor, "n 9"],
        moments: Float[Tensor, "n 9"],
        index: Int[Tensor, " m"],
    ):
        flat, m = gaussians.flat.detach(), index.numel()
        self.n, self.bands, self.parameters = len(gaussians), gaussians.sh.shape[1], flat.numel()
        self._antialiased = is_antialiased(gaussians, lens)
        rows = row_shapes(antialiased=self._antialiased)
        self._at = ProjectionJacobian(index, *(flat.new_empty(*row, m) for row in rows))
        inputs = (flat, _lens_numbers(lens, flat.device), splats, moments.contiguous(), index)
        _, jacobian, curvature, *colours, _, _, _, _ = self._at
        outputs = (jacobian, curvature, *self._at[-4:])
        programs, widths = (cdiv(m, FEW),), _widths(gaussians, lens)
        launch(
            kernels.linearize_geometry, programs, *inputs, widths, *outputs, self.n, m, self._antialiased, FEW
        )  # fmt: skip
        launch(kernels.linearize_colour, programs, *inputs, curvature, *colours, self.n, m, self.bands, FEW)

    @property
    def jacobian(self) -> ProjectionJacobian:
        return ProjectionJacobian(self._at.index, *(array.movedim(-1, 0) for array in self._at[1:]))

    @property
    def bytes(self) -> int:
        return sum(array.nbytes for array in self._at[1:])

    def _grid(self, vectors: int) -> tuple[tuple[int, int], int, int]:
        """The programs of a product, and how many Gaussians and vectors each takes."""
        wide = min(next_power_of_2(vectors), WIDEST)
        rows = BLOCK // wide
        return (cdiv(self._at.index.numel(), rows), cdiv(vectors, wide)), rows, wide

    def affects(self, block: Float[Tensor, "p k"]) -> bool:
        return True

    def jvp(self, block: Float[Tensor, "p k"]) -> Float[Tensor, "n k 9"]:
        at, vectors = self._at, block.shape[1]
        out = block.new_zeros(self.n, vectors, 9)
        grid, rows, wide = self._grid(vectors)
        launch(
            kernels.push_forward, grid, block.contiguous(), at.index, at.jacobian, at.harmonic, at.visible, at.colour_slope,
            at.logit_slope, at.opacity_slope, out, self.n, at.index.numel(), vectors, self._antialiased, self.bands, rows, wide
        )  # fmt: skip
        return out

    def vjp(
        self,
        cotangents: Float[Tensor, "n k 9"],
        block: Float[Tensor, "p k"] | None = None,
        total: Float[Tensor, "p k"] | None = None,
    ) -> Float[Tensor, "p k"]:
        vectors, m = cotangents.shape[1], self._at.index.numel()
        out = self._at.jacobian.new_zeros(self.parameters, vectors)
        grid, rows, wide = self._grid(vectors)
        launch(
            kernels.pull_back, grid,
            cotangents.to(out.dtype).contiguous(), out if block is None else block.contiguous(), *self._at, out,
            self.n, m, vectors, block is not None, self._antialiased, self.bands, rows, wide
        )  # fmt: skip
        return out if total is None else total.add_(out)

    def blocks(
        self, blocks: Float64[Tensor, "m 9 9"], second_order: bool
    ) -> tuple[Float[Tensor, "n 11 11"], Float[Tensor, "n b 3"]]:
        like, m = self._at.jacobian, self._at.index.numel()
        geometry = like.new_zeros(self.n, GEOMETRY + 1, GEOMETRY + 1)
        sh = like.new_zeros(self.n, self.bands, 3)
        for start in range(0, m, CHUNK):
            some = slice(start, start + CHUNK)
            at = ProjectionJacobian(self._at.index[some], *(array[..., some].double() for array in self._at[1:]))
            J = blocks.new_zeros(len(at.index), 9, GEOMETRY + 1)
            J[:, 0, GEOMETRY] = at.logit_slope
            J[:, 1:6, :GEOMETRY] = at.jacobian.movedim(-1, 0)
            if self._antialiased:
                J[:, 0, :GEOMETRY] = at.opacity_slope.T
            J[:, 6:, :3] = (at.visible[:, None] * at.colour_slope).movedim(-1, 0)
            product = J.mT @ blocks[some] @ J
            if second_order:
                j, k = torch.tril_indices(GEOMETRY, GEOMETRY, device=blocks.device)
                bends = torch.zeros_like(product)
                bends[:, j, k] = bends[:, k, j] = at.curvature.T
                bends[:, GEOMETRY, GEOMETRY] = at.logit_curvature
                if self._antialiased:
                    bends[:, GEOMETRY, :GEOMETRY] = bends[:, :GEOMETRY, GEOMETRY] = at.opacity_curvature.T
                product += bends
            geometry[at.index] = product.to(like.dtype)
            weight = at.visible * blocks[some].diagonal(dim1=1, dim2=2)[:, 6:].T
            sh[at.index] = (at.harmonic[: self.bands, None] ** 2 * weight).movedim(-1, 0).to(like.dtype)
        return geometry, sh
