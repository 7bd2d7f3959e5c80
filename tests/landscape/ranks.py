"""Runs a function on gloo ranks, each a process of its own, a fork, that meet at a file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch.multiprocessing.spawn import start_processes

from landscape.operators.distributed import Ranks
from tests.forks import processes

Findings = dict[str, Any]


def on_ranks(size: int, folder: Path, work: Callable[[Ranks], Findings]) -> list[Findings]:
    """What work(ranks) returned on every rank."""
    processes()
    start_processes(_process, (size, str(folder), work), nprocs=size, start_method="forkserver")
    return [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in range(size)]


def _process(rank: int, size: int, folder: str, work: Callable[[Ranks], Findings]) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=size)
    dist.barrier()  # a process that leaves at once would cut others off that are still connecting
    torch.save(work(Ranks.joined()), f"{folder}/{rank}.pt")
    dist.destroy_process_group()
