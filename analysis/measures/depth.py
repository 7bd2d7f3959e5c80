"""Derivatives of the positions along the rays (depth) and across them (lateral), and finite steps both ways.

v_im is the unit vector from the centre of view m's camera to the mean of Gaussian i, as in Eq. (7); g_im and H_im are the
gradient and the 3 x 3 diagonal block of the Hessian of the view's loss in the mean.

              depth            lateral: two directions        summed over
    gradient  (g . v)^2        |g|^2 - (g . v)^2              pairs of a Gaussian and a view with g != 0
    curvature v^T H v          tr H - v^T H v                 Gaussians; the mean over views
    rise      (L_m(+d) + L_m(-d)) / 2 - L_m, all Gaussians moved by d_i at once; the mean over views

The ratios are of depth to one lateral direction: of root mean square gradients, and of mean curvatures.  The paper's text on
Eq. (4) says that the gradient's is "typically 100x" and that large eigenvalues follow.  But a mean that moves by d along its
ray keeps its place in the image and changes the size s of its splat by s d / z; across the ray it moves the splat by f d / z.
Where splats are small compared with the focal length f, the ratio is therefore far below 1.

Derivatives do not include changes of the Gaussians' order, which is locally constant; the rises do, as they are renders.  Steps
d_i are along v or along a random lateral direction, of random sign and of length px |mean - centre| / f: a lateral step moves
its splat by px pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from math import inf, nan

import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64
from msgspec import convert
from torch import Tensor

from analysis.records.schema import Depth, Rise
from landscape.errors import InputError
from landscape.probes import draw_probes
from landscape.results import Bracket, Progress, finite_or_none, mean_of_parts
from landscape.traces.estimate import TraceEstimate
from landscape.traces.trace import TraceSettings
from splat.curvature.gaussian_blocks import PerGaussianBlocks
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import ONE_PERCENT, SampledTrace, sampled_traces

KINDS = ("depth", "lateral")
LATERAL_DIRECTIONS = 2
STEPS = (0.01, 0.1, 1.0, 10.0)  # px


@dataclass(frozen=True, eq=False)
class DepthSplit:
    """Gradient and curvature of the positions, split into depth and lateral.

    components: |g . v| and |g - (g . v) v| of every pair of a Gaussian and a view with g != 0, per world unit.
    depth, lateral: traces of the curvature.
    """

    components: Float64[Tensor, "pairs 2"]
    depth: TraceEstimate
    lateral: TraceEstimate

    @cached_property
    def gradient_ratio(self) -> float:
        """Ratio of the root mean squares; nan without a lateral gradient."""
        return _ratio(self.components)

    @cached_property
    def median_ratio(self) -> float:
        """The median over the pairs of |g . v| over the root mean square of g's lateral components."""
        depth, lateral = self.components.unbind(dim=1)
        return float((LATERAL_DIRECTIONS**0.5 * depth / lateral).median()) if len(depth) else nan

    @cached_property
    def curvature_ratio(self) -> Bracket:
        """Ratio of the mean curvatures with the bracket from both traces' intervals; undefined where lateral may be <= 0."""
        depth, lateral = self.depth, self.lateral
        if lateral.low <= 0:
            return Bracket(None, -inf, inf, "the lateral curvature is negative or its sign undetermined")
        ends = [LATERAL_DIRECTIONS * a / b for a in (depth.low, depth.high) for b in (lateral.low, lateral.high)]
        return Bracket(LATERAL_DIRECTIONS * depth.value / lateral.value, min(ends), max(ends))


def _ratio(components: Float64[Tensor, "pairs 2"]) -> float:
    depth, lateral = components.square().sum(dim=0).tolist()
    return (LATERAL_DIRECTIONS * depth / lateral) ** 0.5 if lateral > 0 else nan


def gradient_ratio(objective: SceneObjective) -> float:
    """`DepthSplit.gradient_ratio` alone, of one gradient for each view."""
    return _ratio(_components(objective))


def _components(objective: SceneObjective) -> Float64[Tensor, "pairs 2"]:
    """`along_and_across` of the positions' gradient in every view."""
    rows, views = objective.blocks["means"], enumerate(objective.linearized)
    parts = [along_and_across(view.gradient[rows].view(-1, 3), objective.rays(index)) for index, view in views]
    return torch.stack(parts, dim=1).flatten(0, 1)


def measure_depth(
    objective: SceneObjective,
    traces: TraceSettings,
    steps: tuple[float, ...],
    generator: torch.Generator,
    report: Progress,
    exact: bool,
) -> Depth:
    """The stage `depth` of a probe.  steps: px; exact: see `depth_split`."""
    found = depth_split(objective, generator, traces, report, exact)
    rises = depth_rises(objective, generator, steps, progress=report)
    return convert(
        {
            "gradient_ratio": finite_or_none(found.gradient_ratio),
            "gradient_median": finite_or_none(found.median_ratio),
            "pairs": len(found.components),
            "curvature": {"depth": found.depth.record(), "lateral": found.lateral.record()},
            "curvature_ratio": found.curvature_ratio.record(),
            "rises": rises,
        },
        Depth,
    )


def depth_split(
    objective: SceneObjective,
    generator: torch.Generator,
    settings: TraceSettings = ONE_PERCENT,
    progress: Progress | None = None,
    exact: bool = False,
) -> DepthSplit:
    """Gradient and curvature of the active Gaussians' positions.

    settings: as for `exact_traces`, for either trace.  exact: sums over exact blocks in place of samples, on a CPU.
    """
    pairs = _components(objective)
    whole, pixelwise = objective.known_blocks(exact=exact)
    counts, n = (settings.min_probes, settings.max_probes), len(objective.active)
    traces = [
        SampledTrace(kind, dim, _mean(whole, kind), pixelwise and _mean(pixelwise, kind), settings, *counts)
        for kind, dim in zip(KINDS, (n, LATERAL_DIRECTIONS * n), strict=True)
    ]
    estimates = sampled_traces(objective, generator, partial(_signs, objective), traces, progress)
    return DepthSplit(pairs[pairs.any(dim=1)], **estimates)


def depth_rises(
    objective: SceneObjective,
    generator: torch.Generator,
    steps: Sequence[float] = STEPS,
    draws: int = 2,
    progress: Progress | None = None,
) -> list[Rise]:
    """Rises of the loss by steps along and across the rays, with None for numbers that are not finite.

    steps: px; draws: of the directions and signs, 2 or more, in each view.
    """
    if draws < 2:
        raise InputError(f"expected at least 2 draws, got {draws}")
    seeds = torch.randint(2**62, (draws,), generator=generator, device=generator.device).tolist()
    views = len(objective.views)
    rises, discontinuous = torch.zeros(2, len(steps), len(KINDS), views, draws, dtype=torch.float64)
    for index in range(views):
        center, piece = objective.evaluate_view(index, objective.active)
        for draw, seed in enumerate(seeds):
            directions = _directions(objective, index, torch.Generator(generator.device).manual_seed(seed + index))
            for s, step in enumerate(steps):
                for kind, direction in enumerate(directions):
                    ends = [_moved(objective, index, sign * step * direction) for sign in (1, -1)]
                    rises[s, kind, index, draw] = sum(loss for loss, _ in ends) / 2 - center
                    discontinuous[s, kind, index, draw] = sum(order != piece for _, order in ends) / 2
            if progress:
                progress(index * draws + draw + 1, views * draws, "finite steps along and across the rays")
    values, errors = mean_of_parts(rises)
    ratio, relative = values[:, 0] / values[:, 1], errors / values
    columns = {"ratio": ratio, "ratio_error": ratio.abs() * relative.square().sum(dim=1).sqrt()}
    for suffix, table in (("", values), ("_error", errors), ("_crossed", discontinuous.mean(dim=(2, 3)))):
        columns |= {f"{name}{suffix}": table[:, kind] for kind, name in enumerate(KINDS)}
    numbers = torch.stack(list(columns.values()), dim=1).tolist()
    rows = [dict(zip(columns, map(finite_or_none, row), strict=True)) for row in numbers]
    return [convert({"pixels": step, **row}, Rise) for step, row in zip(steps, rows, strict=True)]


def along_and_across(vectors: Float[Tensor, "n 3"], rays: Float[Tensor, "n 3"]) -> Float64[Tensor, "n 2"]:
    """Lengths of the components of vectors along and across their rays.

    >>> along_and_across(torch.tensor([[3.0, -4.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]]))
    tensor([[4., 3.]], dtype=torch.float64)
    """
    v, g = rays.double(), vectors.double()
    return torch.stack([(g * v).sum(dim=1).abs(), _across(g, v).norm(dim=1)], dim=1)


def _across(vectors: Float[Tensor, "n 3"], rays: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    return vectors - (vectors * rays).sum(dim=1, keepdim=True) * rays


def _mean(blocks: PerGaussianBlocks, kind: str) -> float:
    return sum(view[kind] for view in blocks.views) / len(blocks.views)


def _signs(
    objective: SceneObjective, index: int, generators: Sequence[torch.Generator], names: Sequence[str]
) -> Float[Tensor, "p b s"]:
    """Probe vectors: random signs along the rays; random signs in space, projected across the rays (`traces.Draw`)."""
    flat, ray = objective.active.flat, objective.rays(index)
    U = flat.new_zeros(flat.numel(), len(names), len(generators))
    for j, generator in enumerate(generators):
        z = draw_probes(4 * len(ray), 1, generator, flat.dtype, "rademacher").view(-1, 4).to(ray)
        moves = {"depth": z[:, :1] * ray, "lateral": _across(z[:, 1:], ray)}
        for i, name in enumerate(names):
            U[objective.blocks["means"], i, j] = moves[name].reshape(-1)
    return U


def _directions(
    objective: SceneObjective, index: int, generator: torch.Generator
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Steps along and across the rays, of the length that is a pixel wide at the mean."""
    ray, camera, means = objective.rays(index), objective.views[index].camera, objective.active.means
    pixel = (means - camera.centre.to(means)).norm(dim=1, keepdim=True) / float(camera.fx)
    z = draw_probes(4 * len(ray), 1, generator, torch.float64, "gaussian").view(-1, 4).to(means)
    return z[:, :1].sign() * ray * pixel, F.normalize(_across(z[:, 1:], ray), dim=1) * pixel


def _moved(objective: SceneObjective, index: int, moves: Float[Tensor, "n 3"]) -> tuple[float, object]:
    """`evaluate_view` with the means displaced by `moves`."""
    flat = objective.active.flat.clone()
    flat[objective.blocks["means"]] += moves.reshape(-1)
    gaussians = objective.active.with_flat(flat)
    gaussians.require_finite()
    return objective.evaluate_view(index, gaussians)
