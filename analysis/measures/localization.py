"""Localization of a vector over a scene's parameters: its attributes, how many Gaussians, and how many needles.

mass           of Gaussian i in a vector v: m_i = sum of v^2 over its parameters; shares are of sum_i m_i = |v|^2
participation  (sum_i m_i)^2 / sum_i m_i^2: over how many Gaussians the mass is spread, 1 to n
condition      kappa of a splat's 2-D covariance, blur and all, lambda_max / lambda_min: the largest over the views on whose
               image its 3-sigma box lies
needle         a Gaussian with kappa > 100
"""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from analysis.records.schema import LivesOn
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.reference import NEEDLE, condition, on_screen, project


def mass_shares(vector: Float[Tensor, " p"], blocks: Mapping[str, slice]) -> dict[str, float]:
    """The share of a vector's squared length that lies in each block.

    >>> mass_shares(torch.tensor([3.0, 0.0, 4.0]), {"a": slice(0, 2), "b": slice(2, 3)})
    {'a': 0.36, 'b': 0.64}
    """
    squares = vector.double().square()
    return {name: float(squares[rows].sum() / squares.sum()) for name, rows in blocks.items()}


def masses(vector: Float[Tensor, " p"], gaussians: Gaussians) -> Float64[Tensor, " n"]:
    """The mass of every Gaussian in a vector laid out like `gaussians.flat`."""
    if vector.shape != gaussians.flat.shape:
        raise ValueError(f"expected a vector of {gaussians.flat.numel()} parameters, got shape {tuple(vector.shape)}")
    parts = [vector[rows].double().view(len(gaussians), -1).square().sum(dim=1) for rows in gaussians.blocks.values()]
    total = torch.stack(parts).sum(dim=0)
    if not 0 < float(total.sum()) < torch.inf:
        raise ValueError(f"expected a finite vector that is not zero, got a squared length of {float(total.sum())}")
    return total


def participation(mass: Float[Tensor, " n"]) -> float:
    """Number of Gaussians over which the mass is spread.

    >>> participation(torch.tensor([0.0, 2.0, 2.0, 0.0]))
    2.0
    """
    return float(mass.sum().square() / mass.square().sum())


@torch.no_grad()
def conditions(
    gaussians: Gaussians, cameras: Sequence[Camera], settings: RenderSettings = RenderSettings()
) -> Float64[Tensor, " n"]:
    """The largest condition number of each Gaussian's splats, in double precision; 1 where no view shows it."""
    gaussians = gaussians.to(torch.float64)
    worst = gaussians.flat.new_ones(len(gaussians))
    for camera in cameras:
        splats = project(gaussians, camera, settings)
        shown = on_screen(splats, camera)
        worst[shown] = torch.maximum(worst, condition(splats.conics))[shown]
    return worst


def localize(vector: Float[Tensor, " p"], gaussians: Gaussians, conditions: Float64[Tensor, " n"]) -> LivesOn:
    """Localization of a vector laid out like `gaussians.flat`; conditions: of the same Gaussians."""
    mass = masses(vector, gaussians)
    share, needles = mass / mass.sum(), conditions > NEEDLE
    return LivesOn(
        participation=participation(mass), needles=float(share[needles].sum()), needle_count=int(needles.sum())
    )
