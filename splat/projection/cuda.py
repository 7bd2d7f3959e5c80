"""Projection and SH on the GPU: the functions of `projection_cpu.py` and the class of `projection_linear.py`, on tensors.

Nothing here waits for the device but `project`, once: for the size of the largest Gaussian.
"""

from math import log
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor
from triton import cdiv, next_power_of_2

from splat.backend.gpu.compile import launch
from splat.model.gaussians import Gaussians
from splat.projection import cuda_kernels as kernels
from splat.projection.formulas import GEOMETRY, SYMMETRIC, Lens, ProjectionJacobian
from splat.projection.reference import LARGEST_SPLAT, require_sizes

BLOCK = 128  # Gaussians that a program takes; for a product, times vectors
FEW = 8  # ... that one takes which holds all their derivatives
WIDEST = 8  # vectors that a program takes at a time
CHUNK = 1 << 16  # Gaussians whose blocks are chained at a time


def _run(kernel: Any, programs: tuple[int, ...], *arguments) -> None:
    launch(kernel, programs, *arguments, kernels.FORMULAS)


def _lens_numbers(lens: Lens, device: torch.device) -> Float64[Tensor, " 20"]:
    numbers = [*lens.rotation.tolist(), *lens.centre.tolist(), *lens[2:]]
    return torch.tensor(numbers, dtype=torch.float64).to(device, non_blocking=True)


def project(gaussians: Gaussians, lens: Lens) -> tuple[Float64[Tensor, "n 9"], Float[Tensor, " n"], Bool[Tensor, " n"]]:
    """Splats in double precision, depths in that of the parameters, and which are drawn; ValueError as `require_sizes`."""
    flat, n = gaussians.flat.detach(), len(gaussians)
    splats, depths = flat.new_empty(n, 9, dtype=torch.float64), flat.new_empty(n)
    drawn = flat.new_empty(n, dtype=torch.bool)
    _run(
        kernels.project_splats, (cdiv(n, BLOCK),),
        flat, _lens_numbers(lens, flat.device), splats, depths, drawn, n, gaussians.sh.shape[1], BLOCK,
    )  # fmt: skip
    largest = float(gaussians.log_scales.detach().max()) if n else 0.0
    if largest + max(log(max(lens.fx, lens.fy) / lens.near), 0.0) > log(LARGEST_SPLAT):
        require_sizes(lens, *(array.detach().cpu().numpy() for array in (gaussians.log_scales, depths, drawn)))
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
    _run(
        kernels.project_adjoint, (cdiv(n, BLOCK),),
        flat, _lens_numbers(lens, flat.device), splats, drawn, bar.contiguous(), gradient, n, gaussians.sh.shape[1], BLOCK
    )  # fmt: skip
    return gradient


class CudaProjection:
    """The map from stored parameters to the splats of one view, held still: `projection_linear.Projection` on the GPU.

    index: the Gaussians that matter; bar: the adjoint of the splats.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        lens: Lens,
        splats: Float64[Tensor, "n 9"],
        bar: Float64[Tensor, "n 9"],
        index: Int[Tensor, " m"],
    ):
        flat, m = gaussians.flat.detach(), index.numel()
        self.n, self.bands, self.parameters = len(gaussians), gaussians.sh.shape[1], flat.numel()
        self._splats, self._bar, self._index = splats, bar.contiguous(), index
        shapes = ((5, GEOMETRY), (SYMMETRIC,), (16,), (16, 3), (3,), (3,), (3, 3))
        self._held = tuple(flat.new_empty(*shape, m) for shape in shapes)
        inputs = (flat, _lens_numbers(lens, flat.device), splats, self._bar, index)
        jacobian, curvature, *colours = self._held
        programs = (cdiv(m, FEW),)
        _run(kernels.linearize_geometry, programs, *inputs, jacobian, curvature, self.n, m, FEW)
        _run(kernels.linearize_colour, programs, *inputs, curvature, *colours, self.n, m, self.bands, FEW)

    @property
    def held(self) -> ProjectionJacobian:
        """The derivatives, Gaussian by Gaussian: tensors in the places of arrays."""
        rows = (array.movedim(-1, 0) for array in self._held)
        return ProjectionJacobian(self._index, self._splats, self._bar[:, 5], *rows)  # pyright: ignore

    @property
    def bytes(self) -> int:
        """Memory of what is held per Gaussian in sight."""
        return sum(array.nbytes for array in self._held)

    def _grid(self, vectors: int) -> tuple[tuple[int, int], int, int]:
        """The programs of a product, and how many Gaussians and vectors each takes."""
        wide = min(next_power_of_2(vectors), WIDEST)
        rows = BLOCK // wide
        return (cdiv(self._index.numel(), rows), cdiv(vectors, wide)), rows, wide

    def affects(self, block: Float[Tensor, "p k"]) -> bool:
        """True: to look whether a vector moves any of the Gaussians that matter would be to wait for the device."""
        return True

    def jvp(self, block: Float[Tensor, "p k"]) -> Float64[Tensor, "n k 9"]:
        """P' U."""
        vectors = block.shape[1]
        out = block.new_zeros(self.n, vectors, 9, dtype=torch.float64)
        jacobian, _curvature, harmonic, _slope, _colour_bar, visible, colour_slope = self._held
        grid, rows, wide = self._grid(vectors)
        _run(
            kernels.push_forward, grid,
            block.contiguous(), self._splats, self._index, jacobian, harmonic, visible, colour_slope, out, self.n,
            self._index.numel(), vectors, self.bands, rows, wide
        )  # fmt: skip
        return out

    def pull(self, cotangents: Float64[Tensor, "n k 9"], block: Float[Tensor, "p k"] | None) -> Float[Tensor, "p k"]:
        """P'^T cotangents, plus (a . P'') block where a block is given."""
        vectors = cotangents.shape[1]
        out = self._held[0].new_zeros(self.parameters, vectors)
        grid, rows, wide = self._grid(vectors)
        _run(
            kernels.pull_back, grid,
            cotangents.contiguous(), out if block is None else block.contiguous(), self._splats, self._bar[:, 5],
            self._index, *self._held, out, self.n, self._index.numel(), vectors, block is not None, self.bands, rows, wide
        )  # fmt: skip
        return out

    def blocks(
        self, own: Float64[Tensor, "m 9 9"], second_order: bool
    ) -> tuple[Float[Tensor, "n 11 11"], Float[Tensor, "n k 3"]]:
        """Own blocks of splats in stored parameters: P'^T own P', plus (a . P'') where second_order; of SH the diagonal."""
        like, m = self._held[0], self._index.numel()
        geometry = like.new_zeros(self.n, GEOMETRY + 1, GEOMETRY + 1)
        sh = like.new_zeros(self.n, self.bands, 3)
        for start in range(0, m, CHUNK):
            some = slice(start, min(start + CHUNK, m))
            index, J = self._index[some], self._jacobian(some)
            blocks = J.mT @ own[some] @ J
            if second_order:
                blocks += self._bends(some)
            geometry[index] = blocks.to(like.dtype)
            _, _, harmonic, _, _, visible, _ = (array[..., some].double() for array in self._held)
            weight = visible * own[some].diagonal(dim1=1, dim2=2)[:, 6:].T
            sh[index] = (harmonic[: self.bands, None] ** 2 * weight).movedim(-1, 0).to(like.dtype)
        return geometry, sh

    def _jacobian(self, some: slice) -> Float64[Tensor, "c 9 11"]:
        """Of the splats at some places, in plain coordinates, in geometry and opacity logit."""
        count = some.stop - some.start
        jacobian, _, _, _, _, visible, colour_slope = self._held
        J = self._splats.new_zeros(count, 9, GEOMETRY + 1)
        _run(
            kernels.plain_jacobian,
            (cdiv(count, BLOCK),),
            self._splats,
            self._index,
            jacobian,
            J,
            some.start,
            count,
            self._index.numel(),
            BLOCK,
        )
        J[:, 5, GEOMETRY] = self._slope_of_opacity(some)
        J[:, 6:, :3] = (visible[:, None, some].double() * colour_slope[..., some].double()).movedim(-1, 0)
        return J

    def _bends(self, some: slice) -> Float64[Tensor, "c 11 11"]:
        """a . P'' in geometry and opacity logit."""
        bends = self._splats.new_zeros(some.stop - some.start, GEOMETRY + 1, GEOMETRY + 1)
        j, k = torch.tril_indices(GEOMETRY, GEOMETRY, device=bends.device)
        packed = self._held[1][:, some].double().T
        bends[:, j, k] = packed
        bends[:, k, j] = packed
        index = self._index[some]
        curvature = self._slope_of_opacity(some) * (1 - 2 * self._splats[index, 5])
        bends[:, GEOMETRY, GEOMETRY] = curvature * self._bar[index, 5]
        return bends

    def _slope_of_opacity(self, some: slice) -> Float64[Tensor, " c"]:
        opacity = self._splats[self._index[some], 5]
        return opacity * (1 - opacity)
