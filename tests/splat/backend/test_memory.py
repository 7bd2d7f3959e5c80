"""Free memory within the limits of the process and of its control groups."""

import platform
import resource
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from numba.core import event
from rich.console import Console

from landscape.errors import TooLittleMemory
from splat.backend import memory
from splat.backend.memory import free_memory, give_back_freed, resident_memory

CPU = torch.device("cpu")
ROOT = Path(__file__).parents[3]
MIB = 2**20


@pytest.mark.parametrize("kind", ["RLIMIT_AS", "RLIMIT_DATA"])
def test_a_limit_of_the_process_is_honoured(kind):
    program = (
        f"import resource, torch\nfrom splat.backend.memory import RESERVE, free_memory\n"
        f"used = {{'RLIMIT_AS': 'VmSize', 'RLIMIT_DATA': 'VmData'}}['{kind}']\n"
        f"of = lambda: 1024 * int(open('/proc/self/status').read().partition(used + ':')[2].split()[0])\n"
        f"limit = of() + RESERVE + {300 * MIB}\nresource.setrlimit(resource.{kind}, (limit, limit))\n"
        f"kept = bytearray({100 * MIB})\nprint(free_memory(torch.device('cpu')), limit - of() - RESERVE)"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    free, expected = map(int, done.stdout.split())
    assert abs(free - expected) < 16 * MIB and 150 * MIB < free < 220 * MIB


def test_little_room_in_limits_is_refused_before_what_cannot_say_that_it_lacks_it(monkeypatch):
    from analysis.commands.compiling import _Once
    from analysis.console.stages import Stages

    def leave(size: int) -> None:
        monkeypatch.setattr(memory, "_left", lambda: {resource.RLIMIT_AS: size})

    leave(memory.LEAST)
    with Stages().stage("one"):
        leave(memory.LEAST - 1)
        with pytest.raises(TooLittleMemory, match=r"at least 134 MB of addresses \(ulimit -v\) to go on, got 134 MB"):
            Stages().stage("another").__enter__()
    leave(memory.RESERVE - 1)
    with pytest.raises(TooLittleMemory, match="at least 537 MB"):
        _Once(Console(quiet=True)).on_start(event.Event("numba:compile", event.EventStatus.START))


def group(folder: Path, limit: str, usage: int, version: int, cached: int = 0) -> None:
    """Of the files that the system gives of a control group, those that are read.  limit: beside what no plan counts on."""
    _, most, used = memory.VERSIONS[version]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / most).write_text(f"{int(limit) + memory.OF_GROUP if limit.isdigit() else limit}\n")
    (folder / used).write_text(f"{usage}\n")
    word = "total_inactive_file" if version == 1 else "inactive_file"
    (folder / "memory.stat").write_text(f"anon 1\n{word} {cached}\n")


@pytest.fixture(params=[1, 2])
def version(request, tmp_path, monkeypatch) -> int:
    monkeypatch.setattr(memory, "GROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(memory, "GROUP", tmp_path / "own")
    (tmp_path / "own").write_text("5:memory:/job/step\n1:cpu:/other\n" if request.param == 1 else "0::/job/step\n")
    return request.param


def test_the_tightest_group_decides_and_what_caches_files_can_be_had(version, tmp_path):
    top = tmp_path / "cgroup" / memory.VERSIONS[version][0]
    group(top / "job/step", "max" if version == 2 else str(2**63 - 4096), 50 * MIB, version)
    assert free_memory(CPU) > 1000 * MIB  # no limit
    group(top / "job/step", str(80 * MIB), 50 * MIB, version)
    assert free_memory(CPU) == 30 * MIB
    group(top / "job", str(60 * MIB), 55 * MIB, version, cached=10 * MIB)
    assert free_memory(CPU) == 15 * MIB
    group(top, str(50 * MIB), 70 * MIB, version)
    assert free_memory(CPU) == 0 and memory.memory_left(CPU) == -20 * MIB


def test_what_cannot_be_read_of_a_group_limits_nothing(version, tmp_path):
    top = tmp_path / "cgroup" / memory.VERSIONS[version][0] / "job"
    group(top, "12 apples", 5, version)
    assert free_memory(CPU) > 1000 * MIB
    group(top, str(40 * MIB), 5 * MIB, version)
    (top / "memory.stat").unlink()
    assert free_memory(CPU) == 35 * MIB


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the allocator is not glibc's")
def test_pages_freed_between_blocks_in_use_are_given_back():
    blocks = [bytearray(100_000) for _ in range(2000)]
    del blocks[::2]
    before = resident_memory()
    give_back_freed()
    assert before - resident_memory() > 50e6
