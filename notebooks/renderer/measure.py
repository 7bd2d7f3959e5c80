"""Products, ends and traces through the bridge against the exact ones, as rows of one table.

products    of H with unit vectors: random over all parameters, over those of one attribute, the steepest eigenvector
  naive         (grad L(theta + h v) - grad L(theta - h v)) / 2h, as public tools compute it, at STEPS times the bridge's h
  split         `RendererHessian`;  gauss_newton: its `gauss_newton`, against the exact J^T l'' J
ends        lambda max by Lanczos runs on each of these, from a random start for each seed; naive at its best step
traces      of Gauss-Newton's blocks by `gauss_newton_traces`, with the first seed
cover       the same over seeds: how many intervals hold the exact trace

error       relative: of products the root mean square of |error| / |H v| over the vectors, of ends the worst of the seeds
stated      the error that the bridge states, of the same kind
within, of  how many of these were within what is stated
value, low, high, exact     of ends (the worst seed's) and traces
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import nan
from typing import Any

import torch
from torch import Tensor

from landscape import EigenSettings, RendererHessian, extreme_eigenpairs, gauss_newton_traces, renderer_eigenpairs
from notebooks.renderer.scenes import Scene, directions
from notebooks.renderer.surfels import Surfels

STEPS = (1e-4, 1e-2, 1e-1, 1.0, 1e1)
SPARSE = 2  # vectors of a kind for naive differences
TOP = EigenSettings(smallest=0, rtol=1e-3)
FEW = EigenSettings(smallest=0, rtol=1e-3, max_matvecs=60)

Row = dict[str, Any]


@dataclass(frozen=True)
class Sizes:
    """each: vectors of a kind; seeds: of Lanczos runs; samples: of traces; cover: seeds of traces."""

    each: int = 10
    seeds: int = 40
    samples: int = 32
    cover: int = 500


class Naive:
    """Central differences of the gradient of the loss as an operator; h: the step along a unit vector."""

    def __init__(self, hessian: RendererHessian, h: float):
        self.hessian, self.h, self.dim, self.dtype = hessian, h, hessian.dim, hessian.dtype
        self.blocks = hessian.blocks

    def apply(self, V: Tensor) -> Tensor:
        H, columns = self.hessian, []
        with H.parameters.restored() as here:
            for v in V.T:
                ends = []
                for step in (self.h, -self.h):
                    H.parameters.write(here.double() + step * v.double())
                    views = (H.linear(index) for index in range(len(H.views)))
                    ends.append(sum(H.parameters.vjp(each.image, each.gradient.detach()).double() for each in views))
                columns.append((ends[0] - ends[1]) / (2 * self.h) / len(H.views))
        return torch.stack(columns, dim=1).to(V.dtype)


def products(scene: Scene | Surfels, sizes: Sizes) -> Iterator[Row]:
    """Rows of all ways and directions."""
    H = scene.foreign()
    names, V = directions(H.blocks, H.dim, sizes.each)
    top = extreme_eigenpairs(scene.exact, torch.Generator().manual_seed(0), TOP).largest.vectors
    names, V = [*names, "steepest"], torch.cat([V, top], dim=1)
    rough = V.to(H.dtype)
    for way, operator, exact in (("split", H, scene.exact), ("gauss_newton", H.gauss_newton, scene.exact_gauss_newton)):
        truth, (found, stated) = exact.apply(V).clone(), operator.measured(rough)
        errors, told = (found.double() - truth).norm(dim=0), stated.total
        for name in dict.fromkeys(names):
            at = [index for index, each in enumerate(names) if each == name]
            yield {
                "way": way, "direction": name, "step": 1.0,
                "error": rms(errors[at] / truth[:, at].norm(dim=0)), "stated": rms(told[at] / truth[:, at].norm(dim=0)),
                "within": int((errors[at] <= told[at]).sum()), "of": len(at),
            }  # fmt: skip
    for name in dict.fromkeys(names):
        at = [index for index, each in enumerate(names) if each == name][:SPARSE]
        truth, h = scene.exact.apply(V[:, at]), H.products(rough[:, at])[2]
        for step in STEPS:
            found = [Naive(H, step * float(each)).apply(rough[:, [k]]) for k, each in zip(at, h, strict=True)]
            errors = (torch.cat(found, dim=1).double() - truth).norm(dim=0) / truth.norm(dim=0)
            yield {"way": "naive", "direction": name, "step": step, "error": rms(errors)}


def ends(scene: Scene | Surfels, sizes: Sizes, best: float) -> Iterator[Row]:
    """lambda max by every way.  best: the step of naive differences over the bridge's."""
    H = scene.foreign()
    exact = {
        way: float(extreme_eigenpairs(operator, torch.Generator().manual_seed(0), TOP).largest.values[0])
        for way, operator in (("split", scene.exact), ("gauss_newton", scene.exact_gauss_newton))
    }
    for way, operator in (("split", H), ("gauss_newton", H.gauss_newton)):
        runs = [
            renderer_eigenpairs(operator, torch.Generator().manual_seed(seed), FEW).largest
            for seed in range(sizes.seeds)
        ]
        found = [(float(run.values[0]), float(run.residuals[0])) for run in runs]
        value, residual = max(found, key=lambda pair: abs(pair[0] - exact[way]))
        yield {
            "way": way, "value": value, "exact": exact[way], "error": abs(value / exact[way] - 1),
            "stated": residual / exact[way],
            "within": sum(abs(value - exact[way]) <= error for value, error in found), "of": len(found),
        }  # fmt: skip
    _, v = directions({}, H.dim, 1)
    naive = Naive(H, best * float(H.products(v.to(H.dtype))[2]))
    value = float(extreme_eigenpairs(naive, torch.Generator().manual_seed(0), FEW).largest.values[0])
    yield {
        "way": "naive",
        "step": best,
        "value": value,
        "exact": exact["split"],
        "error": abs(value / exact["split"] - 1),
    }


def traces(scene: Scene | Surfels, sizes: Sizes) -> Iterator[Row]:
    """The traces with the first seed, and how many intervals of all seeds hold the exact ones."""
    H = scene.foreign()
    held = dict.fromkeys(H.blocks, 0)
    for seed in range(max(sizes.cover, 1)):
        found = gauss_newton_traces(H, torch.Generator().manual_seed(seed), sizes.samples)
        for name, (exact, half) in scene.traces.items():
            inside = found[name].low - half <= exact <= found[name].high + half
            held[name] += inside
            if seed == 0:
                yield {
                    "part": "traces", "way": "pixels", "direction": name, "value": found[name].value,
                    "low": found[name].low, "high": found[name].high, "exact": exact, "within": int(inside), "of": 1,
                    "error": abs(found[name].value / exact - 1), "stated": found[name].half_width / exact,
                }  # fmt: skip
    if sizes.cover:
        for name, count in held.items():
            yield {"part": "cover", "way": "pixels", "direction": name, "within": count, "of": sizes.cover}


def rms(values: Tensor) -> float:
    return float(values.double().square().mean().sqrt())


def best_step(rows: Sequence[Row]) -> float:
    """The step of naive differences with the least error along random vectors."""
    naive = [row for row in rows if row["way"] == "naive" and row["direction"] == "random"]
    return min(naive, key=lambda row: row["error"], default={"step": nan})["step"]
