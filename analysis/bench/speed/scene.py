"""Time and memory of the first and second order of a scene's loss, stage by stage.

The stages of a gradient of one view:

    project             stored parameters to splats in the image
    bin                 sort by depth, tile lists
    pack                parameters of the splats as the passes over the pixels read them
    forward             the image
    slots               numbering of the (splat, tile) intersections that some pixel reaches
    loss                the loss's gradient in the pixels
    backward + reduce   from there to the splats, with the sum over each splat's intersections
    project adjoint     and on to the stored parameters

Those of a product with K vectors, beside the projection's:

    J u K                   the image's change along K tangents of the splats
    loss H v K              the loss's second derivative in the pixels
    tangent of backward K   from there to the splats, with the sums

Wholes:

    compositing         forward and backward + reduce
    rasterizer          bin to forward, slots, backward + reduce
    gradient            every stage
    gradient, autograd  the same through the graph of torch, as a function of one's own takes it
    gradient, atomic    ... with sums by atomic additions (on a GPU)
    gsplat              ... by that package's kernels (on a GPU)
    linearize           what `LinearizedView` does once
    H v K               a product with K vectors, per vector
    block diagonal      approximate Hessian blocks of all attributes, one pass
    exact blocks        the same with SSIM's coupling of pixels (on a CPU)

One code for the CPU and for GPUs: where the workload's Gaussians are decides which kernels run, and a `Meter` measures them.

Arithmetic is counted from `render/formulas.py`: additions, multiplications, fused multiply-adds, divisions and
minima of one pixel and Gaussian, comparisons and integer operations left out, each worth one fused multiply-add.  Bytes are
those that a pass reads and writes for each entry (its splat's 64, its index and slot, 48 a tangent, 36 of sums, written and
added up) and for each pixel of the image, in single precision; they come from memory or a cache.  A pair is a (pixel, Gaussian)
that a pass evaluates: on the CPU in every lane of every row of every intersection that is reached, on a GPU in every pixel of
its tile.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from analysis.bench.speed.meters import Meter
from analysis.bench.speed.peer import MissingPeer, gsplat_gradient
from analysis.bench.speed.timing import Timing, interleaved
from analysis.bench.workloads import Workload
from landscape.probes import draw_probes
from splat.curvature.gaussian_blocks import PerGaussianBlocks
from splat.curvature.linearize import LinearizedView
from splat.losses.autograd import view_loss
from splat.model.settings import Accumulation
from splat.projection.formulas import lens_of
from splat.render.backend import CPU, backend_of, plain_gradient
from splat.render.render import render

VECTORS = (1, 4, 8)
PRODUCTS = tuple(f"H v {K}" for K in VECTORS)
OPERATIONS = {"forward": 17, "backward + reduce": 30, "J u 1": 25, "tangent of backward 1": 46}
BYTES = {  # an entry, a pixel
    "forward": (4 + 64, 24),
    "backward + reduce": (8 + 64 + 2 * 36, 24),
    "J u 1": (4 + 64 + 48, 4 + 20),
    "tangent of backward 1": (8 + 64 + 48 + 2 * 36, 24 + 20),
}
Calls = dict[str, Callable[[], object]]


class ViewBench:
    """One view of a workload, ready to be timed: calls by name, and what they work on.

    vectors: the widths K of the products; lack: why there is no gradient by gsplat to compare with on a GPU.
    """

    def __init__(self, workload: Workload, index: int = 0, vectors: tuple[int, ...] = VECTORS):
        self.workload, self.view = workload, workload.views[index]
        self.like, camera = workload.gaussians.flat.detach(), self.view.camera
        self.lens = lens_of(camera, workload.settings)
        self.background = workload.background.to(self.like)
        self.backend = backend_of(self.like)
        self.loss = self.backend.view_loss(self.view.image, workload.loss, self.like)
        self.projected = self.backend.project(workload.gaussians, self.lens)
        self.raster = self._rasterize(self.projected)
        self.cotangent = self.loss.linearize(self.raster.planes).gradient
        self.adjoint = self.raster.backward(self.cotangent)
        self.linearized = self._linearize()
        generator = torch.Generator(self.like.device).manual_seed(0)
        self.vectors = {K: draw_probes(self.like.numel(), K, generator, self.like.dtype) for K in vectors}
        self.lack: str | None = None

    def _rasterize(self, found: tuple[torch.Tensor, torch.Tensor, torch.Tensor]) -> Any:
        camera, settings = self.view.camera, self.workload.settings
        return self.backend.rasterize(*found, self.background, camera.width, camera.height, settings)

    def _linearize(self) -> Any:
        w = self.workload
        return LinearizedView(w.gaussians, self.view.camera, self.loss, self.background, w.settings)

    def gradient(self) -> torch.Tensor:
        """Gradient of the view's loss in the stored parameters, laid out like `Gaussians.flat`."""
        splats, depths, drawn = self.backend.project(self.workload.gaussians, self.lens)
        raster = self._rasterize((splats, depths, drawn))
        adjoint = raster.backward(self.loss.linearize(raster.planes, second_order=False).gradient)
        return self._to_parameters(splats, drawn, adjoint)

    def _to_parameters(self, splats: torch.Tensor, drawn: torch.Tensor, adjoint: Any) -> torch.Tensor:
        bar = plain_gradient(splats, adjoint.moments)
        return self.backend.project_vjp(self.workload.gaussians, self.lens, splats, drawn, bar)

    def gradient_by_autograd(self, accumulation: Accumulation = "deterministic") -> torch.Tensor:
        """The gradient through the graph of torch."""
        w, settings = self.workload, replace(self.workload.settings, accumulation=accumulation)
        flat = self.like.clone().requires_grad_()
        image = render(w.gaussians.with_flat(flat), self.view.camera, self.background, settings).image
        return torch.autograd.grad(view_loss(image, self.loss), flat)[0]

    def stages(self) -> Calls:
        """The parts of a gradient and of a product with one vector, and compositing alone."""
        passes, (splats, _, drawn) = self.compositing(), self.projected
        return {
            "project": lambda: self.backend.project(self.workload.gaussians, self.lens),
            **passes,
            "loss": lambda: self.loss.linearize(self.raster.planes),
            "project adjoint": lambda: self._to_parameters(splats, drawn, self.adjoint),
            "compositing": lambda: (passes["forward"](), passes["backward + reduce"]()),
            **self.product(1),
        }

    def compositing(self) -> Calls:
        """The stages of a gradient from splats to image and back."""
        raster = self.raster
        return {
            "bin": lambda: raster.bin(*self.projected[1:]),
            "pack": raster.pack,
            "forward": raster.forward,
            "slots": raster.number_accumulators,
            "backward + reduce": lambda: raster.backward(self.cotangent),
        }

    def product(self, K: int) -> Calls:
        """The stages of a product with K vectors from tangents of the splats on."""
        loss, directions = self.linearized._loss, self.linearized._projection.jvp(self.vectors[K])
        tangent = self.raster.jvp(directions)
        curved = loss.hvp(tangent.planes)
        return {
            f"J u {K}": lambda: self.raster.jvp(directions),
            f"loss H v {K}": lambda: loss.hvp(tangent.planes),
            f"tangent of backward {K}": lambda: tangent.backward_tangent(self.adjoint, curved),
        }

    def wholes(self) -> Calls:
        """Calls whose times the ratios compare."""
        products = {f"H v {K}": lambda U=U: self.linearized.hvp(U) for K, U in self.vectors.items()}
        return {
            "rasterizer": lambda: self._rasterize(self.projected).backward(self.cotangent),
            "gradient": self.gradient,
            "gradient, autograd": self.gradient_by_autograd,
            "linearize": self._linearize,
            **products,
            "block diagonal": self._block_diagonal,
            **({"exact blocks": self.linearized.block_diagonal} if self.backend.exact_blocks else {}),
        }

    def peers(self) -> Calls:
        """Gradients to compare with on a GPU: by the faster sums, and by gsplat where it is installed."""
        if self.backend is CPU:
            return {}
        calls: Calls = {"gradient, atomic": lambda: self.gradient_by_autograd("atomic")}
        try:
            calls["gsplat"] = gsplat_gradient(self.workload, self.view, self.loss)
        except MissingPeer as error:
            self.lack = str(error)
        return calls

    def _block_diagonal(self) -> PerGaussianBlocks:
        vars(self.linearized._loss).pop("diagonal", None)  # it keeps the loss's share, which is part of the cost
        return self.linearized.block_diagonal(approximate=True)

    def bytes_of(self, name: str) -> int:
        """Bytes that a pass reads and writes."""
        an_entry, a_pixel = BYTES[name]
        return an_entry * self.linearized.intersections + a_pixel * self.workload.pixels

    def workspace(self, K: int, meter: Meter) -> int:
        """Bytes that a product with K vectors allocates at most at a time, its result included."""
        return meter.allocated(lambda: self.linearized.hvp(self.vectors[K]))

    def kept(self) -> int:
        """Bytes of the arrays that the linearisation holds, the target's included, the Gaussians' not."""
        held, gaussians = _buffers(self._linearize(), {}), _buffers(self.workload.gaussians, {})
        return sum(size for address, size in held.items() if address not in gaussians)


def _buffers(item: Any, found: dict[int, int], depth: int = 0) -> dict[int, int]:
    """Address and bytes of every array that an object holds, in attributes, tuples, lists or dictionaries."""
    if isinstance(item, torch.Tensor):
        found[item.untyped_storage().data_ptr()] = item.untyped_storage().nbytes()
    elif isinstance(item, np.ndarray):  # a tensor over the same memory begins where the array does
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


def scaling(workload: Workload, repetitions: int, meter: Meter) -> Iterator[tuple[str, int, dict[str, Timing]]]:
    """Yield what is scaled, to how much, and the times of everything in SCALED: Gaussians, pixels, views, threads (CPU)."""
    for share in SHARES:
        part = workload.thinned(max(1, round(share * len(workload.gaussians))))
        yield "gaussians", len(part.gaussians), scaled_times(part, repetitions, meter)
    for factor in FACTORS:
        part = workload.resized(factor)
        yield "pixels", part.pixels, scaled_times(part, repetitions, meter)
    for views in powers_of_two(len(workload.views)):
        yield "views", views, scaled_times(workload, repetitions, meter, views)
    if backend_of(workload.gaussians.flat) is not CPU:
        return
    before = torch.get_num_threads()
    try:
        for threads in powers_of_two(before):
            torch.set_num_threads(threads)
            yield "threads", threads, scaled_times(workload, repetitions, meter)
    finally:
        torch.set_num_threads(before)


def scaled_times(workload: Workload, repetitions: int, meter: Meter, views: int = 1) -> dict[str, Timing]:
    """The times of everything in SCALED over the first views."""
    benches = [ViewBench(workload, index).wholes() for index in range(views)]

    def over_views(name: str) -> Callable[[], object]:
        return lambda: [bench[name]() for bench in benches]

    return interleaved({name: over_views(name) for name in SCALED}, repetitions, clock=meter.seconds)


def per_vector(times: Mapping[str, Timing]) -> dict[str, Timing]:
    """Times of what is named after a number of vectors, "H v 4", per vector; the rest as it is."""
    widths = {name: name.rsplit(" ", 1)[-1] for name in times}
    return {name: time / int(widths[name]) if widths[name].isdigit() else time for name, time in times.items()}
