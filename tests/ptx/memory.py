"""A GPU's memory: that of tensors of the CPU, at their own addresses, and what goes wrong there without a word.

Every access is looked at: whether it stays within one tensor's memory and at its own alignment, and whether within a launch
one block of threads reads or writes what another one writes, which no barrier orders.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

Array = np.ndarray
NOBODY, SEVERAL, ATOMICALLY = (
    0,
    -1,
    -2,
)  # who last wrote or read a number; else the number of a block of threads, from 1


class Fault(RuntimeError):
    """What a GPU would stop at, or not notice."""


class Span:
    """The memory of a tensor, its bytes, and who read and wrote each of its numbers in this launch."""

    def __init__(self, tensor: Tensor):
        storage = tensor.untyped_storage()
        flat = tensor.new_empty(0).set_(storage)  # pyright: ignore[reportArgumentType]
        self.bytes = flat.numpy().view(np.uint8)
        self.start, self.stop, self.item = storage.data_ptr(), storage.data_ptr() + len(self.bytes), tensor.itemsize
        self.writer, self.reader = (np.zeros(len(flat), np.int32) for _ in range(2))

    def numbers(self, offset: Array, size: int) -> list[Array]:
        """Which of the tensor's numbers an access touches."""
        first = offset // self.item
        return [first + k for k in range(max(1, size // self.item))]


class Memory:
    """What the arguments of a launch point to."""

    def __init__(self, tensors: Sequence[Tensor]):
        spans = {tensor.untyped_storage().data_ptr(): tensor for tensor in tensors if tensor.untyped_storage().nbytes()}
        self.spans = [Span(spans[address]) for address in sorted(spans)]
        self.starts = np.array([span.start for span in self.spans], np.uint64)

    def load(self, address: Array, kind: np.dtype, block: Array) -> Array:
        """The numbers at addresses; block: which one the threads are of."""
        span, offset = self._find(address, kind.itemsize)
        for number in span.numbers(offset, kind.itemsize):
            _allow(span.writer[number], (NOBODY,), block, "reads what another wrote")
            before = span.reader[number]
            span.reader[number] = np.where((before == NOBODY) | (before == block), block, SEVERAL)
        return span.bytes.view(kind)[offset // kind.itemsize]

    def store(self, address: Array, values: Array, block: Array) -> None:
        span, offset = self._find(address, values.itemsize)
        place, whole = offset // values.itemsize, span.bytes.view(values.dtype)
        whole[place] = values
        if not np.array_equal(whole[place].view(np.uint8), values.view(np.uint8)):
            raise Fault("two threads of a launch write different numbers to one place at once")
        for number in span.numbers(offset, values.itemsize):
            _allow(span.writer[number], (NOBODY,), block, "writes where another wrote")
            _allow(span.reader[number], (NOBODY,), block, "writes what another read")
            span.writer[number] = block
            _allow(span.writer[number], (), block, "writes where another wrote")

    def add(self, address: Array, values: Array) -> None:
        """Atomically, in the order of the threads."""
        span, offset = self._find(address, values.itemsize)
        for number in span.numbers(offset, values.itemsize):
            _allow(span.writer[number], (NOBODY, ATOMICALLY), NOBODY, "adds where another wrote")
            _allow(span.reader[number], (NOBODY,), NOBODY, "adds to what another read")
            span.writer[number] = ATOMICALLY
        np.add.at(span.bytes.view(values.dtype), offset // values.itemsize, values)

    def _find(self, address: Array, size: int) -> tuple[Span, Array]:
        lowest, highest = int(address.min()), int(address.max())
        index = int(np.searchsorted(self.starts, np.uint64(lowest), "right")) - 1
        span = self.spans[index] if index >= 0 else None
        if span is None or lowest < span.start or highest + size > span.stop:
            raise Fault(
                f"an access of {size} bytes outside of every argument, or across two: {lowest:#x} to {highest:#x}"
            )
        return span, (address - np.uint64(span.start)).astype(np.int64)


def _allow(found: Array, always: tuple[int, ...], block: Any, what: str) -> None:
    if not (np.isin(found, always) | (found == block)).all():
        raise Fault(f"a block of threads {what} in the same launch")
