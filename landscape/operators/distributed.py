"""Sums of operators over processes: H V = sum_r H_r V, where rank r has the terms H_r and an all-reduce adds the products.

    torchrun --nproc-per-node 2 study.py                     # in it, on every rank alike:
    torch.distributed.init_process_group("gloo")             # "nccl" for ranks with a GPU each, made current before
    ranks = Ranks.joined()
    H = DistributedOperator(SumOperator([term_of(view) for view in ranks.share(views)]), ranks)
    estimate_traces(H, torch.Generator().manual_seed(0))     # the same numbers on every rank

Every rank runs the same estimator with the same seed.  An all-reduce gives the same bits to all ranks, so all take the same
steps.  The numbers are those of one process up to the order of the sum.  Time budgets must stay infinite, because clocks differ
between ranks.  Before each product the ranks compare a checksum of their vectors; all raise an error where these differ.  When
a process fails, the next exchange of every other process raises ConnectionError.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import TypeVar

import torch
import torch.distributed as dist
from jaxtyping import Float, Shaped
from torch import Tensor

from landscape.errors import InputError
from landscape.operators.operator import SymmetricOperator, require_vectors

Item = TypeVar("Item")


@dataclass(frozen=True)
class Ranks:
    """The `size` processes of torch's default group, seen from the process of number `rank` (from 0).

    Every method except `share` is collective: all processes have to call it, in the same order.  device: where tensors are
    exchanged; results return to the device of the argument.  A single rank exchanges nothing and needs no group: `ALONE`.
    """

    rank: int
    size: int
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @classmethod
    def joined(cls) -> "Ranks":
        """The default group, which this process has joined.  Raises InputError where none is initialised."""
        if not (dist.is_available() and dist.is_initialized()):
            raise InputError(
                "expected an initialised process group, got none; start with torchrun and call "
                'torch.distributed.init_process_group("gloo") first ("nccl" on GPUs)'
            )
        on_gpu = dist.get_backend() == "nccl"  # exchanges tensors on GPUs only
        device = torch.device("cuda", torch.cuda.current_device()) if on_gpu else torch.device("cpu")
        return cls(dist.get_rank(), dist.get_world_size(), device)

    def share(self, items: Sequence[Item], name: str = "item") -> Sequence[Item]:
        """This rank's part of the items.  The parts of all ranks, one after the other, are the items in order.

        Raises InputError where there are fewer items than ranks.  name: what the message calls an item.

        >>> Ranks(0, 2).share("abcde"), Ranks(1, 2).share("abcde")
        ('ab', 'cde')
        """
        if len(items) < self.size:
            raise InputError(
                f"expected at least one {name} for each of {self.size} ranks, got {len(items)}; start fewer processes"
            )
        return items[self.rank * len(items) // self.size : (self.rank + 1) * len(items) // self.size]

    def sum(self, x: Shaped[Tensor, "..."]) -> Shaped[Tensor, "..."]:
        """The sum of x over ranks, with the same bits on each."""
        return self._reduced(x, dist.ReduceOp.SUM)

    def require_same(self, name: str, value: object) -> None:
        """Raise InputError on all ranks unless str(value) is the same on each."""
        if self.size == 1:
            return
        digest = int.from_bytes(blake2b(str(value).encode(), digest_size=8).digest(), "little", signed=True)
        if not self._agree(digest):
            raise InputError(f"expected the same {name} on every rank, got {value} on rank {self.rank} of {self.size}")

    def require_same_vectors(self, V: Float[Tensor, "n k"]) -> None:
        """Raise InputError on all ranks unless they have equally many vectors, with equal sums of the entries' bit patterns."""
        if self.size == 1:
            return
        bits = {2: torch.int16, 4: torch.int32, 8: torch.int64}[V.element_size()]
        fingerprint = int(V.contiguous().view(bits).sum(dtype=torch.int64))  # integers: exact in any order of addition
        if not self._agree(V.shape[1], fingerprint):
            raise InputError(
                f"expected the same vectors on every rank, got others on some (here {V.shape[1]}); seed the generators "
                "alike, and run on machines of one kind"
            )

    def _agree(self, *numbers: int) -> bool:
        """Whether these integers are the same on all ranks.

        The complement ~x falls as x rises, so the minimum over ranks of ~x is ~(maximum of x): equal iff minimum = maximum.
        """
        mine = torch.tensor([*numbers, *(~number for number in numbers)])
        least = self._reduced(mine, dist.ReduceOp.MIN)
        return torch.equal(least[: len(numbers)], ~least[len(numbers) :])

    def _reduced(self, x: Tensor, operation: dist.ReduceOp.RedOpType) -> Tensor:
        if self.size == 1:
            return x
        total = x.to(self.device, copy=True).contiguous()
        with _exchange():
            dist.all_reduce(total, operation)
        return total.to(x.device)


ALONE = Ranks(0, 1)  # a single process


@contextmanager
def _exchange() -> Iterator[None]:
    """Turn an error of the back end into a ConnectionError that points to the process that failed first."""
    try:
        yield
    except RuntimeError as error:
        raise ConnectionError(
            f"expected all processes to exchange numbers, lost one: see what it said ({error})"
        ) from error


@contextmanager
def torchrun_ranks(device: torch.device) -> Iterator[Ranks | None]:
    """Join the processes that torchrun started, for the duration of a with block; yield None without torchrun.

    device: the device of this process.  Ranks exchange tensors by NCCL between GPUs, and by gloo between CPUs.
    """
    if not dist.is_available() or not dist.is_torchelastic_launched():
        yield None
        return
    if device.type == "cuda":
        torch.cuda.set_device(device)
        dist.init_process_group("nccl", device_id=device)
    else:
        dist.init_process_group("gloo")
    try:
        yield Ranks.joined()
    finally:
        dist.destroy_process_group()


class DistributedOperator:
    """sum_r H_r over ranks, with this rank's H_r as `local`.  Collective: every rank has to apply it to the same vectors.

    Raises InputError on all ranks where they differ in rows, dtype or blocks, or in the vectors of a product.

    >>> from landscape.operators.operator import DenseOperator, SumOperator
    >>> ranks = ALONE  # under torchrun: Ranks.joined(); the sum is the same for any number of processes
    >>> terms = [torch.diag(torch.tensor([1.0, 2.0])), torch.tensor([[0.0, 4.0], [4.0, 0.0]]), 3 * torch.eye(2)]
    >>> H = DistributedOperator(SumOperator([DenseOperator(term) for term in ranks.share(terms)]), ranks)
    >>> H.apply(torch.eye(2))
    tensor([[4., 4.],
            [4., 5.]])
    """

    def __init__(self, local: SymmetricOperator, ranks: Ranks) -> None:
        blocks = ", ".join(f"{name} {rows.start}..{rows.stop}" for name, rows in local.blocks.items())
        ranks.require_same("operator", f"{local.dim} rows of {local.dtype} in {blocks}")
        self.local, self.ranks = local, ranks
        self.dim, self.dtype, self.blocks = local.dim, local.dtype, local.blocks

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(V, self.dim, self.dtype)
        self.ranks.require_same_vectors(V)
        return self.ranks.sum(self.local.apply(V))
