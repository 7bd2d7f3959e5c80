"""A CUDA graph on the CPU: records a product's torch operations and kernel launches with their memory, and repeats them.

As on a GPU, an operation that waits for the device is refused while recording, and a replay reads only the memory that was
recorded: numbers taken from the host are constants of the graph.
"""

from collections.abc import Callable
from typing import Any

import pytest
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves

from splat.gpu.language.compile import Kernel
from tests.splat.gpu.fake_device import waits_for_values


class FakeCudaGraph(TorchDispatchMode):
    """`capture` is a `Capture` of `backend/graphs.py`; replays: how often its graphs were repeated."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        super().__init__()
        self._steps: list[Callable[[], Any]] = []
        self._running = False
        self.replays = 0
        monkeypatch.setattr(Kernel, "run", self._run(Kernel.run))

    def capture(self, call: Callable[[], Tensor]) -> tuple[Tensor, Callable[[], None]]:
        self._steps, self._running = [], True
        try:
            with self:
                result = call()
        finally:
            self._running = False
        steps = self._steps

        def replay() -> None:
            self.replays += 1
            for step in steps:
                step()

        return result, replay

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if waits_for_values(func, args):
            raise RuntimeError(f"operation not permitted when stream is capturing: {func}")
        given = {each.untyped_storage()._cdata for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)}
        made = func(*args, **kwargs)
        new = [isinstance(each, Tensor) and each.untyped_storage()._cdata not in given for each in tree_leaves(made)]

        def step() -> None:
            again = tree_leaves(func(*args, **kwargs))
            for old, fresh, own in zip(tree_leaves(made), again, new, strict=True):
                if own:
                    old.copy_(fresh)

        self._steps.append(step)
        return made

    def _run(self, original: Callable) -> Callable:
        def run(*arguments: Any, **options: Any) -> Any:
            if self._running:
                self._steps.append(lambda: original(*arguments, **options))
            with _disable_current_modes():
                return original(*arguments, **options)

        return run
