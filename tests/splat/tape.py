"""What a CUDA graph takes of a product, on the CPU: its operations and kernels with their memory, to be repeated there.

As on a GPU, whatever waits for the device is refused, and a replay knows nothing but that memory: what a product takes from the
host while it is recorded, it has for ever.
"""

from collections.abc import Callable
from typing import Any

import pytest
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves

from tests.splat.placed import KERNELS, waits_for_values


class Tape(TorchDispatchMode):
    """`capture` is a `recording.Capture`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        super().__init__()
        self._steps: list[Callable[[], Any]] = []
        self._running = False
        self.replays = 0
        for name in KERNELS:
            module = pytest.importorskip(f"splat.{name}")
            monkeypatch.setattr(module, "launch", self._launch(module.launch))

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

    def _launch(self, original: Callable) -> Callable:
        def launch(*arguments: Any, **constants: Any) -> None:
            with _disable_current_modes():
                original(*arguments, **constants)
            if self._running:
                self._steps.append(lambda: original(*arguments, **constants))

        return launch
