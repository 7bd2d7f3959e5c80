"""First and second order of a scene's loss by stage: time, memory, and what both are worth on this machine.

    project, ..., project adjoint   the stages of a gradient of one view, in the project's own kernels
    rasterizer        splats to image, and cotangent of the image to adjoint of the splats: tile lists, forward, backward
    compositing       forward and backward (with its sums) alone
    gradient          stored parameters to the gradient in them: every stage
    gradient, autograd  the same as a training makes it, through torch
    linearize         what `LinearizedView` does once
    H v K             a product with K vectors, per vector
    block diagonal    Hessian blocks of all attributes, one pass

Arithmetic is counted from `raster/formulas.py`: additions, multiplications, fused multiply-adds, divisions and
minima of one pixel and Gaussian, comparisons and integer operations left out, each worth one fused multiply-add.
"""

import tracemalloc
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch

from analysis.timing import Timing, interleaved
from analysis.workloads import Workload
from splat.linearize import LinearizedView, OwnBlocks
from splat.losses_cpu import ViewLoss, view_loss
from splat.projection_cpu import attribute_arrays, lens_of, project_adjoint, project_arrays
from splat.raster import binning, compositing, formulas, packing
from splat.raster.cpu import Adjoint, Raster, aligned
from splat.raster.threads import over_range, over_tiles
from splat.render import render

VECTORS = (1, 4, 8)
PRODUCTS = tuple(f"H v {K}" for K in VECTORS)
OPERATIONS = {"forward": 17, "backward + reduce": 30, "J u 1": 25, "tangent of backward 1": 46}


class ViewBench:
    """One view of a workload, ready to be timed: `calls`, and what they work on."""

    def __init__(self, workload: Workload, index: int = 0):
        self.workload, self.view = workload, workload.views[index]
        flat, camera = workload.gaussians.flat, self.view.camera
        self.lens = lens_of(camera, workload.settings)
        self.splats, self.depths, self.drawn = project_arrays(workload.gaussians, self.lens)
        self.background = workload.background.to(flat).numpy()
        self.loss = ViewLoss.of(self.view.image, workload.loss, flat.dtype)
        self.raster = self._rasterize()
        self.lists = self.raster.lists
        self.cotangent = self.loss.linearize(self.raster.planes).gradient
        self.adjoint = self.raster.backward(self.cotangent)
        self.linearized = self._linearize()
        generator = torch.Generator().manual_seed(0)
        self.vectors = {K: torch.randn(flat.numel(), K, generator=generator, dtype=flat.dtype) for K in VECTORS}

    def _rasterize(self) -> Raster:
        camera, settings = self.view.camera, self.workload.settings
        return Raster(self.splats, self.depths, self.drawn, self.background, camera.width, camera.height, settings)

    def _linearize(self) -> LinearizedView:
        w = self.workload
        return LinearizedView(w.gaussians, self.view.camera, self.loss, w.background.to(w.gaussians.flat), w.settings)

    def _rasterizer(self) -> Adjoint:
        return self._rasterize().backward(self.cotangent)

    def gradient(self) -> np.ndarray:
        """Of the view's loss in the stored parameters, laid out like `Gaussians.flat`."""
        splats, depths, drawn = project_arrays(self.workload.gaussians, self.lens)
        camera = self.view.camera
        raster = Raster(splats, depths, drawn, self.background, camera.width, camera.height, self.workload.settings)
        adjoint = raster.backward(self.loss.linearize(raster.planes).gradient)
        return self._to_parameters(splats, drawn, adjoint.gradient)

    def _to_parameters(self, splats: np.ndarray, drawn: np.ndarray, bar: np.ndarray) -> np.ndarray:
        gaussians = self.workload.gaussians
        out = gaussians.with_flat(torch.zeros_like(gaussians.flat))
        means, log_scales, quats, _logits, sh = attribute_arrays(gaussians)
        given = (self.lens, means, log_scales, quats, sh, splats, drawn, bar)
        over_range(len(gaussians), project_adjoint, *given, *attribute_arrays(out))
        return out.flat.numpy()

    def gradient_by_autograd(self) -> torch.Tensor:
        """The same, as a step of a training makes it."""
        w = self.workload
        flat = w.gaussians.flat.detach().requires_grad_()
        image = render(w.gaussians.with_flat(flat), self.view.camera, w.background, w.settings).image
        return torch.autograd.grad(view_loss(image, self.loss), flat)[0]

    def stages(self) -> dict[str, Callable[[], object]]:
        """The parts of a gradient and of a product with one vector, and compositing alone."""
        w, camera, raster = self.workload, self.view.camera, self.raster
        n, drawing = len(w.gaussians), (raster.params, raster.lists, raster.frame, raster.pixels)
        sums = aligned((int(raster.slot_start[-1]) * formulas.SUMS,), raster.dtype)
        bins = (self.splats, self.depths, self.drawn, camera.width, camera.height, w.settings)
        adjoint = self.adjoint

        def slots():
            raster.lists, raster._slot_start = self.lists, None
            return raster.slot_start

        def forward():
            over_tiles(compositing.forward, raster.params, self.lists, raster.frame, raster.pixels)

        def backward():
            over_tiles(compositing.backward, *drawing, adjoint.cotangent, sums)
            over_range(
                n, packing.reduce_gradient, self.splats, raster.slot_start, sums, adjoint.moments, adjoint.gradient
            )

        directions = self.linearized._projection.jvp(self.vectors[1].numpy())
        tangent = raster.jvp(directions)
        curved = self.linearized._loss.hvp(tangent.planes)
        return {
            "project": lambda: project_arrays(w.gaussians, self.lens),
            "bin": lambda: binning.bin_splats(*bins),
            "pack": lambda: over_range(n, packing.pack_splats, self.splats, -8.0, np.inf, np.empty_like(raster.params)),
            "forward": forward,
            "slots": slots,
            "loss": lambda: self.loss.linearize(raster.planes),
            "backward + reduce": backward,
            "project adjoint": lambda: self._to_parameters(self.splats, self.drawn, adjoint.gradient),
            "compositing": lambda: (forward(), backward()),
            "J u 1": lambda: raster.jvp(directions),
            "loss H v 1": lambda: self.linearized._loss.hvp(tangent.planes),
            "tangent of backward 1": lambda: tangent.curvature(adjoint, curved),
        }

    def wholes(self) -> dict[str, Callable[[], object]]:
        """What the ratios are about."""
        products = {f"H v {K}": lambda U=U: self.linearized.hvp(U) for K, U in self.vectors.items()}
        return {
            "rasterizer": self._rasterizer,
            "gradient": self.gradient,
            "gradient, autograd": self.gradient_by_autograd,
            "linearize": self._linearize,
            **products,
            "block diagonal": self._block_diagonal,
        }

    def _block_diagonal(self) -> OwnBlocks:
        vars(self.linearized._loss).pop("diagonal", None)  # it keeps the loss's share, which is part of the cost
        return self.linearized.block_diagonal()

    @property
    def pairs(self) -> int:
        """(pixel, Gaussian) pairs that a pass evaluates: every lane of every row of every entry that is reached."""
        _ = self.raster.slot_start  # drops the entries that are not
        rows = ((self.raster.lists.rows >> 8) & 255) - (self.raster.lists.rows & 255) + 1
        return int(rows.sum()) * self.raster.plane[1] // self.raster.frame.columns

    def workspace(self, K: int) -> int:
        """Bytes that a product with K vectors allocates at most at a time, its result included."""
        U = self.vectors[K]
        self.linearized.hvp(U)
        tracemalloc.start()
        self.linearized.hvp(U)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    def kept(self) -> int:
        """Bytes of the arrays that the linearisation holds, the target's included, the Gaussians' not."""
        held, gaussians = _buffers(self._linearize(), {}), _buffers(self.workload.gaussians, {})
        return sum(size for address, size in held.items() if address not in gaussians)


def _buffers(item: Any, found: dict[int, int], depth: int = 0) -> dict[int, int]:
    """Address and bytes of every array that an object holds, in attributes, tuples, lists or dictionaries."""
    if isinstance(item, torch.Tensor):
        found[item.untyped_storage().data_ptr()] = item.untyped_storage().nbytes()
    elif isinstance(item, np.ndarray):
        while isinstance(item.base, np.ndarray):
            item = item.base
        found[item.ctypes.data] = max(item.nbytes, found.get(item.ctypes.data, 0))
    elif depth < 6:
        inner = item.values() if isinstance(item, dict) else item if isinstance(item, tuple | list) else None
        for part in inner if inner is not None else vars(item).values() if hasattr(item, "__dict__") else ():
            _buffers(part, found, depth + 1)
    return found


# --- scaling ----------------------------------------------------------------------------------------------------------

SHARES = (1 / 8, 1 / 4, 1 / 2, 1.0)  # of the Gaussians
FACTORS = (1 / 4, 1 / 2, 1.0, 2.0)  # of an image's sides
SCALED = ("gradient", "linearize", *PRODUCTS)


def powers_of_two(most: int) -> list[int]:
    """1, 2, 4, ... and most itself.

    >>> powers_of_two(6)
    [1, 2, 4, 6]
    """
    return sorted({*(2**k for k in range(most.bit_length()) if 2**k <= most), most})


def scaling(workload: Workload, repetitions: int) -> Iterator[tuple[str, int, dict[str, Timing]]]:
    """What grows, to how much, and the times of everything in SCALED: Gaussians, pixels, views, threads."""
    for share in SHARES:
        part = workload.thinned(max(1, round(share * len(workload.gaussians))))
        yield "gaussians", len(part.gaussians), scaled_times(part, repetitions)
    for factor in FACTORS:
        part = workload.resized(factor)
        yield "pixels", part.pixels, scaled_times(part, repetitions)
    for views in powers_of_two(len(workload.views)):
        yield "views", views, scaled_times(workload, repetitions, views)
    before = torch.get_num_threads()
    try:
        for threads in powers_of_two(before):
            torch.set_num_threads(threads)
            yield "threads", threads, scaled_times(workload, repetitions)
    finally:
        torch.set_num_threads(before)


def scaled_times(workload: Workload, repetitions: int, views: int = 1) -> dict[str, Timing]:
    """The times of everything in SCALED over the first views."""
    benches = [ViewBench(workload, index).wholes() for index in range(views)]

    def over_views(name: str) -> Callable[[], object]:
        return lambda: [bench[name]() for bench in benches]

    return interleaved({name: over_views(name) for name in SCALED}, repetitions)


def per_vector(times: dict[str, Timing]) -> dict[str, Timing]:
    """Products as times per vector; the rest as it is."""
    return {
        name: time / int(name.split()[-1]) if name in PRODUCTS else time for name, time in times.items()
    }  # fmt: skip
