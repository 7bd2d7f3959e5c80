"""Tensors on the CPU treated as if they were on a GPU: notes operations that would fail there or wait for the device.

Every storage has a label, which results inherit from what they are computed from:

    GPU      put there by `on_gpu`, or made like a tensor that is there
    EITHER   made on a device that is named: the device of a fake GPU's tensor is the CPU, so the name does not tell
    HOST     anything else

and three counters note operations by name:

    mixed    operations on GPU and HOST, kernels' arguments and numpy() on the wrong side; not what torch allows: copies,
             single numbers, indices on the host
    waits    numbers that the host reads, sizes that depend on values, copies that block, indices that come from the host
    brought  copies from the host, whether or not they block
"""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves

from splat.gpu.language.compile import Kernel

GPU, EITHER, HOST = "gpu", "either", "host"
READS = {"_local_scalar_dense", "nonzero", "unique_dim", "_unique2", "masked_select", "equal"}
INDEXED = {"index", "index_put", "index_put_"}
ACROSS = {"copy_", "_to_copy", *INDEXED}


def waits_for_values(func: Any, args: Any) -> bool:
    """Whether an operation on a GPU's tensors waits for it: it gives a number, or a tensor whose size depends on values."""
    name = func._schema.name.removeprefix("aten::")
    return name in READS or (name in INDEXED and any(each is not None and each.dtype == torch.bool for each in args[1]))


class _Named(TorchFunctionMode):
    """Notes whether the torch function called last was given a device (the functions below it always are)."""

    found = False

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.found = (kwargs or {}).get("device") is not None
        return func(*args, **(kwargs or {}))


class FakeDevice(TorchDispatchMode):
    """Counts while it is entered: `mixed`, `waits` and `brought`, see above."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        super().__init__()
        self.mixed, self.waits, self.brought = Counter[str](), Counter[str](), Counter[str]()
        self._labels: dict[int, str] = {}
        self._kept: list[Any] = []  # storages, so that no new one gets the address of a freed one
        self._within, self._named = False, _Named()
        for name in ("to", "cpu", "numpy", "new_tensor"):
            monkeypatch.setattr(Tensor, name, self._method(getattr(self, f"_{name}"), getattr(Tensor, name)))
        monkeypatch.setattr(Kernel, "run", self._run(Kernel.run))

    def __enter__(self) -> "FakeDevice":
        self._named.__enter__()
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._named.__exit__(*error)

    def on_gpu(self, tensor: Tensor) -> Tensor:
        return self._marked(tensor.clone(), GPU)

    def _label(self, tensor: Tensor) -> str | None:
        return self._labels.get(tensor.untyped_storage()._cdata)

    def _marked(self, tensor: Tensor, label: str) -> Tensor:
        self._kept.append(tensor.untyped_storage())
        self._labels[tensor.untyped_storage()._cdata] = label
        return tensor

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, name = kwargs or {}, func._schema.name.removeprefix("aten::")
        inputs = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        labels = {self._label(each) for each in inputs}
        arrays = {self._label(each) for each in inputs if each.dim()}
        put = name in INDEXED and len(args) > 2 and args[2].dim() and self._label(args[2]) == HOST
        if GPU in labels and HOST in arrays and (put or name not in ACROSS):
            self.mixed[name] += 1
        there = labels & {GPU, EITHER}
        brought = there and name in INDEXED and HOST in {self._label(each) for each in args[1] if each is not None}
        if brought or (there and waits_for_values(func, args)):
            self.waits[name] += 1
        if brought or (name == "copy_" and self._label(args[0]) == GPU and self._label(args[1]) == HOST):
            self.brought[name] += 1
        made = func(*args, **kwargs)
        # in a backward pass functions are not seen
        unknown = self._named.found or torch._C._current_graph_task_id() >= 0
        by_name = EITHER if EITHER in labels or (not inputs and unknown) else HOST
        for each in tree_leaves(made):
            if isinstance(each, Tensor) and self._label(each) is None:
                self._marked(each, GPU if GPU in labels else by_name)
        return made

    def _method(self, own: Callable, original: Callable) -> Callable:
        def method(tensor: Tensor, *args: Any, **kwargs: Any) -> Any:
            if self._within or tensor.requires_grad:
                return original(tensor, *args, **kwargs)
            with self._quietly():
                made = original(tensor, *args, **kwargs)
            return own(tensor, made, args, kwargs)

        return method

    @contextmanager
    def _quietly(self) -> Iterator[None]:
        self._within = True
        try:
            yield
        finally:
            self._within = False

    def _to(self, tensor: Tensor, made: Tensor, args: tuple, kwargs: dict) -> Tensor:
        like = next((each for each in args if isinstance(each, Tensor)), None)
        named = any(isinstance(each, torch.device | str) for each in (*args, kwargs.get("device")))
        target = EITHER if like is None and named else None if like is None else self._label(like)
        if target is None or target == self._label(made):
            return made
        if target == GPU:
            self.brought["to"] += 1
            self.waits["to"] += not kwargs.get("non_blocking")
        return self._moved(made, target)

    def _moved(self, tensor: Tensor, label: str) -> Tensor:
        with _disable_current_modes():
            return self._marked(tensor.clone(), label)

    def _cpu(self, tensor: Tensor, made: Tensor, args: tuple, kwargs: dict) -> Tensor:
        self.waits["cpu"] += self._label(tensor) != HOST
        return self._moved(made, HOST)

    def _numpy(self, tensor: Tensor, made: Any, args: tuple, kwargs: dict) -> Any:
        self.mixed["numpy"] += self._label(tensor) == GPU
        return made

    def _new_tensor(self, tensor: Tensor, made: Tensor, args: tuple, kwargs: dict) -> Tensor:
        self.waits["new_tensor"] += self._label(tensor) == GPU
        self.brought["new_tensor"] += self._label(tensor) == GPU
        return self._moved(made, self._label(tensor) or HOST)

    def _run(self, original: Callable) -> Callable:
        def run(kernel: Any, *arguments: Any, **options: Any) -> Any:
            tensors = [each for each in arguments if isinstance(each, Tensor) and each.numel()]
            self.mixed[kernel.fn.__name__] += sum(self._label(each) == HOST for each in tensors)
            with self._quietly(), _disable_current_modes():
                return original(kernel, *arguments, **options)

        return run
