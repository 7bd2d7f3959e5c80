"""The landscape along somebody else's training, as a table that `landscape trajectory` reads.

    monitor = Monitor("runs/theirs", every=500)
    for step in range(1, 30_001):
        ...                                            # their step
        monitor(step, lambda: RendererHessian(...))    # called at steps that are recorded alone

The columns are those of `landscape train --probe-every`.  Traces are those of Gauss-Newton, by backward passes alone; the ends
are of the Hessian, with the errors of its products; indices are left empty.
"""

import os
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import torch

from landscape.eigen.approximate import renderer_eigenpairs
from landscape.eigen.ritz import EigenSettings
from landscape.errors import InputError
from landscape.operators.renderer.renderer import RendererHessian
from landscape.traces.pixels import gauss_newton_traces

ATTRIBUTES = ("means", "log_scales", "quats", "opacity_logits", "sh")
INDICES = ("eigenvalue_ratio", "negative_ratio", "top_mass", "participation_ratio")
COLUMNS = (
    "step", "gaussians", "state", "note", "seconds", "visible_gaussians", "parameters", "matvecs",
    *(f"trace_{name}{key}" for name in ATTRIBUTES for key in ("", "_error", "_low", "_high", "_dim", "_reason")),
    *(f"lambda_{end}{key}" for end in ("max", "min") for key in ("", "_error", "_reason")),
    *(f"{index}{key}" for index in INDICES for key in ("", "_low", "_high")),
)  # fmt: skip
"""Those of `landscape train --probe-every`; blocks of other names follow them."""


class Monitor:
    """Records of a renderer's landscape every so many steps, in FOLDER/trajectory.csv, which is rewritten after each."""

    def __init__(
        self,
        folder: str | Path,
        every: int = 500,
        samples: int = 16,
        eigen: EigenSettings = EigenSettings(rtol=1e-2, max_matvecs=60),
        seed: int = 0,
    ) -> None:
        if every < 1:
            raise InputError(f"expected a record every step or more, got every {every} steps")
        self.path, self.every, self.samples = Path(folder) / "trajectory.csv", every, samples
        self.eigen, self.seed, self.rows = eigen, seed, []
        if self.path.exists():
            raise InputError(f"expected a folder without a trajectory, got {self.path}; name another one")
        self.path.parent.mkdir(parents=True, exist_ok=True)

    def __call__(self, step: int, hessian: RendererHessian | Callable[[], RendererHessian]) -> bool:
        """Record this step where it is one of those; returns whether it was.

        What the renderer or its noise refuse becomes the note of a skipped record: the training goes on.
        """
        if step % self.every:
            return False
        start = perf_counter()
        row: dict[str, Any] = {"step": step, "gaussians": 0, "state": "skipped"}
        try:
            at = hessian if isinstance(hessian, RendererHessian) else hessian()
            row |= {"gaussians": len(at.parameters.tensors[0]), "parameters": at.dim}
            row |= self._measured(at, step) | {"state": "coarse", "note": "Gauss-Newton's traces"}
        except InputError as error:
            row["note"] = str(error)
        row["seconds"] = perf_counter() - start
        self.rows.append(row)
        self._write()
        return True

    def _measured(self, hessian: RendererHessian, step: int) -> dict[str, Any]:
        generator = torch.Generator(hessian.parameters.device).manual_seed(self.seed + step)
        row: dict[str, Any] = {}
        for name, found in gauss_newton_traces(hessian, generator, self.samples).items():
            row |= found.columns(f"trace_{name}")
        ends = renderer_eigenpairs(hessian, generator, self.eigen)
        return (
            row | ends.largest.columns("lambda_max") | ends.smallest.columns("lambda_min") | {"matvecs": ends.matvecs}
        )

    def _write(self) -> None:
        """Write all rows to a file beside the table, then put it in its place."""
        import pandas as pd  # slow to import

        names = dict.fromkeys((*COLUMNS, *(name for row in self.rows for name in row)))
        partial = self.path.with_suffix(".partial")
        pd.DataFrame(self.rows, columns=list(names)).to_csv(partial, index=False)
        os.replace(partial, self.path)
