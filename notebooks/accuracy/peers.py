"""Other packages' estimators on the same operators: SciPy, curvlinops, PyHessian and hessian-eigenthings, as published.

SciPy always runs; the others where they are installed (`pip install -e '.[peers]'`).  Each gets an operator of its type that
wraps ours, so that products are counted alike; its algorithm is unchanged.  A peer that finds one end of the spectrum runs once
for each end; one that finds the eigenvalue of largest magnitude runs again on H shifted by it.  Traces are one run a block.
"""

import importlib
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from math import nan
from types import ModuleType
from typing import Any

import numpy as np
import torch
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh, lobpcg
from torch import Tensor

from analysis.bench.accuracy.cases import Case, MeteredOperator
from analysis.bench.accuracy.command import DENSITIES, Answer, Method, Works
from landscape.operators.operator import RestrictedOperator, SymmetricOperator
from notebooks.accuracy.methods import BUDGETS

PACKAGES = {
    "curvlinops": "curvlinops-for-pytorch",
    "pyhessian": "pyhessian",
    "hessian_eigenthings": "hessian-eigenthings",
}
ALIKE = {
    "Hutchinson": "the packages' Hutchinson",
    "Hutch++": "the packages' Hutch++",
}  # the same estimator in all packages
ENDS = {"largest": "LA", "smallest": "SA"}
# of a Lanczos run, close together, as its error falls to round-off within a few steps
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


def _method(quantity: str, name: str, settings: str, run: Works, estimator: str = "") -> Method:
    """A peer's method, which runs with torch's global generator seeded; the generator's state is restored."""

    def seeded(case: Case, operator: MeteredOperator, seed: int) -> list[Answer]:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return run(case, operator, seed)

    return Method(quantity, name, settings, seeded, "peer", estimator=estimator)


def _by_block(trace: Callable[[SymmetricOperator], Any]) -> Works:
    """A run on each block; nan where a sketch is singular."""

    def of(operator: SymmetricOperator) -> float:
        try:
            return float(trace(operator))
        except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage]
            return nan

    return lambda _, operator, __: [Answer(name, of(RestrictedOperator(operator, name))) for name in operator.blocks]


def _ordered(first: float, other: float) -> list[Answer]:
    return [Answer("largest", max(first, other)), Answer("smallest", min(first, other))]


# --- SciPy ------------------------------------------------------------------------------------------------------------


def scipy_operator(operator: SymmetricOperator) -> LinearOperator:
    """The operator as SciPy's; a product with k vectors is one product."""
    dtype = np.dtype(str(operator.dtype).removeprefix("torch."))

    def matmat(V: np.ndarray) -> np.ndarray:
        return operator.apply(torch.from_numpy(np.ascontiguousarray(V.reshape(operator.dim, -1), dtype))).numpy()

    return LinearOperator((operator.dim, operator.dim), matvec=lambda v: matmat(v)[:, 0], matmat=matmat, dtype=dtype)  # pyright: ignore[reportCallIssue]


def scipy_methods() -> Iterator[Method]:
    """Both ends by ARPACK in one run, by a run an end, and by LOBPCG."""
    runs = {"eigsh, both ends": _both_ends, "eigsh, a run an end": _each_end, "lobpcg": _lobpcg}
    for tol, (name, run) in product((1e-1, 1e-2, 1e-3), runs.items()):
        yield _method("ends", f"SciPy {name}", f"tol {tol:g}", partial(run, tol=tol))


def _both_ends(_: Case, operator: MeteredOperator, seed: int, tol: float) -> list[Answer]:
    return _ordered(*_eigsh(operator, seed, 2, "BE", tol))


def _each_end(_: Case, operator: MeteredOperator, seed: int, tol: float) -> list[Answer]:
    return [Answer(part, _eigsh(operator, seed, 1, which, tol)[0]) for part, which in ENDS.items()]


def _eigsh(operator: MeteredOperator, seed: int, k: int, which: str, tol: float) -> list[float]:
    start = np.random.default_rng(seed).standard_normal(operator.dim)
    options: dict[str, Any] = {"which": which, "v0": start, "tol": tol, "return_eigenvectors": False}
    try:
        values = eigsh(scipy_operator(operator), k, **options)
    except ArpackNoConvergence as stopped:
        values = stopped.eigenvalues
    return list(map(float, values)) if len(values) == k else [nan] * k


def _lobpcg(case: Case, operator: MeteredOperator, seed: int, tol: float) -> list[Answer]:
    H = scipy_operator(operator)
    start = np.random.default_rng(seed).standard_normal((operator.dim, 1)).astype(H.dtype)
    options: dict[str, Any] = {"tol": tol * max(abs(case.truth.largest), abs(case.truth.smallest))}  # it is absolute
    options |= {"maxiter": 200, "verbosityLevel": 0}
    with np.errstate(all="ignore"):
        return [Answer(part, float(lobpcg(H, start, largest=part == "largest", **options)[0][0])) for part in ENDS]


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

    def estimate(operator: SymmetricOperator, function: str, matvecs: int) -> Tensor:
        fewer = min(matvecs, (operator.dim - 1) // 6 * 6)  # it wants fewer than rows, and multiples of 2 or 3
        return getattr(module, function)(Wrapped(operator), fewer)

    def diagonal(_: Case, operator: MeteredOperator, __: int, function: str, matvecs: int) -> list[Answer]:
        return [Answer("all", estimate(operator, function, matvecs).double())]

    names = {"hutchinson_trace": "Hutchinson", "hutchpp_trace": "Hutch++", "xtrace": "XTrace"}
    for budget, (function, name) in product(budgets, names.items()):
        run = _by_block(partial(estimate, function=function, matvecs=budget))
        yield _method("traces", f"curvlinops {name}", f"{budget} matvecs", run, ALIKE.get(name, ""))
    for matvecs, (function, name) in product(DIAGONALS, {"hutchinson_diag": "Hutchinson", "xdiag": "XDiag"}.items()):
        run = partial(diagonal, function=function, matvecs=matvecs)
        yield _method("diagonal", f"curvlinops {name}", f"{matvecs} matvecs", run)


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

    def trace(operator: SymmetricOperator, budget: int, tol: float) -> float:
        return float(np.mean(OnOperator(operator).trace(maxIter=budget, tol=tol)))

    def ends(_: Case, operator: MeteredOperator, __: int, tol: float) -> list[Answer]:
        first = OnOperator(operator).eigenvalues(maxIter=300, tol=tol)[0][0]
        return _ordered(first, first + OnOperator(operator, first).eigenvalues(maxIter=300, tol=tol)[0][0])

    for budget in budgets:
        for tol, stop, alike in ((0.0, "", ALIKE["Hutchinson"]), (1e-3, ", its own stop", "")):
            run = _by_block(partial(trace, budget=budget, tol=tol))
            yield _method("traces", f"PyHessian Hutchinson{stop}", f"{budget} matvecs", run, alike)
    for tol in (1e-2, 1e-3, 1e-5):
        yield _method("ends", "PyHessian power iteration", f"tol {tol:g}", partial(ends, tol=tol))


# --- hessian-eigenthings ----------------------------------------------------------------------------------------------


def _eigenthings(module: ModuleType, budgets: tuple[int, ...]) -> Iterator[Method]:
    def wrapped(operator: SymmetricOperator, shift: float = 0.0) -> Any:
        def product(v: Tensor) -> Tensor:
            return operator.apply(v[:, None])[:, 0] - shift * v

        return module.LambdaOperator(product, operator.dim, dtype=operator.dtype)

    def traces(_: Case, operator: MeteredOperator, seed: int, method: str, budget: int) -> list[Answer]:
        answers = []
        for name in operator.blocks:
            block = wrapped(RestrictedOperator(operator, name))
            found = module.trace(block, num_matvecs=budget, method=method, seed=seed)
            answers.append(Answer(name, found.estimate, found.stderr))
        return answers

    def each_end(_: Case, operator: MeteredOperator, seed: int, steps: int) -> list[Answer]:
        answers, most = [], min(steps, operator.dim)
        for part, which in ENDS.items():
            found = module.lanczos(wrapped(operator), k=1, max_iter=most, which=which, seed=seed)
            answers.append(Answer(part, float(found.eigenvalues[0]), float(found.residuals[0])))
        return answers

    def one_run(_: Case, operator: MeteredOperator, seed: int, steps: int) -> list[Answer]:
        most = min(steps, operator.dim)
        found = module.lanczos(wrapped(operator), k=most, max_iter=most, which="LA", seed=seed)
        ends = {"largest": 0, "smallest": -1}
        return [Answer(part, float(found.eigenvalues[i]), float(found.residuals[i])) for part, i in ends.items()]

    def power(_: Case, operator: MeteredOperator, seed: int, steps: int) -> list[Answer]:
        first = module.power_iteration_one(wrapped(operator), max_iter=steps, seed=seed)[0]
        return _ordered(
            first, first + module.power_iteration_one(wrapped(operator, first), max_iter=steps, seed=seed)[0]
        )

    def sums(_: Case, operator: MeteredOperator, seed: int, starts: int, steps: int) -> list[Answer]:
        # its start vectors have consecutive seeds: those of two runs must not overlap
        options = {"num_runs": starts, "lanczos_steps": steps, "num_grid_points": 2, "seed": 1000 * seed}
        found = module.spectral_density(wrapped(operator), **options)
        kept = found.raw_weights > 0
        values, weights = found.raw_eigenvalues[kept].double(), found.raw_weights[kept].double() / starts
        total, squares = float((weights * values.abs()).sum()), float((weights * values.square()).sum())
        return [
            Answer("sum of |lambda|", operator.dim * total),
            Answer("participation ratio", operator.dim * total**2 / squares),
        ]

    for budget, (method, name) in product(budgets, {"hutchinson": "Hutchinson", "hutch++": "Hutch++"}.items()):
        run = partial(traces, method=method, budget=budget)
        yield _method("traces", f"hessian-eigenthings {name}", f"{budget} matvecs", run, ALIKE[name])
    for steps, (name, run) in product(STEPS, {"a run an end": each_end, "all Ritz pairs": one_run}.items()):
        yield _method("ends", f"hessian-eigenthings Lanczos, {name}", f"{steps} steps", partial(run, steps=steps))
    for steps in POWER_STEPS:
        run = partial(power, steps=steps)
        yield _method("ends", "hessian-eigenthings power iteration", f"{steps} steps an end", run)
    for starts, steps in (*DENSITIES, (6, 32)):
        run = partial(sums, starts=starts, steps=steps)
        yield _method("sums", "hessian-eigenthings quadrature", f"{starts} x {steps}", run)
