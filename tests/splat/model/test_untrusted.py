"""What promises more than its file holds is refused before memory is asked for; what is written is whole or not at all."""

import ast
import re
import tracemalloc
import zipfile
from contextlib import nullcontext
from io import BytesIO
from pathlib import Path

import msgspec
import numpy as np
import pytest
from PIL import Image

from landscape.errors import InputError
from splat.model import untrusted
from splat.model.untrusted import (
    NAME,
    inside,
    loose_json,
    read_array,
    read_arrays,
    read_json,
    read_picture,
    read_table,
    read_toml,
    replacing,
    require_name,
    short,
    unpacked,
    write_atomically,
)
from tests.refusals import refused

ROOT = Path(__file__).resolve().parents[3]


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
    refused("it promises", read_arrays, tmp_path / "bomb.npz")
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
    refused("which leads out of it", inside, tmp_path, name)
    monkeypatch.chdir(tmp_path)
    assert inside(Path("."), "a/../b") == Path("a/../b") and inside(Path("."), str(tmp_path / "b")) == tmp_path / "b"


@pytest.mark.parametrize("name", ["..", "../x", "/x", "a/b", "", ".hidden", "a\0b", "a\n", "a\x1b[2J", "n" * 101])
def test_names_that_are_not_fit_for_a_file_or_folder_are_refused(name):
    refused("as it names a folder", require_name, name)
    assert re.match(NAME, "view-000") and require_name("fern 2.1+x") == "fern 2.1+x"


@pytest.mark.parametrize(
    ("read", "content"),
    [
        (read_json, b"[" * 5000), (read_json, b"{"), (read_json, b'"\xff"'), (read_toml, b"a = " + b"[" * 5000),
        (read_toml, b"a = " + b"9" * 6000), (read_toml, b"\xff"), (read_picture, b"GIF89a"), (read_picture, b""),
        (read_json, b"[" * 65 + b"]" * 65), (read_toml, b"a = " + b"[" * 64 + b"]" * 64),
        (read_arrays, b"PK"), (read_arrays, b"not an archive"), (read_table, b""), (read_table, b"a\n\xff"),
        (read_table, b"a,b\n1,2\n1,2,3"),
    ],
)  # fmt: skip
def test_what_is_none_is_refused_in_a_sentence_that_names_the_file(tmp_path, read, content):
    (tmp_path / "file").write_bytes(content)
    refused(f"in {tmp_path / 'file'}, got a damaged file", read, tmp_path / "file")
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "none")


def test_a_digest_that_looks_like_a_number_stays_what_it_is(tmp_path):
    (tmp_path / "file").write_text("at,digest,commit\n30,97351657e9409972,012345678912\n")
    assert read_table(tmp_path / "file").loc[0].tolist() == [30, "97351657e9409972", "012345678912"]


@pytest.mark.parametrize("content", ["[" * 10**5, "9" * 6000, "{", '{"a": 01}'])
def test_json_of_other_tools_is_read_as_python_does_or_refused(content):
    assert loose_json('{"a": NaN, "b": 3}', parse_int=float)["b"] == 3.0
    refused("no JSON", loose_json, content)


def test_packed_structures_of_another_kind_or_too_deep_are_refused():
    assert unpacked(msgspec.msgpack.encode([1, 2]), list[int]) == [1, 2]
    for content in (b"", b"\xc1", msgspec.msgpack.encode({"a": 1}), b"\x91" * 10**5):
        refused("expected list, got", unpacked, content, list[int])


def test_pictures_and_texts_have_a_greatest_size(tmp_path, monkeypatch):
    for size in ((2**14, 2**12 + 1), (1, 2**16 + 1)):
        Image.new("L", size).save(tmp_path / "large.png")
        refused("at most 67,108,864 and 65,536 a side", read_picture, tmp_path / "large.png")
    monkeypatch.setattr(untrusted, "MOST_TEXT", 3)
    (tmp_path / "text").write_text("[12]")
    refused("4 bytes, of at most 3", read_json, tmp_path / "text")


@pytest.mark.parametrize("dies", ["in the block", "between the renames", "no"])
def test_a_folder_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch, dies):
    out = tmp_path / "out"
    with replacing(out, folder=True) as partial:
        (partial / "file").write_text("old")

    def replace_by(text: str) -> None:
        with replacing(out, folder=True) as partial:
            (partial / "file").write_text(text)
            if dies == "in the block":
                raise KeyboardInterrupt

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    if dies == "between the renames":
        monkeypatch.setattr(untrusted.os, "replace", interrupted)
    with nullcontext() if dies == "no" else pytest.raises(KeyboardInterrupt):
        replace_by("new")
    assert (out / "file").read_text() == ("new" if dies == "no" else "old")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("folder", [False, True])
def test_what_cannot_be_written_is_named_as_it_was_asked_for(tmp_path, folder):
    (tmp_path / "file").touch()
    with pytest.raises(OSError) as caught, replacing(tmp_path / "file" / "out", folder=folder) as partial:
        (partial / "a" if folder else partial).write_bytes(b"")
    assert str(caught.value.filename) == str(tmp_path / "file" / ("" if folder else "out"))


def test_a_name_as_long_as_the_system_allows_can_be_written(tmp_path):
    path = tmp_path / ("é" * 125 + ".png")  # 254 bytes
    write_atomically(path, b"picture")
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    assert len(short("x" * 201)) < 40 and short("x" * 201) != short("x" * 202) and short("x" * 200) == "x" * 200


READERS = {"json.loads", "msgspec.json.decode", "msgspec.msgpack.decode", "tomllib.loads", "pd.read_csv", "Image.open"}
BARE = {*READERS, "np.load", "np.loadtxt", "np.genfromtxt", "json.load", "tomllib.load", "pickle.load", "torch.load"}
NAMES = {"open", "read_text", "write_text", *(name.rpartition(".")[2] for name in BARE)}


def test_files_are_read_by_one_module_and_text_is_utf_8():
    """Whatever the locale is; bare readers know no bounds."""
    found = set()
    for layer in ("landscape", "splat", "analysis", "figures", "notebooks"):
        for path in (ROOT / layer).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call) and _called(node) in NAMES and _is_bare(node):
                    found.add((path.relative_to(ROOT).as_posix(), ast.unparse(node.func)))
    others = {("splat/model/files/tensor_files.py", "torch.load"), ("splat/scenes/formats/dtu.py", "np.loadtxt")}
    assert found == {("splat/model/untrusted.py", name) for name in READERS} | others


def _called(call: ast.Call) -> str:
    """The last name of what is called."""
    return getattr(call.func, "attr", getattr(call.func, "id", ""))


def _is_bare(call: ast.Call) -> bool:
    name, named = ast.unparse(call.func), {each.arg for each in call.keywords}
    modes = [each.value for each in call.args if isinstance(each, ast.Constant) and isinstance(each.value, str)]
    if name == "open" or (name.endswith(".open") and modes and set(modes[0]) <= set("rwabt+")):
        return "encoding" not in named and not any("b" in each for each in modes)
    if name.endswith((".read_text", ".write_text")):
        return "encoding" not in named
    return name in BARE
