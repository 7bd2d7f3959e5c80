"""The CPU's kernels are compiled: a line that says why nothing happens, and a process that does a part meanwhile."""

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import torch
from numba.core import config, event, registry
from rich.console import Console

from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.projection.formulas import lens_of
from splat.render.backend import CPU, plain_gradient
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene

SAID = "compiling kernels for this processor: seconds for one, up to two minutes for all; later runs find them"


class _Once(event.Listener):
    def __init__(self, console: Console) -> None:
        self.console, self.said = console, False

    def on_start(self, event: event.Event) -> None:
        if not self.said:
            self.said = True
            self.console.print(SAID, style="dim", soft_wrap=True)

    def on_end(self, event: event.Event) -> None: ...


@contextmanager
def compiling_is_said(console: Console) -> Iterator[None]:
    """Say it when the first kernel is compiled that an earlier run has not kept."""
    with event.install_listener("numba:compile", _Once(console)):
        yield


def compile_ahead() -> None:
    """Fork what compiles a probe's kernels, once in a cache, where a processor is left for it; it ends with this process."""
    done, parent = f"{config.CACHE_DIR}/of-a-probe", os.getpid()  # pyright: ignore[reportAttributeAccessIssue]
    with suppress(OSError, AttributeError):  # no room for a process; not Linux.  Commands on a GPU need few kernels
        wanted = len(os.sched_getaffinity(0)) > 1 and not os.path.exists(done) and not torch.cuda.is_available()
        if not wanted:
            return
        context: Any = registry.cpu_target.target_context
        context.refresh()  # what Numba does once, before its first compilation
        if os.fork():
            return
        try:
            ctypes.CDLL(None).prctl(1, 9)  # PR_SET_PDEATHSIG, SIGKILL
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            if os.getppid() == parent:
                call_what_a_probe_calls()
                os.open(done, os.O_CREAT)
        finally:
            os._exit(0)


def call_what_a_probe_calls() -> None:
    """On a few Gaussians; first, in double precision, what a command that begins with a training needs last."""
    torch.set_num_threads(1)
    loss = CPU.view_loss(image := torch.rand(3, 12, 16, dtype=torch.float64), LossSettings(), image)
    gradient = loss.linearize(loss.padded(image)).gradient
    made = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12))
    objective = SceneObjective(made.truth, [view := made.scene.load()[0]], keep_unseen=True)
    splats, depths, drawn = CPU.project(made.truth, lens_of(view.camera, objective.settings))
    raster = CPU.rasterize(splats, depths.double(), drawn, splats[0, :3], 16, 12, objective.settings)
    plain_gradient(splats, raster.backward(gradient).moments)
    objective.block_diagonals(approximate=True)
    objective.linearized.first.loss_curvatures(vector := torch.ones_like(made.truth.flat)[:, None])
    SceneHessian(objective).apply(vector)
    objective.loss(made.truth.flat)
