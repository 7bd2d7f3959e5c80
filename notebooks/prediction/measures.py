"""Measures of a scene at finite steps or at new poses, and two bars without curvature.

order fragility     E |R(Theta; z e^(s xi)) - R(Theta; z)|_1, xi ~ N(0, 1) for each Gaussian: the depths z by which they are
                    sorted change, nothing else does; every derivative misses it
critical sharpness  2 / eta, eta the factor of an update at which the loss is again what it was before it (arXiv
                    2601.16979): of a quadratic loss, step^T H step / gradient . step
open curvature      U, the mean over pixels of new poses of tr J_p (G + prior)^-1 J_p^T, in blocks of Gaussians, with the
                    information G = J^T J of the training views and the prior of `splat.curvature.scores.information`; and its
                    ratio to the same at the training poses
ensemble            |R(Theta_1) - R(Theta_2)|_1 between trainings that differ in their seed
co-adaptation       the variance of a pixel's colour over renders of random halves of the Gaussians, after arXiv 2508.12720:
                    the mean over pixels and colours of (A - B)^2 / 2 for two halves A, B drawn independently
"""

from collections.abc import Callable, Sequence
from math import nan

import torch
from jaxtyping import Float
from torch import Tensor

from analysis.commands.uses.next_view import informations
from landscape.errors import InputError
from notebooks.prediction.poses import Measured, Poses, distance
from splat.curvature.scores.information import gains_of_each, prior_of
from splat.model.gaussians import Gaussians
from splat.projection.formulas import lens_of
from splat.render.backend import backend_of

DEPTH = 0.01  # s
KEPT = 0.5  # share of the Gaussians in a random subset
CLOSE, MOST = 0.01, 40  # of the slope that may be left at eta, or of eta itself; losses


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


def critical_sharpness(
    loss: Callable[[Tensor], float], start: Float[Tensor, " p"], step: Float[Tensor, " p"], slope: float
) -> Measured:
    """2 / eta along the next update, start - eta step.  slope: gradient . step.  error: of the search for eta.

    (loss - loss at the start) / eta is -slope at 0, and a straight line where the loss is quadratic: its zero is found by
    regula falsi with Illinois' halving, or the place where it jumps past 0.  Both nan where the loss does not fall along
    the update.  InputError where it still falls after MOST losses.
    """
    if slope <= 0:
        return Measured(nan, nan)
    base, near, far, eta, side = loss(start), (0.0, -slope), None, 1.0, 0
    for _ in range(MOST):
        rate = (loss(start - eta * step) - base) / eta
        if abs(rate) <= CLOSE * slope:
            return Measured(2 / eta, 2 / eta * abs(rate) / slope)
        if rate < 0:  # an end that stays twice counts half
            near, far = (eta, rate), far and (far[0], far[1] / 2 if side < 0 else far[1])
        else:
            near, far = (near[0], near[1] / 2 if side > 0 else near[1]), (eta, rate)
        side = 1 if rate > 0 else -1
        if far and far[0] - near[0] <= CLOSE * far[0]:  # the loss jumps here: Gaussians change places
            eta = (near[0] + far[0]) / 2
            return Measured(2 / eta, 2 / eta * (far[0] - near[0]) / (2 * near[0]))
        eta = 2 * eta if far is None else near[0] - near[1] * (far[0] - near[0]) / (far[1] - near[1])
    raise InputError(f"expected a loss that rises along the update, got one that falls at {eta:.3g} times it")


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


def ensemble(one: Gaussians, others: Sequence[Gaussians], poses: Poses) -> Measured:
    """The mean over the other seeds' Gaussians, with its error over them."""
    images = poses.images(one)
    return Measured.mean(torch.tensor([distance(poses.images(each), images) for each in others], dtype=torch.float64))


def coadaptation(
    gaussians: Gaussians, poses: Poses, generator: torch.Generator, kept: float = KEPT, draws: int = 16
) -> Measured:
    """The variance at these poses, with its error over pairs of subsets."""
    variances = torch.zeros(draws, dtype=torch.float64)
    for i in range(draws):
        masks = torch.rand(2, len(gaussians), generator=generator) < kept
        A, B = (poses.images(gaussians, mask.to(gaussians.flat)) for mask in masks)
        variances[i] = sum(float((a - b).square().mean()) for a, b in zip(A, B, strict=True)) / (2 * len(A))
    return Measured.mean(variances)
