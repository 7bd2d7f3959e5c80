"""Fixtures that several folders share."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from tests.forks import DRAWING, stand_in
from tests.splat.gpu.interpreted import interpreter, unwritten

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # Triton's own functions are made for its interpreter, when it is imported

# the processes of a run share the cores
torch.set_num_threads(max(1, torch.get_num_threads() // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))))

# under nohup these are ignored, here and by the commands that the tests start
for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, usual)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that run on a GPU where there is one; without one, the first case of each is interpreted."""
    interpreted: set[str] = set()
    for item in items:
        if "device" not in getattr(item, "fixturenames", ()):
            continue
        item.add_marker("cuda")
        test = item.nodeid.partition("[")[0]
        if test in interpreted and not torch.cuda.is_available():
            item.add_marker(pytest.mark.skip(reason="without a GPU the first case stands for all"))
        interpreted.add(test)


@pytest.fixture(scope="session", autouse=True)
def commands() -> Iterator[None]:
    """Commands have their pictures drawn by forks, but in the tests of what draws, and do not fork a process with threads."""
    with pytest.MonkeyPatch.context() as patch:
        stand_in(patch, DRAWING)
        patch.setattr("analysis.commands.compiling.compile_ahead", lambda: None)
        yield


@pytest.fixture(scope="session")
def original(tmp_path_factory) -> Path:
    """A scene of five views of 24 x 18 px, which tests leave as it is."""
    folder = tmp_path_factory.mktemp("scenes") / "still"
    write_transforms_scene(synthetic_scene(SyntheticSettings(gaussians=60, views=5, width=24, height=18)).scene, folder)
    return folder


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
def emulator() -> Iterator[None]:
    """Kernels for GPUs run on the CPU, by Triton's interpreter."""
    pytest.importorskip("triton", reason="the kernels for GPUs need triton; pip install -e '.[gpu]'")
    with interpreter():
        yield


@pytest.fixture
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """Where the kernels for GPUs run: a GPU, or else the CPU with `emulator`, in memory that holds NaN until it is written."""
    if torch.cuda.is_available():
        return torch.device("cuda")
    request.getfixturevalue("emulator")
    for owner, name in ((torch, "empty"), (torch, "empty_like"), (Tensor, "new_empty")):
        monkeypatch.setattr(owner, name, unwritten(getattr(owner, name)))
    return torch.device("cpu")
