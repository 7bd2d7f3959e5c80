"""The directions that `landscape slice` looks along, by name, and how far it looks.

    eigenvectors    e₁, e₂: unit eigenvectors of the two largest eigenvalues of H.  Radius in curvature units; 3
    random          r₁, r₂: Gaussian, of every attribute of every Gaussian as long as that attribute is (of a mean: as its
                    distance from the origin), so that a radius of 0.001 changes each by about a thousandth; 0.001
    gradient        unit vector of the steepest ascent.  Radius in units of the parameters; 3 curvature units
    line            from the checkpoint, at 0, to the other, at 1.  Radius: how far beyond both; 0.5.  With a third checkpoint a
                    plane through all three, at (0, 0), (1, 0) and (0, 1): line₁, line₂

    curvature unit  sqrt(2 rise L / |d.H d|): the step within which the curvature alone changes the loss by rise L

Eigenvectors that are known already are taken where H itself confirms them: |H v - lambda v| within the tolerance, lambda
falling.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from analysis.measures.units import UNITS
from analysis.slice.options import Along
from landscape import (
    EigenSettings,
    curvature_reach,
    extreme_eigenpairs,
    gradient_direction,
    groups_of,
    line_between,
    orthonormal,
    random_directions,
    symmetric_axis,
)
from landscape.errors import InputError
from landscape.operators.operator import SymmetricOperator
from landscape.results import Progress
from splat.curvature.objective import SceneObjective

SHARE = 0.001  # default radii: as a share of the parameters' sizes, ...
BEYOND = 0.5  # ... beyond a line's ends
PLANES = ("eigenvectors", "random")  # kinds that are two directions
RTOL, MAX_MATVECS = 1e-3, 300  # of the eigenvectors


@dataclass(frozen=True)
class Shape:
    """Directions to slice along: of which kind, in how many dimensions, a radius for each or none."""

    kind: Along
    dimension: int
    radii: tuple[float | None, ...]

    @classmethod
    def of(
        cls, along: Along | None, dimension: int | None, radii: Sequence[float], points: int, others: int
    ) -> "Shape":
        """The shape that was asked for; ValueError where the wishes contradict each other."""
        kind = along or ("line" if others else "eigenvectors")
        if (kind == "line") != bool(others):
            given = "one more checkpoint; leave out --along" if others else "no other checkpoint; name it"
            raise InputError(f"expected two checkpoints for a line and one otherwise, got {given}")
        if others > 2:
            raise InputError(f"expected at most three checkpoints, for the plane through them, got {1 + others}")
        most = 2 if kind in PLANES or others == 2 else 1
        wanted = most if dimension is None else dimension
        if others == 2 and wanted == 1:
            raise InputError(
                "expected two checkpoints for a line, got three, which span a plane; leave out one, or --dimension"
            )
        if wanted > most:
            raise InputError(f"expected one dimension of {kind}, got {wanted}; planes are along {' and '.join(PLANES)}")
        if len(radii) > wanted or any(not 0 < radius < float("inf") for radius in radii):
            raise InputError(f"expected at most {wanted} radii, finite and above 0, got {list(radii)}")
        symmetric_axis(1.0, points)  # says what is wrong with their number
        each = radii if len(radii) == wanted else [*radii, *radii, None, None][:wanted]
        return cls(kind, wanted, tuple(each))

    @property
    def name(self) -> str:
        return f"{self.kind}-{self.dimension}d"


@dataclass(frozen=True, eq=False)
class Direction:
    """One column of the slice's directions.  residual: |H v - lambda v| of an eigenvector; scale: what a step of 1 is."""

    kind: Along
    name: str
    vector: Float[Tensor, " n"]
    residual: float | None = None
    scale: str = "units of the parameters"


def find_directions(
    shape: Shape,
    objective: SceneObjective,
    operator: SymmetricOperator,
    others: Sequence[Float[Tensor, " n"]],
    known: Sequence[Float[Tensor, "n k"]],
    generators: dict[str, torch.Generator],
    report: Progress,
) -> list[Direction]:
    """The directions of a shape.  others: where lines end; known: eigenvectors to try before they are computed."""
    center, kind, count = objective.active.flat, shape.kind, shape.dimension
    if kind == "eigenvectors":
        vectors, residuals = largest_eigenvectors(operator, count, known, generators[kind], report)
        return [Direction(kind, f"e{'₁₂'[i]}", vectors[:, i], residuals[i]) for i in range(count)]
    if kind == "random":
        groups = groups_of(objective.blocks, len(objective.active), center.numel())
        vectors = random_directions(center, groups, generators[kind], count)
        return [Direction(kind, f"r{'₁₂'[i]}", vectors[:, i], scale="share of the size") for i in range(count)]
    if kind == "gradient":
        return [Direction(kind, "the gradient", gradient_direction(objective.gradient)[:, 0])]
    vectors = torch.cat([line_between(center, other) for other in others], dim=1)
    orthonormal(vectors)  # refuses three checkpoints on one line
    names = ["the line"] if len(others) == 1 else ["line₁", "line₂"]
    return [Direction(kind, name, vectors[:, i], scale="share of the way") for i, name in enumerate(names)]


def axis_of(kind: Along, radius: float | None, points: int, curvature: float, rise: float) -> Float64[Tensor, " _"]:
    """The steps along a direction with so much curvature, where the loss may rise by `rise` in a curvature unit.

    >>> axis_of("line", 0.5, 5, 1.0, 1.0), axis_of("eigenvectors", 2.0, 3, 8.0, 1.0)
    (tensor([-0.5000,  0.0000,  0.5000,  1.0000,  1.5000], dtype=torch.float64), tensor([-1.,  0.,  1.], dtype=torch.float64))
    """
    if kind == "line":
        beyond = BEYOND if radius is None else radius
        between = max(round((points - 1) / (1 + 2 * beyond)), 1)
        outside = max(round(beyond * between), 1)
        return torch.arange(-outside, between + outside + 1, dtype=torch.float64) / between
    if kind == "eigenvectors" or (kind == "gradient" and radius is None):
        return symmetric_axis(curvature_reach(curvature, rise, UNITS if radius is None else radius), points)
    return symmetric_axis(SHARE if radius is None else radius, points)


def largest_eigenvectors(
    operator: SymmetricOperator,
    count: int,
    known: Sequence[Float[Tensor, "n k"]],
    generator: torch.Generator,
    report: Progress,
) -> tuple[Float[Tensor, "n {count}"], list[float]]:
    """The first of the known that the operator confirms, else by Lanczos, begun from what is known; with residuals."""
    start = None
    for vectors in (each[:, :count] for each in known):
        if vectors.shape != (operator.dim, count) or not vectors.isfinite().all():
            continue
        start = vectors.to(operator.dtype)
        values, residuals = _measured(operator, start)
        ordered = bool((values.diff() <= RTOL * values.abs().max()).all())  # the steepest first
        unit = (start.double().norm(dim=0) - 1).abs() <= RTOL
        if ordered and unit.all() and (residuals <= RTOL * values.abs()).all():
            report(1, 1, "known already")
            return start, residuals.tolist()
    settings = EigenSettings(largest=count, smallest=0, rtol=RTOL, max_matvecs=MAX_MATVECS)
    vectors = extreme_eigenpairs(operator, generator, settings, start, report).largest.vectors
    return vectors, _measured(operator, vectors)[1].tolist()  # those of a run that continues from here


def _measured(
    operator: SymmetricOperator, vectors: Float[Tensor, "n k"]
) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
    """v.H v and |H v - (v.H v) v| of each column."""
    product, exact = operator.apply(vectors).double(), vectors.double()
    values = (exact * product).sum(dim=0)
    return values, (product - values * exact).norm(dim=0)
