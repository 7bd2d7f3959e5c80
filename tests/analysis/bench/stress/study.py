"""Image, first and second derivatives at the limits of the renderer, against the specification in float64 and stated bounds.

The truth is the plain torch specification in float64, differentiated by autograd (H as a dense matrix).  The bound of a
quantity Q follows from its condition K(Q), the change of Q by relative changes of all intermediate numbers
(`condition`):

    bound = (4 sqrt(k / 3) (u + u64) + e) K(Q)        k = 8 + 3 n roundings between two stages, u half an eps

A rounding is uniform in +-u, of variance u^2 / 3; k of them add like a random walk: eight of an exponent, three of each of n
Gaussians over a pixel.  The bound is four standard deviations; u64 is the rounding of the specification, e the error of the
kernels' 2^x.  Norms are over the rows of an attribute.  The smallest normal number is added once a pixel, for quantities that
vanish.  K and factors of the quantities, with the error D of the operator:

    image, gradient        K of the quantity
    H v, Gauss-Newton v    K of the quantity, v random signs
    own blocks             the diagonal block of every Gaussian and attribute: C K of H_b z, b the attribute's rows and columns,
                           z random signs: E |D z|^2 = |D|_F^2, which bounds that of the Gaussians' blocks
    traces                 the same times sqrt(dim): |tr D| <= sqrt(dim) |D|_F
    ends of the spectrum   |d lambda| <= |D|_2 <= |D|_F (Weyl), and the residual that Lanczos reports

C is the cancellation in sums of moments (`cancellation`).  Blocks and traces are those of the pixel loss alone, where
`block_diagonal` and `exact_traces` are exact; the others are with SSIM.  Where the specification cannot be evaluated
(`stand_in_of`; the dense H of a crowd) float32 is compared with the float64 kernels.
"""

from dataclasses import dataclass
from math import sqrt

import torch
from jaxtyping import Float64
from torch import Tensor

from analysis.bench.stress import PIXELS_ALONE, WITH_SSIM, Case, objective_of, set_rows
from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from splat.backend.cpu.exponential import EXP2_ERROR
from splat.curvature.gaussian_blocks import GEOMETRY_COLUMNS
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import exact_traces
from splat.model.gaussians import Gaussians
from tests.analysis.bench.stress.condition import Condition, cancellation, specified

PRECISIONS = {"float32": torch.float32, "float64": torch.float64}


def stand_in_of(case: Case) -> Gaussians | None:
    """A scene with the same derivatives, to many digits, where the specification cannot be evaluated at the case itself."""
    if case.name != "one log-scale of 20":
        return None
    attributes = {name: value.clone() for name, value in case.gaussians.attributes.items()}
    set_rows("log_scales", 5.0, (0, 1))(attributes)
    return Gaussians.pack(attributes)


@dataclass(frozen=True)
class Finding:
    """One comparison.  error, bound and size (of the truth): norms."""

    case: str
    quantity: str
    attribute: str
    precision: str
    error: float
    bound: float
    size: float

    @property
    def holds(self) -> bool:
        return self.error <= self.bound  # nan does not


# --- the kernels ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Scene:
    """The objectives of a case in one precision, with SSIM and without."""

    smooth: SceneObjective
    pixels: SceneObjective

    @classmethod
    def of(cls, case: Case, dtype: torch.dtype) -> "Scene":
        return cls(objective_of(case, WITH_SSIM, dtype), objective_of(case, PIXELS_ALONE, dtype))

    def gaussian_blocks(self) -> dict[str, Tensor]:
        """The diagonal blocks of every Gaussian, by attribute, (n, d, d); of SH the diagonal."""
        blocks = self.pixels.block_diagonal()
        result = {name: blocks.geometry[:, part, part].double() for name, part in GEOMETRY_COLUMNS.items()}
        return {**result, "sh": blocks.sh.double()}

    def values(self, U: Float64[Tensor, "p k"]) -> dict[str, Tensor]:
        """Quantities over stored parameters, in float64, by name."""
        v = U[:, :1].to(self.smooth.active.flat.dtype)
        products = {
            "H v": SceneHessian(self.smooth, keep_null=True).apply(v),
            "Gauss-Newton v": SceneHessian(self.smooth, gauss_newton=True, keep_null=True).apply(v),
        }
        return {"gradient": self.smooth.gradient.double(), **{name: x[:, 0].double() for name, x in products.items()}}

    def image(self) -> Tensor:
        return next(iter(self.smooth.linearized)).image.double()


# --- comparisons ------------------------------------------------------------------------------------------------------


class Study:
    """The findings of one case."""

    def __init__(self, case: Case, seed: int):
        self.case, self.seed, self.findings = case, seed, []
        self.scenes = {name: Scene.of(case, dtype) for name, dtype in PRECISIONS.items()}
        exact = self.scenes["float64"].smooth
        self.point, self.blocks = exact.active, exact.blocks
        generator = torch.Generator().manual_seed(seed)
        signs = torch.randint(0, 2, (self.point.flat.numel(), 1), generator=generator).double() * 2 - 1
        masked = torch.zeros(len(signs), len(self.blocks), dtype=torch.float64)
        for column, rows in enumerate(self.blocks.values()):
            masked[rows, column] = signs[rows, 0]
        self.U = torch.cat([signs, masked], dim=1)
        self.stand_in = stand_in_of(case)
        self.measured_at = self.point if self.stand_in is None else self.stand_in.select(exact.mask)

    @property
    def compared(self) -> list[str]:
        return list(PRECISIONS) if self.stand_in is None else ["float32"]

    def judge(
        self, quantity: str, attribute: str, precision: str, got: Tensor, truth: Tensor, condition: float
    ) -> None:
        least = torch.finfo(PRECISIONS[precision]).tiny * self.case.target.numel()
        self.record(quantity, attribute, precision, got, truth, self.round_off(precision) * condition + least)

    def round_off(self, precision: str) -> float:
        """The factor of K in the bound."""
        info, n = torch.finfo(PRECISIONS[precision]), len(self.point)
        u = (info.eps + torch.finfo(torch.float64).eps) / 2
        return 4 * sqrt((8 + 3 * n) / 3) * u + EXP2_ERROR[info.bits]

    def record(self, quantity: str, attribute: str, precision: str, got: Tensor, truth: Tensor, bound: float) -> None:
        error, size = float((got - truth).norm()), float(truth.norm())
        self.findings.append(Finding(self.case.name, quantity, attribute, precision, error, bound, size))

    def run(self) -> list[Finding]:
        self.with_ssim()
        self.pixels_alone()
        return self.findings

    def with_ssim(self) -> None:
        """Image, gradient, products and, where H fits as a dense matrix, the ends of its spectrum."""
        condition = Condition.of(self.case, self.measured_at, WITH_SSIM, self.U[:, :1], self.seed)
        kernels = self.scenes["float64"]
        if self.stand_in is None:
            exact = specified(self.case, self.point, WITH_SSIM, self.U[:, :1])
            image = exact.image
            truth = {"gradient": exact.gradient, "H v": exact.products[:, 0], "Gauss-Newton v": exact.gauss_newton}
        else:
            image, truth = kernels.image(), kernels.values(self.U)
        fields = {"gradient": "gradient", "H v": "products", "Gauss-Newton v": "gauss_newton"}
        for precision in self.compared:
            scene = self.scenes[precision]
            self.judge("image", "", precision, scene.image(), image, condition("image"))
            for quantity, got in scene.values(self.U).items():
                for name, rows in self.blocks.items():
                    K = condition(fields[quantity], rows)
                    self.judge(quantity, name, precision, got[rows], truth[quantity][rows], K)
            if self.case.dense:
                self.ends(precision, condition("products"))

    def ends(self, precision: str, condition: float) -> None:
        """The ends by Lanczos, against those of the dense H: of the specification, or of the float64 kernels for a stand-in."""
        exact = SceneHessian(self.scenes["float64"].smooth)
        identity = torch.eye(exact.dim, dtype=torch.float64)
        if self.stand_in is None:
            seen = exact.project(identity)
            dense = specified(self.case, self.point, WITH_SSIM, identity).products
            values = torch.linalg.eigvalsh(seen @ dense @ seen)
        else:
            values = torch.linalg.eigvalsh(exact.apply(identity))
        H, generator = SceneHessian(self.scenes[precision].smooth), torch.Generator().manual_seed(self.seed)
        found = extreme_eigenpairs(H, generator, EigenSettings(rtol=1e-4, max_matvecs=2 * H.dim))
        bound = self.round_off(precision) * condition
        for name, pairs, value in (("largest", found.largest, values[-1]), ("smallest", found.smallest, values[0])):
            self.record("spectrum", name, precision, pairs.values[0], value, bound + float(pairs.residuals[0]))

    def pixels_alone(self) -> None:
        """Diagonal blocks and exact traces of the pixel loss."""
        condition = Condition.of(self.case, self.measured_at, PIXELS_ALONE, self.U, self.seed)
        cancels = cancellation(self.case, self.measured_at)
        dense = None
        if self.case.dense and self.stand_in is None:
            identity = torch.eye(self.point.flat.numel(), dtype=torch.float64)
            dense = specified(self.case, self.point, PIXELS_ALONE, identity).products
        truth = self.scenes["float64"].gaussian_blocks() if dense is None else self.dense_blocks(dense)
        traces = self.traces("float64") if dense is None else self.dense_traces(truth)
        for precision in self.compared if dense is not None else ["float32"]:
            blocks, sums = self.scenes[precision].gaussian_blocks(), self.traces(precision)
            for i, (name, rows) in enumerate(self.blocks.items()):
                K = cancels * condition("products", (rows, i + 1))
                self.judge("own blocks", name, precision, blocks[name], truth[name], K)
                self.judge("traces", name, precision, sums[name], traces[name], sqrt(rows.stop - rows.start) * K)

    def traces(self, precision: str) -> dict[str, Tensor]:
        found = exact_traces(self.scenes[precision].pixels, torch.Generator().manual_seed(self.seed))
        return {name: torch.tensor(trace.value, dtype=torch.float64) for name, trace in found.items()}

    def dense_blocks(self, dense: Tensor) -> dict[str, Tensor]:
        n, result = len(self.point), {}
        for name, rows in self.blocks.items():
            part = dense[rows, rows]
            part = part.view(n, -1, n, part.shape[0] // n).diagonal(dim1=0, dim2=2).movedim(-1, 0)
            result[name] = part
        result["sh"] = dense.diagonal()[self.blocks["sh"]].view_as(self.point.sh)
        return result

    def dense_traces(self, blocks: dict[str, Tensor]) -> dict[str, Tensor]:
        result = {name: block.diagonal(dim1=1, dim2=2).sum() for name, block in blocks.items() if name != "sh"}
        q = self.point.quats
        result["quats"] = result["quats"] - torch.einsum("ni,nij,nj->", q, blocks["quats"], q)
        return {**result, "sh": blocks["sh"].sum()}
