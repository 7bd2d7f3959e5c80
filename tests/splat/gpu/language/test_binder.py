"""No launch of the GPU's path has a kernel compiled anew for another number of Gaussians or vectors, or size of images.

A driver that is none and a compiler that compiles nothing stand in: what Triton makes of the arguments is what is looked at.
"""

from collections import Counter
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from tests.splat.gpu.ahead_of_time import run_as_script, stand_in


def test_no_number_of_gaussians_or_vectors_and_no_size_compiles_a_kernel_anew() -> None:
    lines = [line.split() for line in run_as_script(__file__)]
    assert len(lines) == 31
    for name, few, more in lines:
        assert int(few) > 0, f"{name} was not launched"
        assert few == more, f"{name} was compiled anew for other numbers"


def compile_none() -> Counter[str]:
    """Have Triton launch nothing; counts how often each kernel would be compiled."""
    from triton.runtime.jit import JITFunction

    compiled = Counter[str]()

    def compile_nothing(kernel: Any, key: str, signature: dict, device: int, *_others: Any) -> Any:
        compiled[kernel.fn.__name__] += 1
        found = SimpleNamespace(function=None, packed_metadata=None, launch_metadata=lambda *_: None)
        found.run = lambda *arguments: one_each(kernel, arguments[-len(kernel.arg_names) :])
        kernel.device_caches[device][0][key] = found
        return found

    stand_in()
    JITFunction._do_compile = compile_nothing  # pyright: ignore[reportAttributeAccessIssue]
    return compiled


def one_each(kernel: Any, arguments: tuple) -> None:
    """What the host reads of the kernels' results: every splat has a strip, and every strip an entry."""
    if kernel.fn.__name__ in ("count_strips", "count_rows"):
        dict(zip(kernel.arg_names, arguments, strict=True))["count"].fill_(1)


def launch_all(n: int, m: int, K: int, size: tuple[int, int] = (30, 22)) -> None:
    """All kernels, for n Gaussians of which m are in sight, and K vectors; size: of the image."""
    from splat.curvature.linearize import LinearizedView
    from splat.gpu.adam import adam_step
    from splat.gpu.loss import CudaImageLoss
    from splat.gpu.raster.raster import CudaRaster
    from splat.losses.reference import LossSettings
    from splat.model.settings import RenderSettings
    from splat.render.backend import backend_of
    from splat.render.loss_and_gradient import loss_and_gradient
    from tests.splat.held_scenes import BACKGROUND, two_views
    from tests.splat.random_scenes import random_gaussians

    CudaRaster.touched = property(lambda _raster: torch.arange(m))  # pyright: ignore[reportAttributeAccessIssue]
    gaussians, view = random_gaussians(n, 1).to(torch.float32), two_views(*size)[0]
    flat, settings = gaussians.flat, LossSettings("charbonnier", 0.2)
    loss = backend_of(flat).view_loss(view.image, settings, flat)
    ordered, atomic = RenderSettings(accumulation="deterministic"), RenderSettings(accumulation="atomic")
    for render in (ordered, atomic):
        held = LinearizedView(gaussians, view.camera, loss, BACKGROUND.float(), render)
        held.hvp(flat.new_ones(len(flat), K))
        _ = held.gradient, held.block_diagonals(approximate=True), held.loss_curvatures(flat.new_ones(len(flat), K))
    loss_and_gradient(gaussians, view.camera, loss, BACKGROUND.float(), atomic)
    loss.value(view.image)
    CudaImageLoss(view.image, settings).consistency(view.image, view.image)
    adam_step(flat, flat, flat, flat.clone(), flat.clone(), 1)


def zeros(make: Any) -> Any:
    """Of a function that leaves memory as it is, since no kernel writes to it."""

    def made(*arguments: Any, **named: Any) -> Tensor:
        return make(*arguments, **named).zero_()

    return made


def kernels() -> list[str]:
    """The names of those that the test of the compiler knows."""
    from tests.splat.gpu.every_kernel import others, rasterizer

    return sorted({kernel.__name__ for kernel, *_ in rasterizer() + others()})


if __name__ == "__main__":
    from splat.gpu.backend import CUDA
    from splat.render.backend import BACKENDS

    BACKENDS["cpu"] = CUDA  # tensors on the CPU for the GPU's path
    torch.empty, torch.empty_like = zeros(torch.empty), zeros(torch.empty_like)
    Tensor.new_empty = zeros(Tensor.new_empty)
    compiled = compile_none()
    for vectors in (1, 2, 10):
        launch_all(37, 33, vectors)
    few = compiled.copy()
    for numbers in ((48, 33, 10), (37, 16, 10), (37, 33, 16)):
        launch_all(*numbers)
    launch_all(37, 33, 10, (32, 16))
    for name in kernels():
        print(name, few[name], compiled[name])
