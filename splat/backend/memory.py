"""How much memory is free: on a GPU, or for this process within the machine's, its group's and its own limits."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

import psutil
import torch

GROUPS, GROUP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
VERSIONS = {  # of control groups: folder, limit, usage
    2: ("", "memory.max", "memory.current"),
    1: ("memory", "memory.limit_in_bytes", "memory.usage_in_bytes"),
}


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


def resident_memory() -> int:
    """Bytes of this process that are in memory."""
    return psutil.Process().memory_info().rss


def free_memory(device: torch.device) -> int:
    """Free bytes on a device; on a GPU with those that torch keeps for future tensors."""
    if device.type == "cuda":
        cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + cached
    return max(0, min([psutil.virtual_memory().available, *_of_process(), *_of_groups()]))


def _of_process() -> Iterator[int]:
    """What the limits of this process leave, of memory, of addresses and of data."""
    if _most is not None:
        yield int(_most) - resident_memory()
    used = psutil.Process().memory_info()
    for kind, bytes_used in ((resource.RLIMIT_AS, used.vms), (resource.RLIMIT_DATA, getattr(used, "data", used.rss))):
        limit = resource.getrlimit(kind)[0]
        if limit != resource.RLIM_INFINITY:
            yield limit - bytes_used


def _of_groups() -> Iterator[int]:
    """What the limits of this process's control group leave, and of those that it is in; what caches files can be had."""
    for line in GROUP.read_text().splitlines() if GROUP.is_file() else []:
        _, kinds, name = line.split(":", 2)
        if kinds not in ("", "memory"):
            continue
        folder, limit, usage = VERSIONS[1 if kinds else 2]
        path = PurePosixPath(name)
        for group in (path, *path.parents):
            place = GROUPS / folder / str(group).lstrip("/")
            if (most := _number(place / limit)) is not None:
                yield most - (_number(place / usage) or 0) + _cached(place / "memory.stat")


def _number(path: Path) -> int | None:
    """That a file holds; None without a file or a limit."""
    try:
        text = path.read_text().strip()
    except OSError:
        return None
    return int(text) if text.isdigit() else None


def _cached(path: Path) -> int:
    """Bytes of files that a group keeps for nobody."""
    try:
        entries = dict(line.split() for line in path.read_text().splitlines())
    except OSError:
        return 0
    return int(entries.get("total_inactive_file", entries.get("inactive_file", 0)))
