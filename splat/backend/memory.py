"""How much memory is free: on a GPU, or for this process within what the system, its control group and `--memory` leave.

One number, from which a plan is made.  Beyond it Python raises MemoryError, or the system ends a process.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

if TYPE_CHECKING:
    import torch

GROUPS, GROUP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")  # control groups of version 2, and the process's own
SLACK = 0.05  # of a limit that is asked for: what allocators and libraries hold beside what is counted

_most: float | None = None  # bytes that this process shall stay within


@contextmanager
def staying_within(size: int | None) -> Iterator[None]:
    """Let `free_memory` count so many bytes, in memory at a time and less SLACK, as all there are; None: no such limit."""
    global _most
    _most, before = None if size is None else (1 - SLACK) * size, _most
    try:
        yield
    finally:
        _most = before


def is_told() -> bool:
    """Whether `staying_within` says how much this process may have."""
    return _most is not None


def resident_memory() -> int:
    """Bytes of this process that are in memory."""
    return psutil.Process().memory_info().rss


def free_memory(device: "torch.device") -> int:
    """Free bytes on a device; on a GPU with those that torch keeps for future tensors."""
    if device.type == "cuda":
        import torch

        cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + cached
    told = [] if _most is None else [int(_most) - resident_memory()]
    return max(0, min([psutil.virtual_memory().available, *told, *_of_groups()]))


def _of_groups() -> Iterator[int]:
    """Room within the limits of the process's control group and of each group around it; caches of files count as free."""
    name = next((line[4:] for line in _lines(GROUP) if line.startswith("0::/")), None)
    for group in [] if name is None else [GROUPS / name, *(GROUPS / name).parents[: len(Path(name).parts)]]:
        most, used = ("".join(_lines(group / file)) for file in ("memory.max", "memory.current"))
        cached = [line.split()[1] for line in _lines(group / "memory.stat") if line.startswith("inactive_file ")]
        if most.isdigit():
            yield int(most) - int(used or 0) + sum(map(int, cached))


def _lines(path: Path) -> list[str]:
    """Lines of a file of the system; none where it has no such file."""
    try:
        return path.read_text(encoding="ascii").splitlines()
    except OSError:
        return []
