"""What people use today, on the same operators: SciPy, curvlinops, PyHessian and hessian-eigenthings, as they are published.

SciPy always runs.  The others run where they are installed (`pip install -e '.[peers]'`); `peer_methods` says which
are not.  Each is given an operator of its own kind around ours, so that its products are counted like ours; nothing of
its algorithm is changed.  Where a peer finds one end of the spectrum or the eigenvalue of largest magnitude, it is run as its
users would for both: a run an end, or a second run on H less the eigenvalue found.  Blocks' traces are a run a block.
"""

import importlib
from collections.abc import Callable, Iterator
from math import nan
from types import ModuleType
from typing import Any

import numpy as np
import torch
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh, lobpcg
from torch import Tensor

from analysis.bench.accuracy.cases import Case, MeteredOperator, weighted_quantile
from analysis.bench.accuracy.methods import BUDGETS, DENSITIES, Answer, Method
from landscape.operators.operator import RestrictedOperator, SymmetricOperator

PACKAGES = {
    "curvlinops": "curvlinops-for-pytorch",
    "pyhessian": "pyhessian",
    "hessian_eigenthings": "hessian-eigenthings",
}
ALIKE = {"Hutchinson": "the packages' Hutchinson", "Hutch++": "the packages' Hutch++"}  # random signs, the same sums
# of a Lanczos run, a seventh apart: its error falls to round-off within a few steps, between which nothing can be read
STEPS = (10, 12, 14, 16, 18, 20, 23, 26, 30, 35, 40, 46, 53, 61, 70, 80)
POWER_STEPS = (50, 150)
DIAGONALS = (8, 12, 16, 24, 32, 48, 64)  # matvecs; exact from twice the rank on


def peer_methods(budgets: tuple[int, ...] = BUDGETS) -> tuple[list[Method], list[str]]:
    """The methods of the peers that are installed, and a sentence for each that is not."""
    methods, missing = list(scipy_methods()), []
    builders = {"curvlinops": _curvlinops, "pyhessian": _pyhessian, "hessian_eigenthings": _eigenthings}
    for name, build in builders.items():
        try:
            module = importlib.import_module(name)
        except ImportError as error:
            missing.append(f"{PACKAGES[name]} is left out ({error}); pip install -e '.[peers]' adds it")
            continue
        methods += build(module, budgets)
    return methods, missing


def _method(
    quantity: str,
    name: str,
    settings: str,
    run: Callable[[Case, MeteredOperator, int], list[Answer]],
    estimator: str = "",
) -> Method:
    """A peer that draws from torch's global generator draws what the seed says; the generator's state is put back."""

    def seeded(case: Case, operator: MeteredOperator, seed: int) -> list[Answer]:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return run(case, operator, seed)

    return Method(quantity, name, settings, seeded, "peer", estimator=estimator)


def _by_block(trace: Callable[[SymmetricOperator], Any]) -> Callable[[Case, MeteredOperator, int], list[Answer]]:
    def of(operator: SymmetricOperator) -> float:
        try:
            return float(trace(operator))
        except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage]; where a sketch is singular
            return nan

    def run(_: Case, operator: MeteredOperator, __: int) -> list[Answer]:
        return [Answer(name, of(RestrictedOperator(operator, name))) for name in operator.blocks]

    return run


# --- SciPy ------------------------------------------------------------------------------------------------------------


def scipy_operator(operator: SymmetricOperator) -> LinearOperator:
    """The operator as SciPy's; a product with k vectors stays one."""
    dtype = np.dtype(str(operator.dtype).removeprefix("torch."))

    def matmat(V: np.ndarray) -> np.ndarray:
        return operator.apply(torch.from_numpy(np.ascontiguousarray(V.reshape(operator.dim, -1), dtype))).numpy()

    return LinearOperator((operator.dim, operator.dim), matvec=lambda v: matmat(v)[:, 0], matmat=matmat, dtype=dtype)  # pyright: ignore[reportCallIssue]


def scipy_methods() -> Iterator[Method]:
    for tol in (1e-1, 1e-2, 1e-3):

        def both(_: Case, operator: MeteredOperator, seed: int, tol: float = tol) -> list[Answer]:
            values = _eigsh(operator, seed, 2, "BE", tol)
            return [Answer("largest", values[-1]), Answer("smallest", values[0])]

        def each(_: Case, operator: MeteredOperator, seed: int, tol: float = tol) -> list[Answer]:
            found = {part: _eigsh(operator, seed, 1, which, tol)[0] for part, which in ENDS.items()}
            return [Answer(part, value) for part, value in found.items()]

        def local(case: Case, operator: MeteredOperator, seed: int, tol: float = tol) -> list[Answer]:
            start = (
                np.random.default_rng(seed).standard_normal((operator.dim, 1)).astype(scipy_operator(operator).dtype)
            )
            norm = max(abs(case.truth.largest), abs(case.truth.smallest))  # its tolerance is absolute
            answers = []
            for part in ENDS:
                with np.errstate(all="ignore"):
                    values, _ = lobpcg(
                        scipy_operator(operator), start, tol=tol * norm, maxiter=200, largest=part == "largest",
                        verbosityLevel=0,
                    )  # fmt: skip
                answers.append(Answer(part, float(values[0])))
            return answers

        yield _method("ends", "SciPy eigsh, both ends", f"tol {tol:g}", both)
        yield _method("ends", "SciPy eigsh, a run an end", f"tol {tol:g}", each)
        yield _method("ends", "SciPy lobpcg", f"tol {tol:g}", local)


ENDS = {"largest": "LA", "smallest": "SA"}


def _eigsh(operator: MeteredOperator, seed: int, k: int, which: str, tol: float) -> list[float]:
    start = np.random.default_rng(seed).standard_normal(operator.dim)
    try:
        options: dict[str, Any] = {"which": which, "v0": start, "tol": tol, "return_eigenvectors": False}
        values = eigsh(scipy_operator(operator), k, **options)
    except ArpackNoConvergence as stopped:
        values = stopped.eigenvalues
    ordered = sorted(map(float, values))
    return ordered if len(ordered) == k else [nan] * k


# --- curvlinops -------------------------------------------------------------------------------------------------------


def _curvlinops(module: ModuleType, budgets: tuple[int, ...]) -> Iterator[Method]:
    base = importlib.import_module("curvlinops._torch_base").PyTorchLinearOperator

    class Wrapped(base):
        SELF_ADJOINT = True

        def __init__(self, operator: SymmetricOperator) -> None:
            super().__init__([(operator.dim,)], [(operator.dim,)])
            self.operator = operator

        @property
        def device(self) -> torch.device:
            return torch.device("cpu")

        @property
        def dtype(self) -> torch.dtype:
            return self.operator.dtype

        def _matmat(self, X: list[Tensor]) -> list[Tensor]:
            return [self.operator.apply(X[0])]

    def fewer(matvecs: int, operator: SymmetricOperator) -> int:
        """It wants fewer than rows, and multiples of 2 or 3."""
        return min(matvecs, (operator.dim - 1) // 6 * 6)

    names = {"hutchinson_trace": "Hutchinson", "hutchpp_trace": "Hutch++", "xtrace": "XTrace"}
    for budget in budgets:
        for function, name in names.items():

            def trace(operator: SymmetricOperator, function: str = function, budget: int = budget) -> Tensor:
                return getattr(module, function)(Wrapped(operator), fewer(budget, operator))

            yield _method("traces", f"curvlinops {name}", f"{budget} matvecs", _by_block(trace), ALIKE.get(name, ""))
    for probes in DIAGONALS:
        for function, name in {"hutchinson_diag": "Hutchinson", "xdiag": "XDiag"}.items():

            def diagonal(
                _: Case, operator: MeteredOperator, __: int, function: str = function, probes: int = probes
            ) -> list[Answer]:
                return [Answer("all", getattr(module, function)(Wrapped(operator), fewer(probes, operator)).double())]

            yield _method("diagonal", f"curvlinops {name}", f"{probes} matvecs", diagonal)


# --- PyHessian --------------------------------------------------------------------------------------------------------


def _pyhessian(module: ModuleType, budgets: tuple[int, ...]) -> Iterator[Method]:
    class OnOperator(module.hessian):
        """Its class with products taken from an operator, where it takes them from a data loader."""

        def __init__(self, operator: SymmetricOperator, shift: float = 0.0) -> None:
            self.operator, self.shift = operator, shift
            self.model, self.device, self.full_dataset = torch.nn.Module(), "cpu", True
            self.params = [torch.zeros(operator.dim, dtype=operator.dtype)]

        def dataloader_hv_product(self, v: list[Tensor]) -> tuple[float, list[Tensor]]:
            u = v[0].to(self.operator.dtype)  # it draws float32 alone
            product = self.operator.apply(u[:, None])[:, 0] - self.shift * u
            return float(product @ u), [product]

    for budget in budgets:
        for tol in (0.0, 1e-3):

            def trace(operator: SymmetricOperator, budget: int = budget, tol: float = tol) -> float:
                return float(np.mean(OnOperator(operator).trace(maxIter=budget, tol=tol)))

            name = "PyHessian Hutchinson" + (", its own stop" if tol else "")
            alike = "" if tol else ALIKE["Hutchinson"]
            yield _method("traces", name, f"{budget} matvecs", _by_block(trace), alike)
    for tol in (1e-2, 1e-3, 1e-5):

        def ends(_: Case, operator: MeteredOperator, __: int, tol: float = tol) -> list[Answer]:
            first = OnOperator(operator).eigenvalues(maxIter=300, tol=tol)[0][0]
            other = first + OnOperator(operator, first).eigenvalues(maxIter=300, tol=tol)[0][0]
            return _ordered(first, other)

        yield _method("ends", "PyHessian power iteration", f"tol {tol:g}", ends)


def _ordered(first: float, other: float) -> list[Answer]:
    return [Answer("largest", max(first, other)), Answer("smallest", min(first, other))]


# --- hessian-eigenthings ----------------------------------------------------------------------------------------------


def _eigenthings(module: ModuleType, budgets: tuple[int, ...]) -> Iterator[Method]:
    def wrapped(operator: SymmetricOperator, shift: float = 0.0) -> Any:
        def product(v: Tensor) -> Tensor:
            return operator.apply(v[:, None])[:, 0] - shift * v

        return module.LambdaOperator(product, operator.dim, dtype=operator.dtype)

    yield from _eigenthings_traces(module, wrapped, budgets)
    yield from _eigenthings_ends(module, wrapped)
    yield from _eigenthings_sums(module, wrapped)


def _eigenthings_traces(module: ModuleType, wrapped: Callable[..., Any], budgets: tuple[int, ...]) -> Iterator[Method]:
    for budget in budgets:
        for method, name in {"hutchinson": "Hutchinson", "hutch++": "Hutch++"}.items():

            def traces(
                _: Case, operator: MeteredOperator, seed: int, method: str = method, budget: int = budget
            ) -> list[Answer]:
                answers = []
                for name in operator.blocks:
                    block = wrapped(RestrictedOperator(operator, name))
                    found = module.trace(block, num_matvecs=budget, method=method, seed=seed)
                    answers.append(Answer(name, found.estimate, found.stderr))
                return answers

            yield _method("traces", f"hessian-eigenthings {name}", f"{budget} matvecs", traces, ALIKE[name])


def _eigenthings_ends(module: ModuleType, wrapped: Callable[..., Any]) -> Iterator[Method]:
    for steps in STEPS:

        def each(_: Case, operator: MeteredOperator, seed: int, steps: int = steps) -> list[Answer]:
            answers = []
            for part, which in ENDS.items():
                found = module.lanczos(
                    wrapped(operator), k=1, max_iter=min(steps, operator.dim), which=which, seed=seed
                )
                answers.append(Answer(part, float(found.eigenvalues[0]), float(found.residuals[0])))
            return answers

        def one_run(_: Case, operator: MeteredOperator, seed: int, steps: int = steps) -> list[Answer]:
            most = min(steps, operator.dim)
            found = module.lanczos(wrapped(operator), k=most, max_iter=most, which="LA", seed=seed)
            ends = {"largest": 0, "smallest": -1}
            return [Answer(p, float(found.eigenvalues[i]), float(found.residuals[i])) for p, i in ends.items()]

        yield _method("ends", "hessian-eigenthings Lanczos, a run an end", f"{steps} steps", each)
        yield _method("ends", "hessian-eigenthings Lanczos, all Ritz pairs", f"{steps} steps", one_run)
    for steps in POWER_STEPS:

        def power(_: Case, operator: MeteredOperator, seed: int, steps: int = steps) -> list[Answer]:
            first = module.power_iteration_one(wrapped(operator), max_iter=steps, seed=seed)[0]
            other = module.power_iteration_one(wrapped(operator, first), max_iter=steps, seed=seed)[0]
            return _ordered(first, first + other)

        yield _method("ends", "hessian-eigenthings power iteration", f"{steps} steps an end", power)


def _eigenthings_sums(module: ModuleType, wrapped: Callable[..., Any]) -> Iterator[Method]:
    for starts, steps in (*DENSITIES, (6, 32)):

        def sums(
            case: Case, operator: MeteredOperator, seed: int, starts: int = starts, steps: int = steps
        ) -> list[Answer]:
            # it seeds its start vectors one after the other: those of two seeds must not overlap
            found = module.spectral_density(
                wrapped(operator), num_runs=starts, lanczos_steps=steps, num_grid_points=2, seed=1000 * seed
            )
            kept = found.raw_weights > 0
            values, weights = found.raw_eigenvalues[kept].double(), found.raw_weights[kept].double() / starts
            total, squares = float((weights * values.abs()).sum()), float((weights * values.square()).sum())
            small = weighted_quantile(values.abs(), weights * values.abs())
            return [
                Answer("sum of |lambda|", operator.dim * total),
                Answer("effective rank", operator.dim * total**2 / squares),
                Answer("mass quantile", float(values.max()) / small),
            ]

        yield _method("sums", "hessian-eigenthings quadrature", f"{starts} x {steps}", sums)
