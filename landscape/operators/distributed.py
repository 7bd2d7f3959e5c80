"""Operators whose terms are spread over processes: H V = sum_r H_r V, H_r the terms of rank r, added by an all-reduce.

    torchrun --nproc-per-node 2 study.py                     # in it, on every rank alike:
    torch.distributed.init_process_group("gloo")             # "nccl" for ranks with a GPU each, made current before
    ranks = Ranks.joined()
    H = DistributedOperator(SumOperator([term_of(view) for view in ranks.share(views)]), ranks)
    estimate_traces(H, torch.Generator().manual_seed(0))     # the same numbers on every rank

Every rank runs the same estimator with the same seed.  An all-reduce hands the same bits to all, so all take the same steps;
the numbers are those of one process but for the order of the sum.  What clocks decide may differ between ranks, so time
budgets have to stay infinite.  Before a product the ranks compare a checksum of their vectors: where they parted, all raise.
Where a process fails the others do not wait for it: what they exchange next raises ConnectionError.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import TypeVar

import torch
import torch.distributed as dist
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from landscape.errors import InputError
from landscape.operators.operator import SymmetricOperator, require_vectors

Item = TypeVar("Item")


@dataclass(frozen=True)
class Ranks:
    """The processes of a group, seen from the one of number `rank` (from 0) out of `size`.

    Every method but `share` is collective: all processes have to call it, in the same order.  group: all processes where None.
    device: where tensors are exchanged; they come back to the device that they were on.  A single rank exchanges nothing and
    needs no group: `ALONE`.
    """

    rank: int
    size: int
    group: dist.ProcessGroup | None = None
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @classmethod
    def joined(cls, group: dist.ProcessGroup | None = None) -> "Ranks":
        """The group that this process has joined (all processes where None).  ValueError where none is initialised."""
        if not (dist.is_available() and dist.is_initialized()):
            raise InputError(
                "expected an initialised process group, got none; start with torchrun and call "
                'torch.distributed.init_process_group("gloo") first ("nccl" on GPUs)'
            )
        on_gpu = dist.get_backend(group) == "nccl"  # which moves nothing but what lies on a GPU
        device = torch.device("cuda", torch.cuda.current_device()) if on_gpu else torch.device("cpu")
        return cls(dist.get_rank(group), dist.get_world_size(group), group, device)

    def share(self, items: Sequence[Item], name: str = "item") -> Sequence[Item]:
        """This rank's items: a contiguous part, so that all parts one after the other are the items in order.

        ValueError where there are fewer items than ranks, which calls them by their name.

        >>> Ranks(0, 2).share("abcde"), Ranks(1, 2).share("abcde")
        ('ab', 'cde')
        """
        if len(items) < self.size:
            raise InputError(
                f"expected at least one {name} for each of {self.size} ranks, got {len(items)}; start fewer processes"
            )
        return items[self.rank * len(items) // self.size : (self.rank + 1) * len(items) // self.size]

    def sum(self, x: Shaped[Tensor, "..."]) -> Shaped[Tensor, "..."]:
        """The sum of x over ranks, the same bits on each."""
        return self._reduced(x, dist.ReduceOp.SUM)

    def any(self, mask: Bool[Tensor, "..."]) -> Bool[Tensor, "..."]:
        """Where the mask of at least one rank is set."""
        return self._reduced(mask.to(torch.uint8), dist.ReduceOp.MAX).bool()

    def gather(self, x: Shaped[Tensor, "..."]) -> list[Shaped[Tensor, "..."]]:
        """x of every rank, in their order; x has to have the same shape and dtype on all."""
        if self.size == 1:
            return [x]
        parts = [torch.empty_like(x, device=self.device) for _ in range(self.size)]
        with _exchange():
            dist.all_gather(parts, x.to(self.device).contiguous(), group=self.group)
        return [part.to(x.device) for part in parts]

    def require_same(self, name: str, value: object) -> None:
        """Raise ValueError on all ranks unless the value's text is the same on each."""
        if self.size == 1:
            return
        digest = int.from_bytes(blake2b(str(value).encode(), digest_size=8).digest(), "little", signed=True)
        if not self._agree(digest):
            raise InputError(f"expected the same {name} on every rank, got {value} on rank {self.rank} of {self.size}")

    def require_same_vectors(self, V: Float[Tensor, "n k"]) -> None:
        """Raise ValueError on all ranks unless they have as many vectors, with the same sum of all entries' bit patterns."""
        if self.size == 1:
            return
        bits = {2: torch.int16, 4: torch.int32, 8: torch.int64}[V.element_size()]
        fingerprint = int(V.contiguous().view(bits).sum(dtype=torch.int64))  # exact, in whatever order it is added up
        if not self._agree(V.shape[1], fingerprint):
            raise InputError(
                f"expected the same vectors on every rank, got others on some (here {V.shape[1]}); seed the generators "
                "alike, leave time budgets infinite, and run on machines of one kind"
            )

    def _agree(self, *numbers: int) -> bool:
        """Whether these integers are the same on all ranks: the least of them and of their complements then match."""
        mine = torch.tensor([*numbers, *(~number for number in numbers)])
        least = self._reduced(mine, dist.ReduceOp.MIN)
        return torch.equal(least[: len(numbers)], ~least[len(numbers) :])

    def _reduced(self, x: Tensor, operation: dist.ReduceOp.RedOpType) -> Tensor:
        if self.size == 1:
            return x
        total = x.to(self.device, copy=True).contiguous()
        with _exchange():
            dist.all_reduce(total, operation, group=self.group)
        return total.to(x.device)


ALONE = Ranks(0, 1)  # a process that shares nothing


@contextmanager
def _exchange() -> Iterator[None]:
    """The back end's own error, in a sentence that leads to the process that failed first."""
    try:
        yield
    except RuntimeError as error:
        raise ConnectionError(
            f"expected all processes to exchange numbers, lost one: see what it said ({error})"
        ) from error


@contextmanager
def torchrun_ranks(device: torch.device) -> Iterator[Ranks | None]:
    """The processes that torchrun started with this one, joined for as long as the block runs; None without torchrun.

    device: this process's own; what the ranks exchange goes from GPU to GPU by NCCL, and by gloo between CPUs.
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
    """sum_r H_r over ranks; `local` is this rank's H_r.  Collective: every rank has to apply it to the same vectors.

    Raises ValueError on all ranks where they disagree on rows, dtype or blocks, and on the vectors of a product.
    """

    def __init__(self, local: SymmetricOperator, ranks: Ranks) -> None:
        blocks = ", ".join(f"{name} {rows.start}..{rows.stop}" for name, rows in local.blocks.items())
        ranks.require_same("operator", f"{local.dim} rows of {local.dtype} in {blocks}")
        self.local, self.ranks = local, ranks
        self.dim, self.dtype, self.blocks = local.dim, local.dtype, local.blocks

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        require_vectors(V, self.dim)
        self.ranks.require_same_vectors(V)
        return self.ranks.sum(self.local.apply(V))
