"""The landscape along somebody else's training, as a table that `landscape trajectory` reads.

    monitor = Monitor("runs/theirs", every=500)
    for step in range(1, 30_001):
        ...                                            # their step
        monitor(step, lambda: RendererHessian(...))    # called at steps that are recorded alone

Traces are those of Gauss-Newton, by backward passes alone; eigenvalues have the errors of products; indices are left empty.
"""

import os
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import torch

from landscape.eigen.eigen import renderer_eigenpairs
from landscape.eigen.ritz import EigenSettings
from landscape.errors import InputError
from landscape.operators.renderer import RendererHessian
from landscape.traces.pixels import gauss_newton_traces

FEW = EigenSettings(rtol=1e-2, max_matvecs=60)
ATTRIBUTES = ("means", "log_scales", "quats", "opacity_logits", "sh")
INDICES = ("eigenvalue_ratio", "negative_ratio", "top_mass", "participation_ratio")
COLUMNS = (  # those of `landscape train --probe-every`; blocks of other names follow them
    "step", "gaussians", "state", "note", "seconds", "visible_gaussians", "parameters", "matvecs",
    *(f"trace_{name}{key}" for name in ATTRIBUTES for key in ("", "_error", "_low", "_high", "_dim", "_reason")),
    *(f"lambda_{end}{key}" for end in ("max", "min") for key in ("", "_error", "_reason")),
    *(f"{index}{key}" for index in INDICES for key in ("", "_low", "_high")),
)  # fmt: skip


class Monitor:
    """Records of a renderer's landscape every so many steps, in FOLDER/trajectory.csv, which is rewritten after each."""

    def __init__(
        self, folder: str | Path, every: int = 500, samples: int = 16, eigen: EigenSettings = FEW, seed: int = 0
    ) -> None:
        self.path, self.every, self.samples = Path(folder) / "trajectory.csv", every, samples
        self.eigen, self.seed, self.rows = eigen, seed, []
        if every < 1:
            raise InputError(f"expected a record every step or more, got every {every} steps")
        if self.path.exists():
            raise InputError(f"expected a folder without a trajectory, got {self.path}; name another one")
        self.path.parent.mkdir(parents=True, exist_ok=True)

    def __call__(self, step: int, hessian: RendererHessian | Callable[[], RendererHessian]) -> bool:
        """Record this step if it is one of those; returns whether it is.  A refusal becomes the note of a skipped record."""
        if step % self.every:
            return False
        import pandas as pd  # slow to import

        start = perf_counter()
        row = dict.fromkeys(COLUMNS) | {"step": step, "gaussians": 0, "state": "skipped"}
        try:
            at = hessian if isinstance(hessian, RendererHessian) else hessian()
            row |= {"gaussians": len(at.parameters.tensors[0]), "parameters": at.dim}
            generator = torch.Generator(at.point.device).manual_seed(self.seed + step)
            traces = gauss_newton_traces(at, generator, self.samples)
            ends = renderer_eigenpairs(at, generator, self.eigen)
            row |= {"matvecs": ends.matvecs, "state": "coarse", "note": "Gauss-Newton's traces"}
            row |= ends.largest.columns("lambda_max") | ends.smallest.columns("lambda_min")
            for name, found in traces.items():
                row |= found.columns(f"trace_{name}")
        except InputError as error:
            row["note"] = str(error)
        self.rows.append(row | {"seconds": perf_counter() - start})
        pd.DataFrame(self.rows).to_csv(partial := self.path.with_suffix(".partial"), index=False)
        os.replace(partial, self.path)
        return True
