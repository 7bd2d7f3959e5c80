"""How much memory is free: on a GPU, or for this process within the machine's, its group's and its own limits.

Limits of addresses and of data (`ulimit -v`, `ulimit -d`) are kept well away from.  Beyond them a tensor raises, but compiled
code and libraries end the process, and the start of a thread waits for ever: these are asked for only where a reserve is left.
Beyond the limit of a control group the system kills.
"""

import ctypes
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import psutil

from landscape.errors import TooLittleMemory

if TYPE_CHECKING:
    import torch

GROUPS, GROUP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
VERSIONS = {  # of control groups: folder, limit, usage
    2: ("", "memory.max", "memory.current"),
    1: ("memory", "memory.limit_in_bytes", "memory.usage_in_bytes"),
}
LIMITED = {  # what the process may be told to stay within, and the option of ulimit; bytes of it that libraries take
    resource.RLIMIT_AS: ("addresses (ulimit -v)", 3 * 2**29),
    resource.RLIMIT_DATA: ("data (ulimit -d)", 2**29),
}
RESERVE = 2**29  # bytes of these that no plan counts on: for threads, compiled code and libraries that are loaded late
OF_GROUP = RESERVE // 2  # bytes of a group's memory that no plan counts on: for the same, and processes that draw
LEAST = RESERVE // 4  # of which is left where something goes on

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


def give_back_freed() -> None:
    """Give the pages that the C library's allocator holds free back to the system, where it is glibc.

    It holds those below a block that is in use: many large blocks that come and go one by one would double what they take.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim:
        trim(0)


def free_memory(device: "torch.device") -> int:
    """Free bytes on a device; on a GPU with those that torch keeps for future tensors."""
    return max(0, memory_left(device))


def memory_left(device: "torch.device") -> int:
    """The same; below zero where something is taken of what no plan counts on."""
    if device.type == "cuda":
        import torch

        cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + cached
    return min([psutil.virtual_memory().available, *_of_process(), *(left - OF_GROUP for left in _of_groups())])


def _of_process() -> Iterator[int]:
    """What the limits of this process leave, of memory, and of addresses and data beside the reserve."""
    if _most is not None:
        yield int(_most) - resident_memory()
    yield from (left - RESERVE for left in _left().values())


def _left() -> dict[int, int]:
    """Bytes that the limits of this process leave, for each that there is."""
    limits = {kind: limit for kind in LIMITED if (limit := resource.getrlimit(kind)[0]) != resource.RLIM_INFINITY}
    if not limits:
        return {}
    used = psutil.Process().memory_info()
    taken = {resource.RLIMIT_AS: used.vms, resource.RLIMIT_DATA: getattr(used, "data", used.rss)}
    return {kind: limit - taken[kind] for kind, limit in limits.items()}


def require_room(least: int = LEAST, *, libraries: bool = False) -> None:
    """TooLittleMemory where limits of this process leave fewer bytes; libraries: beside what these take, not loaded yet."""
    for kind, left in _left().items():
        name, taken = LIMITED[kind]
        if left < (expected := least + libraries * taken):
            raise TooLittleMemory(
                f"expected at least {expected / 1e6:,.0f} MB of {name} {'to begin with' if libraries else 'to go on'}, got "
                f"{max(left, 0) / 1e6:,.0f} MB; allow more{'' if libraries else ', or take fewer Gaussians or smaller images'}"
            )


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
    """Bytes of cached files that a group can give up."""
    try:
        entries = dict(line.split() for line in path.read_text().splitlines())
    except OSError:
        return 0
    return int(entries.get("total_inactive_file", entries.get("inactive_file", 0)))
