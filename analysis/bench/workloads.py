"""Workloads of a bench: Gaussians with the views that they are compared with, of a scene, a checkpoint or synthetic.

First and second order of a scene's loss over one view, as they are timed.

    rasterizer          splats to the image and back: tile lists, both passes over the pixels
    gradient            the whole: projection, rasterizer, loss, and their adjoints
    gradient, autograd  the same through the graph of torch, as a function of one's own takes it
    gradient, atomic    ... with sums by atomic additions (on a GPU)
    linearize           what `LinearizedView` does once
    H v K               a product with K vectors, per vector
    block diagonal      approximate Hessian blocks of all attributes, one pass
    exact blocks        the same with SSIM's window (on a CPU)

One code for the CPU and for GPUs: where the workload's Gaussians are decides which kernels run, and a `Meter` measures them.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from analysis.bench.timing import Meter, Timing
from landscape.errors import InputError
from landscape.probes import draw_probes
from splat.curvature.gaussian_blocks import PerGaussianBlocks
from splat.curvature.linearize import LinearizedView
from splat.losses.autograd import view_loss
from splat.losses.reference import LossSettings
from splat.model.gaussians import Gaussians
from splat.model.settings import Accumulation, RenderSettings
from splat.projection.formulas import lens_of
from splat.render.backend import CPU, backend_of, plain_gradient
from splat.render.render import render
from splat.scenes.scene import load_scene
from splat.scenes.splits import split_scene
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.view import View
from splat.training.checkpoint import open_subject
from splat.training.start import gaussians_from_points

VECTORS = (1, 4, 8)
Calls = dict[str, Callable[[], object]]


@dataclass(frozen=True)
class Size:
    """A number of splats (or Gaussians) and an image size, px."""

    count: int
    width: int
    height: int

    @classmethod
    def parse(cls, text: str) -> "Size":
        """Size from "10k@504x378"."""
        match = re.fullmatch(r"(\d+)(k?)@(\d+)x(\d+)", text)
        size = cls(int(match[1]) * (1000 if match[2] else 1), int(match[3]), int(match[4])) if match else None
        if size is None or min(size.count, size.width, size.height) < 1:
            raise InputError(f"expected a size as GAUSSIANS@WIDTHxHEIGHT, e.g. 10k@504x378, got {text!r}")
        return size

    def __str__(self) -> str:
        count = f"{self.count // 1000}k" if self.count % 1000 == 0 else str(self.count)
        return f"{count}@{self.width}x{self.height}"


@dataclass(frozen=True, eq=False)
class Workload:
    """Gaussians and the views that they are compared with."""

    name: str
    gaussians: Gaussians
    views: tuple[View, ...]
    background: Float[Tensor, "3"]
    loss: LossSettings = LossSettings()
    settings: RenderSettings = RenderSettings()

    @property
    def pixels(self) -> int:
        """Number of pixels of one view."""
        return self.views[0].camera.width * self.views[0].camera.height

    def to(self, device: torch.device) -> "Workload":
        """The Gaussians on a device, where all that is computed of them is then computed; views stay where they are."""
        return replace(self, gaussians=self.gaussians.with_flat(self.gaussians.flat.to(device)))


def synthetic_workload(size: Size) -> Workload:
    """Four views of the synthetic scene, whose Gaussians have lost their exact colours, so that the loss is not at 0."""
    made = synthetic_scene(SyntheticSettings(size.count, 4, size.width, size.height, sh_degree=3))
    gaussians = made.truth.select(torch.arange(len(made.truth)), 3)
    gaussians.sh.add_(0.1 * torch.randn(gaussians.sh.shape, generator=torch.Generator().manual_seed(0)))
    return Workload(f"synthetic {size}", gaussians, tuple(made.scene.load()), made.scene.background)


def workload_of(path: Path) -> Workload:
    """A checkpoint's Gaussians and training views; of a scene's folder the start: all its points, SH degree 3, three views.

    Raises FileNotFoundError or ValueError where the path is neither, or the scene has no points.
    """
    if path.is_file():
        subject = open_subject(path)
        training, scene, config = subject.checkpoint.training, subject.scene, subject.checkpoint.training.config
        views, name = tuple(scene.load(subject.checkpoint.scene.train)), f"{scene.name}, step {training.step}"
        return Workload(name, training.gaussians, views, scene.background, config.loss, config.render)
    scene = load_scene(path)
    if scene.points is None:
        raise InputError(f"expected a scene with points, got {path} without any; train it and give the checkpoint")
    views = tuple(scene.load(split_scene(scene, 3).train))
    gaussians = gaussians_from_points(scene.points, scene.frames, sh_degree=3)
    return Workload(f"{scene.name}, start", gaussians, views, scene.background)


class ViewBench:
    """The first view of a workload, ready to be timed: calls by name, and what they work on."""

    def __init__(self, workload: Workload):
        self.workload, self.view = workload, workload.views[0]
        self.like, camera = workload.gaussians.flat.detach(), self.view.camera
        self.lens = lens_of(camera, workload.settings)
        self.background = workload.background.to(self.like)
        self.backend = backend_of(self.like)
        self.loss = self.backend.view_loss(self.view.image, workload.loss, self.like)
        self.projected = self.backend.project(workload.gaussians, self.lens)
        self.raster = self._rasterize(self.projected)
        self.cotangent = self.loss.linearize(self.raster.planes).gradient
        self.linearized = self._linearize()
        generator = torch.Generator(self.like.device).manual_seed(0)
        self.vectors = {K: draw_probes(self.like.numel(), K, generator, self.like.dtype) for K in VECTORS}

    def _rasterize(self, found: tuple[torch.Tensor, torch.Tensor, torch.Tensor]) -> Any:
        camera, settings = self.view.camera, self.workload.settings
        return self.backend.rasterize(*found, self.background, camera.width, camera.height, settings)

    def _linearize(self) -> LinearizedView:
        w = self.workload
        return LinearizedView(w.gaussians, self.view.camera, self.loss, self.background, w.settings)

    def gradient(self) -> torch.Tensor:
        """Gradient of the view's loss in the stored parameters, laid out like `Gaussians.flat`."""
        splats, depths, drawn = self.backend.project(self.workload.gaussians, self.lens)
        raster = self._rasterize((splats, depths, drawn))
        adjoint = raster.backward(self.loss.linearize(raster.planes, second_order=False).gradient)
        bar = plain_gradient(splats, adjoint.moments)
        return self.backend.project_vjp(self.workload.gaussians, self.lens, splats, drawn, bar)

    def gradient_by_autograd(self, accumulation: Accumulation = "deterministic") -> torch.Tensor:
        """The gradient through the graph of torch."""
        w, settings = self.workload, replace(self.workload.settings, accumulation=accumulation)
        flat = self.like.clone().requires_grad_()
        image = render(w.gaussians.with_flat(flat), self.view.camera, self.background, settings).image
        return torch.autograd.grad(view_loss(image, self.loss), flat)[0]

    def calls(self) -> Calls:
        """All that is timed."""
        products = {f"H v {K}": lambda U=U: self.linearized.hvp(U) for K, U in self.vectors.items()}
        exact = {"exact blocks": lambda: self.linearized.block_diagonals(parts=(False,))}
        return {
            "rasterizer": lambda: self._rasterize(self.projected).backward(self.cotangent),
            "gradient": self.gradient,
            "gradient, autograd": self.gradient_by_autograd,
            "linearize": self._linearize,
            **products,
            "block diagonal": self._block_diagonal,
            **({"gradient, atomic": lambda: self.gradient_by_autograd("atomic")} if self.backend is not CPU else {}),
            **(exact if self.backend.exact_blocks else {}),
        }

    def _block_diagonal(self) -> PerGaussianBlocks:
        vars(self.linearized._loss).pop("diagonal", None)  # it keeps the loss's share, which is part of the cost
        return self.linearized.block_diagonals(approximate=True, parts=(False,))[0]

    def workspace(self, K: int, meter: Meter) -> int:
        """Bytes that a product with K vectors allocates at most at a time, its result included."""
        return meter.allocated(lambda: self.linearized.hvp(self.vectors[K]))


def per_vector(times: Mapping[str, Timing]) -> dict[str, Timing]:
    """Times per vector where the name ends in a number of vectors, as "H v 4"; the others as they are."""
    widths = {name: name.rsplit(" ", 1)[-1] for name in times}
    return {name: time / int(widths[name]) if widths[name].isdigit() else time for name, time in times.items()}
