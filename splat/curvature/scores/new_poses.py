"""What derivatives at the training views miss: changes of order, and curvature at new poses.

order fragility     E |R(Theta; z e^(s xi)) - R(Theta; z)|_1, xi ~ N(0, 1) for each Gaussian: the depths z by which they are
                    sorted change, nothing else does; every derivative misses it
open curvature      U, the mean over pixels of new poses of tr J_p (G + prior)^-1 J_p^T, in blocks of Gaussians, with the
                    information G = J^T J of the training views and the prior of `splat.curvature.scores.information`; and its
                    ratio to the same at the training poses
"""

import torch
from torch import Tensor

from landscape.results import Measured
from splat.curvature.scores.information import gains_of_each, informations, prior_of
from splat.curvature.scores.poses import Poses
from splat.model.gaussians import Gaussians
from splat.projection.formulas import lens_of
from splat.render.backend import backend_of

DEPTH = 0.01  # s


def order_fragility(
    gaussians: Gaussians, poses: Poses, generator: torch.Generator, s: float = DEPTH, draws: int = 8
) -> Measured:
    """O at these poses; a draw costs a compositing of each, no projection."""
    changes, backend = torch.zeros(draws, dtype=torch.float64), backend_of(gaussians.flat)
    background = poses.background.to(gaussians.flat)
    for camera in poses.cameras:
        splats, depths, drawn = backend.project(gaussians, lens_of(camera, poses.settings))

        def image(keys: Tensor, known=(splats, drawn, camera)) -> Tensor:
            splats, drawn, camera = known
            size = camera.width, camera.height
            raster = backend.rasterize(splats, keys, drawn, background, *size, poses.settings)
            return raster.crop(raster.planes[:3]).double()

        before = image(depths)
        for i in range(draws):
            xi = torch.randn(len(depths), generator=generator, dtype=torch.float64)
            after = image((depths * (s * xi).exp()).to(depths))
            changes[i] += (after - before).abs().mean() / len(poses.cameras)
    return Measured.mean(changes)


def open_curvature(gaussians: Gaussians, train: Poses, new: Poses) -> tuple[Measured, float]:
    """U with its error over the new poses, as if they were drawn at random, and its ratio to that of the training poses."""
    cameras = {str(i): camera for i, camera in enumerate([*train.cameras, *new.cameras])}
    found = [*informations(gaussians, cameras, train.background, train.settings).values()]
    seen = sum(found[1 : len(train.cameras)], found[0])
    prior = prior_of(seen)
    pixels = [camera.width * camera.height for camera in cameras.values()]
    traces = [float(gains_of_each(seen, prior, each)["t"].sum()) / n for each, n in zip(found, pixels, strict=True)]
    of_train, of_new = torch.tensor(traces, dtype=torch.float64).split([len(train.cameras), len(new.cameras)])
    return Measured.mean(of_new), float(of_new.mean() / of_train.mean())
