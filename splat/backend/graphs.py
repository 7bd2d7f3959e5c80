"""Products as CUDA graphs: the kernel launches of a product, recorded once and sent to the GPU again as one.

A product launches some fourteen kernels a view, and where a scene is small each launch takes the host longer than the device.
A graph repeats them on other vectors: the same kernels in the same order and memory, so the same result to the last bit.
While it is recorded a function must not wait for the device or take numbers from the host, and what it reads must stay where
it is.

The graphs of one function share the memory of the largest: the result of a replay is copied out at once, and none reads what
another has written.
"""

import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

CALLS = 3  # with the same number of vectors before they are recorded: to record takes about as long as two calls
Product = Callable[[Tensor], Tensor]
Capture = Callable[[Callable[[], Tensor]], tuple[Tensor, Callable[[], None]]]


@dataclass(frozen=True, eq=False)
class _Recording:
    """A recorded call; replay() reads argument and writes result."""

    argument: Tensor
    result: Tensor
    replay: Callable[[], None]

    def __call__(self, V: Tensor) -> Tensor:
        self.argument.copy_(V)
        self.replay()
        return self.result.clone()


class CudaGraphCache:
    """The graphs of one function of blocks of vectors (p, k): one for every k, made at call number CALLS with that k.

    capture: runs a call without arguments, and returns its result and a function that repeats its launches.  Where it fails, a
    warning says so, and the function itself is called from then on.
    """

    def __init__(self, capture: Capture):
        self._capture = capture
        self._calls, self._made = Counter[int](), dict[int, _Recording]()
        self._failed = False

    def __call__(self, function: Product, V: Float[Tensor, "p k"]) -> Float[Tensor, "p k"]:
        """function(V); the same function at every call.  It is not stored, which would keep its owner and GPU memory alive."""
        vectors = V.shape[1]
        self._calls[vectors] += 1
        if self._calls[vectors] >= CALLS and vectors not in self._made and not self._failed:
            self._record(function, V)
        return self._made.get(vectors, function)(V)

    def _record(self, function: Product, V: Tensor) -> None:
        argument = V.clone(memory_format=torch.contiguous_format)
        function(argument)  # compiles its kernels, which must not happen during a capture
        try:
            result, replay = self._capture(lambda: function(argument))
        except RuntimeError as error:
            self._failed = True
            warnings.warn(f"products are launched kernel by kernel: they could not be recorded ({error})", stacklevel=4)
        else:
            self._made[V.shape[1]] = _Recording(argument, result, replay)


class CudaGraphs:
    """A `Capture` by a GPU."""

    def __init__(self, device: torch.device):
        self._device = device
        self._stream = torch.cuda.Stream(device)  # memory is shared between captures on one stream
        self._graphs: list[torch.cuda.CUDAGraph] = []

    def __call__(self, call: Callable[[], Tensor]) -> tuple[Tensor, Callable[[], None]]:
        graph = torch.cuda.CUDAGraph()
        pool = self._graphs[0].pool() if self._graphs else None
        # other threads may go on allocating; and this stream is left also where ending the capture fails
        recording = torch.cuda.graph(graph, pool, self._stream, capture_error_mode="thread_local")
        with torch.cuda.device(self._device), torch.cuda.stream(self._stream), recording:
            result = call()
        self._graphs.append(graph)
        return result, graph.replay
