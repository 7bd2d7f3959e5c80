"""Visibility of each Gaussian in a view: its weight, its pixels, the shape of its splat, and what is next in front of it."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from landscape.errors import InputError
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.formulas import lens_of
from splat.projection.reference import condition
from splat.render.backend import backend_of
from splat.render.cpu.raster import CpuRaster


@dataclass(frozen=True, eq=False)
class Sight:
    """One view of n Gaussians.

    weight: sum over the pixels of alpha T, px.  pixels: in how many it is not 0.  means: of the splats, px.  depths: z, world
    units.  condition: of the splat's covariance, lambda_max / lambda_min with the blur; 1 where it is not seen.
    front: the nearest Gaussian in front of it, in drawing order, that has weight in one of its pixels; -1 where there is none.
    gap: f (z - z_front) / z, px: how far it moves along its ray towards the camera until it passes `front`; infinite without
    one.  A pixel is here the length |mean - centre| / f: such a step across the ray moves the splat by a pixel.
    """

    weight: Float64[Tensor, " n"]
    pixels: Int64[Tensor, " n"]
    means: Float64[Tensor, "n 2"]
    depths: Float64[Tensor, " n"]
    condition: Float64[Tensor, " n"]
    front: Int64[Tensor, " n"]
    gap: Float64[Tensor, " n"]

    @property
    def seen(self) -> Bool[Tensor, " n"]:
        """Mask of the Gaussians with weight in a pixel."""
        return self.pixels > 0


def sight(gaussians: Gaussians, camera: Camera, settings: RenderSettings = RenderSettings()) -> Sight:
    """Visibility of the Gaussians for a camera.  InputError on a GPU: the pass over the pixels is one of the CPU's kernels.

    >>> from splat.model.camera import look_at
    >>> z, down = torch.tensor([0.0, 0.0, 4.0]), torch.tensor([0.0, 1.0, 0.0])
    >>> camera = Camera(look_at(0 * z, z, down), 0 * z, fx=20.0, fy=20.0, cx=8.0, cy=8.0, width=16, height=16)
    >>> one = {"means": z[None], "log_scales": -torch.ones(1, 3), "quats": torch.eye(4)[:1], "opacity_logits": torch.zeros(1)}
    >>> found = sight(Gaussians.pack(one | {"sh": torch.zeros(1, 1, 3)}), camera)
    >>> found.seen.tolist(), found.front.tolist(), round(found.condition.item(), 6)
    ([True], [-1], 1.0)
    """
    if gaussians.flat.device.type != "cpu":
        raise InputError("expected Gaussians on the CPU, got them on a GPU; move them there")
    splats, depths, drawn = backend_of(gaussians.flat).project(gaussians, lens_of(camera, settings))
    raster = CpuRaster(splats, depths, drawn, gaussians.flat.new_zeros(3), camera.width, camera.height, settings)
    red = torch.zeros_like(raster.crop(raster.planes))
    red[0] = 1
    weight = raster.backward(raster.pad(red)).moments[:, 6].double()  # d/d red of the sum of red
    splat, covered, before = raster.neighbours()
    pixels = np.bincount(splat, covered, len(gaussians)).astype(np.int64)
    z, kappa = depths.double(), condition(splats[:, 2:5])
    front = _nearest(splat, before, _places(z, drawn))
    gap = torch.where(front >= 0, camera.fx * (z - z[front]) / z, torch.inf)
    seen = torch.from_numpy(pixels) > 0
    kappa = torch.where(seen, kappa, torch.ones_like(kappa))
    return Sight(weight, torch.from_numpy(pixels), splats[:, :2], z, kappa, front, gap)


def _places(depths: Float64[Tensor, " n"], drawn: Bool[Tensor, " n"]) -> np.ndarray:
    """The place of each Gaussian in the order of depth, that of the rasteriser."""
    order = np.argsort(torch.where(drawn, depths, torch.inf).numpy(), kind="stable")
    places = np.empty(len(order), np.int64)
    places[order] = np.arange(len(order))
    return places


def _nearest(splat: np.ndarray, before: np.ndarray, places: np.ndarray) -> Int64[Tensor, " n"]:
    """Index of the last in the order among the splats in front of each splat in its tiles; -1 where there is none."""
    there, order = before >= 0, np.argsort(places)
    last = np.full(len(places), -1, np.int64)
    np.maximum.at(last, splat[there], places[before[there]])
    return torch.from_numpy(np.where(last >= 0, order[last], -1))
