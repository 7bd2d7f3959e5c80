"""Where a scene is worked on: the CPU, by kernels in Numba, or an NVIDIA GPU, by kernels in Triton.

Parameters, images and probe vectors are tensors on that device, and the device of the parameters decides which kernels run.
Cameras, colours of backgrounds and generators of random numbers may stay on the CPU.  Of the processes that torchrun starts on
one machine each has a GPU of its own.
"""

import os
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from typing import Literal

import torch

from landscape.errors import InputError


def device_named(name: Literal["auto", "cpu", "cuda"]) -> torch.device:
    """This process's device; auto: its GPU where it can be used, else the CPU.  ValueError where cuda is asked for and cannot
    be used."""
    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"expected the device 'auto', 'cpu' or 'cuda', got {name!r}")
    if name == "cpu":
        return torch.device("cpu")
    lack = _lack() or too_few(os.environ, torch.cuda.device_count())
    if name == "cuda" and lack:
        raise InputError(f"expected an NVIDIA GPU for the device cuda, got {lack}, or use the device cpu")
    if lack:
        return torch.device("cpu")
    import_module("splat.gpu")  # registers its kernels; the one place that names it
    return torch.device("cuda", place(os.environ))


def place(environment: Mapping[str, str]) -> int:
    """Which of its machine's processes this one is, and so which of its GPUs it has: torchrun says so.

    >>> place({}), place({"LOCAL_RANK": "3"})
    (0, 3)
    """
    return int(environment.get("LOCAL_RANK", 0))


def too_few(environment: Mapping[str, str], gpus: int) -> str | None:
    """What is missing where a machine's processes are more than its GPUs, and what to do about it; the same in all of them.

    >>> too_few({}, 1), too_few({"LOCAL_WORLD_SIZE": "2"}, 2)
    (None, None)
    >>> too_few({"LOCAL_WORLD_SIZE": "4"}, 2)
    '2 for the 4 processes of this machine; start torchrun with --nproc-per-node 2'
    """
    processes = int(environment.get("LOCAL_WORLD_SIZE", 1))
    if processes <= gpus:
        return None
    return f"{gpus} for the {processes} processes of this machine; start torchrun with --nproc-per-node {gpus}"


def _lack() -> str | None:
    """What is missing for work on a GPU, and what to do about it."""
    if torch.version.cuda is None:
        return f"torch {torch.__version__}, which was built without CUDA; install torch's CUDA build"
    if not torch.cuda.is_available():
        return "none that torch can use; look whether nvidia-smi lists one and its driver is new enough"
    if find_spec("triton") is None:
        return "no triton to compile its kernels; pip install -e '.[gpu]'"
    return None
