"""Arrays that promise more than their files hold are refused before memory is asked for."""

import os
import signal
import time
import tracemalloc
import zipfile
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from analysis.console.interruption import Interrupted, raising
from analysis.records.records import _archive
from landscape.errors import InputError
from splat.model.untrusted import inside, locked, read_array


def with_header(length: bytes, header: bytes, version: int) -> bytes:
    return b"\x93NUMPY" + bytes([version, 0]) + length + header + bytes(24)


SHAPE = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000,), }\n"
BOMBS = {
    "header": with_header(b"\xff\xff\xff\xff", b"{}", 2),
    "shape": with_header(len(SHAPE).to_bytes(2, "little"), SHAPE, 1),
    "shape, second version": with_header(len(SHAPE).to_bytes(4, "little"), SHAPE, 2),
}


@pytest.mark.parametrize("name", BOMBS)
def test_what_an_array_promises_is_compared_with_what_there_is(tmp_path, name):
    (tmp_path / "bomb.npy").write_bytes(BOMBS[name])
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w") as archive:
        archive.writestr("x.npy", BOMBS[name])
    tracemalloc.start()
    with (
        (tmp_path / "bomb.npy").open("rb") as file,
        pytest.raises(InputError, match=r"no array of numbers \(it promises"),
    ):
        read_array(file)
    with (tmp_path / "bomb.npz").open("rb") as file, pytest.raises(ValueError, match="it promises"):
        _archive(file)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
def test_arrays_of_every_version_are_read(tmp_path, version):
    buffer, array = BytesIO(), np.arange(6.0).reshape(2, 3)
    np.lib.format.write_array(buffer, array, version)
    (tmp_path / "good.npy").write_bytes(buffer.getvalue())
    with (tmp_path / "good.npy").open("rb") as file:
        np.testing.assert_array_equal(read_array(file), array)


@pytest.mark.parametrize("name", ["../x", "/x", "a/../../x", "a/../.."])
def test_names_that_lead_out_are_refused_and_others_are_not(tmp_path, monkeypatch, name):
    with pytest.raises(InputError, match="which leads out of it"):
        inside(tmp_path, name)
    monkeypatch.chdir(tmp_path)
    assert inside(Path("."), "a/../b") == Path("a/../b") and inside(Path("."), str(tmp_path / "b")) == tmp_path / "b"


def test_a_signal_while_a_lock_is_taken_leaves_no_file(tmp_path, monkeypatch):
    def flock(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr("splat.model.untrusted.fcntl.flock", flock)
    with pytest.raises(Interrupted), raising(), locked(tmp_path / ".lock", "a run"):
        time.sleep(5)
    assert list(tmp_path.iterdir()) == []
