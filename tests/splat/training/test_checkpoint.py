"""Checkpoints: whole or not at all, read back as they were, refused with the reason where they are not ours."""

import builtins
import errno
import io
import math
import os
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from landscape.errors import InputError
from splat.training.checkpoint import VERSION, load_checkpoint, save_checkpoint, write_atomically
from splat.training.loop import train
from splat.training.state import Training
from tests.splat.tiny import EXTENT, REFERENCE, tiny_config, tiny_gaussians, tiny_views

WHOLE = "whole number of more than 64 bits"
LOSS = "loss.border, loss.eps, loss.literal, loss.opacity_reg, loss.scale_reg"


@pytest.fixture(scope="module")
def training() -> Training:
    training = Training.start(tiny_gaussians(), EXTENT, tiny_config())
    for done in train(training, tiny_views()):
        if done.step == 8:
            break
    return training


@pytest.fixture
def path(tmp_path, training) -> Path:
    save_checkpoint(tmp_path / "checkpoint.pt", training, REFERENCE)
    return tmp_path / "checkpoint.pt"


def test_what_is_saved_is_what_is_loaded(path, training):
    loaded = load_checkpoint(path)
    assert loaded.scene == REFERENCE and torch.load(path, weights_only=True)["torch"] == torch.__version__
    got = loaded.training
    assert got.config == training.config
    assert (got.step, got.extent, got.order) == (8, EXTENT, training.order)
    assert got.gaussians.sh_degree == training.gaussians.sh_degree == 1
    assert torch.equal(got.gaussians.flat, training.gaussians.flat)
    assert torch.equal(got.adam.first.flat, training.adam.first.flat) and got.adam.updates == 8
    assert torch.equal(got.adam.second.flat, training.adam.second.flat)
    assert torch.equal(got.screen_gradients.total, training.screen_gradients.total)
    assert torch.equal(got.screen_gradients.renders, training.screen_gradients.renders)
    assert torch.equal(got.generator.get_state(), training.generator.get_state())


def test_a_checkpoint_holds_no_more_than_its_tensors(path, training):
    values = sum(t.numel() for t in (training.gaussians.flat, training.adam.first.flat, training.adam.second.flat))
    assert path.stat().st_size < 4 * values + training.generator.get_state().numel() + 16_000


def test_the_same_training_gives_the_same_bytes_under_any_name(path, training):
    other = path.with_name("other.pt")
    save_checkpoint(other, training, REFERENCE)
    assert other.read_bytes() == path.read_bytes()


def test_a_write_that_fails_leaves_what_was_there_and_nothing_beside_it(path, monkeypatch):
    before = path.read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, "no space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space left") as caught:
        write_atomically(path, b"something else")
    assert caught.value.filename == str(path)
    assert path.read_bytes() == before and [file.name for file in path.parent.iterdir()] == [path.name]


def refused(path: Path, message: str) -> ValueError:
    with pytest.raises(ValueError, match=message) as caught:
        load_checkpoint(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    return caught.value


def test_a_missing_file_is_reported(tmp_path):
    with pytest.raises(FileNotFoundError, match="found no such file; name a run, or a file of Gaussians"):
        load_checkpoint(tmp_path / "none" / "checkpoint.pt")


PLY = b"ply\nformat binary_little_endian 1.0\n"


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"PK\x03\x04 nor a zip file", b"\x80\x02}q\x00.", PLY])
def test_a_file_of_another_kind_is_refused_and_what_was_wrong_is_kept(tmp_path, content):
    path = tmp_path / ("point_cloud.ply" if content == PLY else "checkpoint.pt")
    path.write_bytes(content)
    why = "it is cut off: its end" if content[:2] == b"PK" else "torch does not load it: File is not a zip file; take"
    of = r" \(of other tools" if content == PLY else f": {why}"
    caught = refused(path, f"expected a checkpoint written by landscape train.*damaged{of}")
    why = caught.__cause__
    assert content == PLY or (why and isinstance(why.__cause__, zipfile.BadZipFile))
    other = path.rename(tmp_path / "surface.png")
    if content[:2] != b"PK":
        said = refused(other, r"or a file of Gaussians \(PLY, .*got .*surface.png, which is nei").args[0]
        assert "take another copy" not in said


@pytest.mark.parametrize("number", [errno.EACCES, errno.EIO])
def test_a_file_that_the_system_does_not_open_is_reported_in_its_words(path, monkeypatch, number):
    opened = io.open

    def refuse(file, *arguments, **settings):
        if str(file) == str(path):
            raise OSError(number, os.strerror(number), str(file))
        return opened(file, *arguments, **settings)

    for module in (io, builtins):  # the root, who may read everything, runs tests too
        monkeypatch.setattr(module, "open", refuse)
    with pytest.raises(OSError, match=os.strerror(number)) as caught:
        load_checkpoint(path)
    assert caught.value.filename == str(path)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: can't allocate memory"),
        OSError(errno.EIO, os.strerror(errno.EIO)),
        KeyboardInterrupt(),
    ],
    ids=lambda error: type(error).__name__,
)
@pytest.mark.parametrize("place", ["torch.load", "splat.training.checkpoint.Adam", "zipfile.ZipFile"])
def test_what_is_not_the_files_fault_is_never_called_damaged(path, monkeypatch, error, place):
    def fails(*_, **__):
        raise error

    monkeypatch.setattr(place, fails)
    with pytest.raises(type(error)) as caught:
        load_checkpoint(path)
    assert caught.value is error


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_truncated_checkpoint_is_refused(path, share):
    content = path.read_bytes()
    for file in (path, path.with_name("step-500.pt")):  # in a run, of which other files are named as such
        file.write_bytes(content[: int(len(content) * share)])
        refused(file, "not one or is damaged: it is cut off: its end, with the list of what it holds, is missing")


def test_a_bit_that_flipped_anywhere_among_the_numbers_is_noticed(path, training):
    content = bytearray(path.read_bytes())
    numbers = training.gaussians.flat.numpy().tobytes()
    place = bytes(content).index(numbers)
    for byte in (place, place + len(numbers) // 2):
        content[byte] ^= 1
        path.write_bytes(content)
        refused(path, "not one or is damaged")
        content[byte] ^= 1
    path.write_bytes(content)
    load_checkpoint(path)


def test_what_is_loaded_is_what_was_checked_though_the_file_is_replaced(path, training, monkeypatch):
    checked = zipfile.ZipFile.testzip

    def replaced(archive):
        found = checked(archive)
        write_atomically(path, b"another")
        return found

    monkeypatch.setattr(zipfile.ZipFile, "testzip", replaced)
    assert torch.equal(load_checkpoint(path).training.gaussians.flat, training.gaussians.flat)


@pytest.mark.parametrize(("place", "value"), [(38, 0x10), (20, 0)], ids=["marked as a folder", "without bytes"])
def test_a_member_that_torch_would_not_read_is_refused(path, place, value):
    with zipfile.ZipFile(path) as archive:
        (numbers,) = (each for each in archive.infolist() if each.filename.endswith("data/0"))
    content = bytearray(path.read_bytes())
    entry = content.rindex(b"PK\x01\x02", 0, content.rindex(numbers.filename.encode()))  # in the archive's index
    content[entry + place : entry + place + 4] = value.to_bytes(4, "little")
    path.write_bytes(content)
    refused(path, "marked as a folder, or promises other bytes than it has")


def test_an_archive_that_torch_stumbles_over_in_its_own_way_is_refused(path):
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    pickled = next(name for name in members if name.endswith("data.pkl"))
    for start in (b"\x80\x02.", b"\x80\x02]Q.", b"\x80\x02K\x01Q."):  # nothing on the stack; things that are no storage
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in members.items():
                archive.writestr(name, start if name == pickled else content)
        refused(path, "not one or is damaged")


def test_a_file_that_would_run_code_is_refused_and_runs_nothing(tmp_path):
    marker = tmp_path / "ran"

    class Attack:
        def __reduce__(self):
            return os.mkdir, (str(marker),)

    path = tmp_path / "checkpoint.pt"
    torch.save({"format": Attack()}, path)
    refused(path, "not one or is damaged")
    path.write_bytes(pickle.dumps(Attack()))
    refused(path, "not one or is damaged")
    assert not marker.exists()


CHANGES = {
    "format": ("something else", "does not hold the format"),
    "version": (1, f"format version is 1, this program reads {VERSION}"),
    "torch": (2, "'torch': expected str, got int"),
    "step": (1000, "step 1000 is not among its 12"),
    "extent": (1e300, "extent is 1e.300"),
    "sh_degree": (7, "sh_degree 0, 1, 2 or 3, got 7"),
    "flat": (torch.zeros(7), "expected a vector of n x 23 parameters"),
    "adam": ({"first": torch.zeros(3), "second": torch.zeros(3), "updates": 1}, "'first' is torch.float32 of shape"),
    "screen_gradients": ([], "'screen_gradients': expected object, got array"),
    "generator": (torch.zeros(5, dtype=torch.uint8), "not the state of a random generator"),
    "order": ([3], "does not index its 3 training views"),
    "regularizer": ({}, "not the state of the method 3dgs .'generator'"),
    "config": ({"iterations": 5}, "'config.method': expected object, got null"),
    "scene": ({}, "'scene': object missing required field absolute"),
}


@pytest.mark.parametrize("key", CHANGES)
def test_every_key_is_checked(path, key):
    content = torch.load(path, weights_only=True)
    assert set(content) == set(CHANGES)
    value, message = CHANGES[key]
    torch.save({**content, key: value}, path)
    refused(path, message)
    torch.save({**content, key: torch.zeros(3, 40)}, path)
    refused(path, "tensor|Tensor|torch|format|object missing")
    del content[key]
    torch.save(content, path)
    refused(path, "missing|format")


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("adam", "first", 1), math.nan, "'first' holds a number that is not finite"),
        (("adam", "second", 1), -1e-9, "'second' holds a number that is not finite"),
        (("adam", "updates"), -1, "'adam.updates': expected int >= 0, got -1"),
        (("adam", "updates"), 9, "optimiser has made 9 updates in 8 steps"),
        (("adam", "updates"), 10**400, f"'adam.updates': expected int <= 9223372036854775807, got a {WHOLE}"),
        (("screen_gradients", "total", 1), math.inf, "'total' holds a number that is not finite"),
        (("scene", "views", "view1"), None, "it does not say what was seen of 1 of its views, such as 'view1'"),
        (("flat", 4), torch.nan, "expected finite means.*at Gaussian 1"),
        (("flat",), torch.zeros(0), "expected at least one Gaussian, got none"),
        (("flat",), torch.zeros(14, dtype=torch.float16), "'flat' is torch.float16"),
        (("flat",), torch.ones(1).expand(23 * 10**12), "does not hold its numbers one by one"),
        (("flat",), torch.zeros(23, device="meta"), "does not hold its numbers one by one"),
        (("config", "densify", "stop"), 2**63, f"'config.densify.stop': expected int.*, got a {WHOLE}"),
        (("config", "densify", "stop"), 10**30, f"'config.densify.stop': expected int.*, got a {WHOLE}"),
        (("config", "rates", "position"), 10**400, f"'config.rates.position': expected float.*, got a {WHOLE}"),
        (("config", "render", "contour_sigma"), 10**400, f"'config.render.contour_sigma': expected .*got a {WHOLE}"),
        (("config", "iterations"), "many", "'config.iterations': expected int, got str"),
        (("config", "iterations"), torch.zeros(50, 50), "'config.iterations': expected int, got Tensor"),
        (("config", "background"), (0.0, 1.0), "'config.background': expected array of length 3, got 2"),
        (("config", "background"), (0.0, "many " * 100, 1.0), r"'config.background\[1\]': expected float, got str"),
        (("config", "seed"), -1, "'config.seed': expected int >= 0, got -1"),
        (("config", "loss"), {"pixel": "l1"}, f"missing or unknown keys: {LOSS}"),
        (("config", "loss", "pixel"), "l3", "'config.loss.pixel': expected 'l1' or 'charbonnier' or 'l2', got 'l3'"),
        (("config", "method"), {"name": "magic"}, "'config.method' has the unknown name 'magic'"),
        (("config", "method"), {"name": "stablegs"}, "'config' has missing or unknown keys: method.accuracy"),
        (("config", "method"), "3dgs", "'config.method': expected object, got str"),
        (("config", "method", "name"), torch.zeros(2000), "'config.method.name': expected str, got Tensor"),
        (("config", "method", "name"), "magic " * 100, "unknown name '(magic ){13}ma', expected one of 3dgs, stablegs"),
    ],
)
def test_what_no_training_saves_is_refused_by_its_key(path, place, value, message):
    content = torch.load(path, weights_only=True)
    *to, last = place
    at = content
    for key in to:
        at = at[key]
    if value is None:
        del at[last]
    else:
        at[last] = value
    torch.save(content, path)
    refused(path, message)


def test_whole_numbers_in_place_of_real_ones_are_taken(path):
    content = torch.load(path, weights_only=True)
    content["config"]["render"]["contour_sigma"] = 2**59
    content["config"]["rates"]["quats"] = 1
    torch.save(content, path)
    config = load_checkpoint(path).training.config
    assert config.render.contour_sigma == 2**59 and config.rates.quats == 1


def test_a_checkpoint_of_float64_comes_back_in_float64(tmp_path):
    training = Training.start(tiny_gaussians(dtype=torch.float64), EXTENT, tiny_config())
    save_checkpoint(tmp_path / "checkpoint.pt", training, REFERENCE)
    assert load_checkpoint(tmp_path / "checkpoint.pt").training.gaussians.flat.dtype == torch.float64


def test_the_scene_is_found_from_the_checkpoint_else_where_it_was(tmp_path):
    there, run, moved = tmp_path / "scene", tmp_path / "run", tmp_path / "elsewhere"
    for folder in (there, run):
        folder.mkdir()
    reference = replace(REFERENCE, absolute=str(there), relative="../scene")
    assert reference.find(run / "checkpoint.pt") == there
    moved.mkdir()
    run = run.rename(moved / "run")
    assert reference.find(run / "checkpoint.pt") == there
    there.rename(moved / "scene")
    assert reference.find(run / "checkpoint.pt") == moved / "scene"
    (moved / "scene").rmdir()
    with pytest.raises(FileNotFoundError, match="pass where it is now with --scene"):
        reference.find(run / "checkpoint.pt")


@pytest.mark.parametrize("version", [1, VERSION - 1, VERSION + 1])
def test_a_checkpoint_of_another_version_is_refused_in_one_sentence(path, version):
    content = torch.load(path, weights_only=True)
    del content["scene"]["views"]  # as in older files
    torch.save(content | {"version": version}, path)
    refused(path, f"its format version is {version}, this program reads {VERSION}; take another copy .*, or train anew")


@pytest.mark.parametrize("name", ["train.csv", "probe/probe.json", "metrics.json"])
def test_another_file_of_a_run_is_refused_by_the_name_of_the_run(tmp_path, name):
    (tmp_path / "probe").mkdir()
    (tmp_path / "checkpoint.pt").write_bytes(b"")
    (tmp_path / name).write_text("{}")
    with pytest.raises(InputError, match=f"another file of the run {tmp_path}; name that run"):
        load_checkpoint(tmp_path / name)
