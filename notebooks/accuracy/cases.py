"""Cases of the accuracy study: operators with known traces, spectrum and diagonal, and the cost of their products.

splats      the Hessian of a small synthetic scene as a dense matrix in float64, whose eigendecomposition is the truth.
            Methods get the same matrix in float32; a product costs what the scene's kernels take for it.  Only
            `exact_traces`, which needs more than products, and the comparison of precisions run on the scene itself.
matrices    random eigenvectors, prescribed eigenvalues
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter

import torch
from jaxtyping import Float64
from torch import Tensor

from analysis.bench.accuracy.cases import Case, Truth
from landscape.operators.operator import DenseOperator, SymmetricOperator
from landscape.spectrum.density import ActiveSpace
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene

ROWS = 200  # of a random matrix
WIDTHS = (1, 2, 4, 8)  # vectors at a time whose product is timed
SETTINGS = SyntheticSettings(60, 2, 24, 18, sh_degree=0)


@dataclass(frozen=True, eq=False)
class StudyCase(Case):
    """A case of the study.  products: the scene's kernels by precision, None of a matrix."""

    products: Mapping[torch.dtype, SymmetricOperator] | None = None


class MatrixOperator(DenseOperator):
    """A matrix whose products of blocks are quick: columns outside the rows of V that are not 0 are not read."""

    def apply(self, V: Tensor) -> Tensor:
        used = V.any(dim=1).nonzero()
        rows = slice(int(used[0]), int(used[-1]) + 1) if len(used) else slice(0, 0)
        return self.matrix[:, rows] @ V[rows]


def truth_of_matrix(matrix: Float64[Tensor, "n n"], blocks: Mapping[str, slice]) -> Truth:
    """The truth of a dense matrix."""
    values, diagonal = torch.linalg.eigvalsh(matrix), matrix.diagonal()
    total = float(values.abs().sum())
    return Truth(
        traces={name: float(diagonal[rows].sum()) for name, rows in blocks.items()},
        scales={name: float(diagonal[rows].abs().sum() or diagonal.abs().sum()) for name, rows in blocks.items()},
        largest=float(values[-1]),
        smallest=float(values[0]),
        absolute_sum=total,
        participation_ratio=total**2 / float(values.square().sum()),
        diagonal=diagonal.clone(),
    )


# --- random matrices --------------------------------------------------------------------------------------------------


def spectra() -> dict[str, Float64[Tensor, " n"]]:
    """Spectra like those of curvature: a power law, clusters at the ends, both signs, few nonzero ones, none dominant."""
    n, i = ROWS, torch.arange(ROWS, dtype=torch.float64)
    ends = torch.where(i < 5, 1 - 1e-3 * i, torch.where(i >= n - 4, -0.3, 0.3 * i / n))
    return {
        "power law": (1 + i) ** -1.5,
        "clustered": ends,
        "indefinite": torch.where(i % 3 > 0, 1.0, -0.3) / (1 + i) ** 0.5,
        "rank-deficient": torch.where(i < n // 40, 1 + i, torch.zeros_like(i)),
        "flat": 1 + i / n,
    }


def matrix_cases(seed: int) -> Iterator[StudyCase]:
    """Dense float64 matrices with these spectra."""
    for index, (name, values) in enumerate(spectra().items()):
        generator = torch.Generator().manual_seed(1000 * seed + index)
        n = len(values)
        vectors = torch.linalg.qr(torch.randn(n, n, generator=generator, dtype=torch.float64)).Q
        matrix = (vectors * values) @ vectors.T
        operator = MatrixOperator((matrix + matrix.T) / 2)
        yield StudyCase(name, "matrices", operator, truth_of_matrix(operator.matrix, operator.blocks))


# --- splats -----------------------------------------------------------------------------------------------------------


def splat_cases(seed: int, scenes: int = 1) -> dict[str, Callable[[], StudyCase]]:
    """Constructors of the scenes, by name: two with SSIM, far from a fit and near it; one with the pixel loss alone, whose
    traces are exact.  scenes: of each kind, from different seeds; the k-th is called NAME #k."""
    kinds = {
        "far from a fit": (0.2, LossSettings()),
        "near a fit": (0.02, LossSettings()),
        "pixel loss alone": (0.2, LossSettings(ssim_weight=0.0)),
    }
    found = {}
    for k in range(scenes):
        settings = replace(SETTINGS, seed=SETTINGS.seed + k)
        for kind, (noise, loss) in kinds.items():
            name = kind if k == 0 else f"{kind} #{k + 1}"
            found[name] = partial(splat_case, name, noise, loss, seed + k, settings)
    return found


def splat_case(
    name: str, noise: float, loss: LossSettings, seed: int, settings: SyntheticSettings = SETTINGS
) -> StudyCase:
    """The synthetic scene with `noise` on every stored parameter."""
    made, generator = synthetic_scene(settings), torch.Generator().manual_seed(seed)
    flat = made.truth.flat
    gaussians = made.truth.with_flat(flat + noise * torch.randn(flat.shape, generator=generator, dtype=flat.dtype))
    views = made.scene.load()
    doubled = [replace(view, image=view.image.double()) for view in views]
    single = SceneObjective(gaussians, views, loss)
    exact = SceneObjective(single.active.to(torch.float64), doubled, loss)
    H = SceneHessian(exact)
    matrix = H.apply(torch.eye(H.dim, dtype=torch.float64))
    matrix = (matrix + matrix.T) / 2
    rough = SceneHessian(single)
    operator = MatrixOperator(matrix.float(), dict(H.blocks))
    active = ActiveSpace(rough.project, rough.rank)
    products = {torch.float32: rough, torch.float64: H}
    truth = truth_of_matrix(matrix, H.blocks)
    return StudyCase(name, "splats", operator, truth, price_of(rough), single, active, products)


def price_of(operator: SymmetricOperator) -> Callable[[int], float]:
    """Seconds of a product with k vectors, split into the widest blocks of WIDTHS; a block's is the shortest of three."""
    seconds = {}
    for width in WIDTHS:
        V = torch.ones(operator.dim, width, dtype=operator.dtype)
        times = []
        for _ in range(4):  # the first compiles and linearises
            start = perf_counter()
            operator.apply(V)
            times.append(perf_counter() - start)
        seconds[width] = min(times[1:])

    def price(k: int) -> float:
        total = 0.0
        for width in reversed(WIDTHS):
            total += k // width * seconds[width]
            k %= width
        return total

    return price
