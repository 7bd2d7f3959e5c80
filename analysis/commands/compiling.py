"""A line that says why nothing happens: the CPU's kernels are being compiled."""

from collections.abc import Iterator
from contextlib import contextmanager

from numba.core import event
from rich.console import Console

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
