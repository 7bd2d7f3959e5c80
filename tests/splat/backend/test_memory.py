"""Free memory within the limit of a control group."""

from pathlib import Path

import pytest
import torch

from splat.backend import memory
from splat.backend.memory import free_memory

CPU = torch.device("cpu")
MIB = 2**20


def group(folder: Path, limit: str, usage: int, cached: int = 0) -> None:
    """Of the files that the system gives of a control group, those that are read."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "memory.max").write_text(f"{limit}\n")
    (folder / "memory.current").write_text(f"{usage}\n")
    (folder / "memory.stat").write_text(f"anon 1\ninactive_file {cached}\n")


@pytest.fixture
def top(tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr(memory, "GROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(memory, "GROUP", tmp_path / "own")
    (tmp_path / "own").write_text("1:cpu:/other\n0::/job/step\n")
    return tmp_path / "cgroup"


def test_the_tightest_group_decides_and_what_caches_files_can_be_had(top):
    group(top / "job/step", "max", 50 * MIB)
    assert free_memory(CPU) > 1000 * MIB  # no limit
    group(top / "job/step", str(80 * MIB), 50 * MIB)
    assert free_memory(CPU) == 30 * MIB
    group(top / "job", str(60 * MIB), 55 * MIB, cached=10 * MIB)
    assert free_memory(CPU) == 15 * MIB
    group(top, str(50 * MIB), 70 * MIB)
    assert free_memory(CPU) == 0


def test_what_cannot_be_read_of_a_group_limits_nothing(top):
    group(top / "job", "12 apples", 5)
    group(top.parent, str(MIB), 5)  # of no group
    assert free_memory(CPU) > 1000 * MIB
    group(top / "job", str(40 * MIB), 5 * MIB)
    (top / "job/memory.stat").unlink()
    assert free_memory(CPU) == 35 * MIB
