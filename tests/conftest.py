"""Fixtures that several folders share."""

import os
from pathlib import Path

import pytest
import torch

if not torch.cuda.is_available():  # before the first import of triton, which reads it
    os.environ.setdefault("TRITON_INTERPRET", "1")

# the processes of a run share the cores
torch.set_num_threads(max(1, torch.get_num_threads() // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))))


def _real_scene(name: str) -> Path:
    """A folder of the real data: $LANDSCAPE_DATA, else shared/data beside the repository."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("LANDSCAPE_DATA", beside)) / name
    if not folder.is_dir():
        pytest.skip(f"needs the {name} scene; name the folder that holds {name}/ with LANDSCAPE_DATA")
    return folder


@pytest.fixture
def fern() -> Path:
    """LLFF fern with its COLMAP model."""
    return _real_scene("fern")


@pytest.fixture
def lego() -> Path:
    """Blender lego, reduced to the 8-view protocol."""
    return _real_scene("lego")


@pytest.fixture
def device() -> torch.device:
    """Where the kernels for GPUs run: a GPU, or else the CPU with Triton's interpreter."""
    pytest.importorskip("triton", reason="the kernels for GPUs need triton; pip install -e '.[gpu]'")
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")
