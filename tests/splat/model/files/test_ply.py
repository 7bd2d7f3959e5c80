"""PLY files: every byte order gives the same numbers, and what is cut short or no PLY is refused."""

import numpy as np
import pytest

from splat.model.files.ply import TYPES, ply_bytes, read_header, read_rows
from tests.refusals import refused
from tests.splat.model.files.written import ply

COLUMNS = {"x": np.array([1.5, -2.0]), "weight": np.array([0.25, 1e30])}


HEAD = "ply\nformat binary_little_endian 1.0\n"
LIST = "element vertex 1\nproperty list int int x\nend_header\n"


def read(content: bytes):
    return read_rows(content, read_header(content))


@pytest.mark.parametrize("order", ["<", ">", ""])
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_numbers_are_the_same_in_every_byte_order_and_in_text(order, kind):
    rows = read(ply(COLUMNS, order=order, kind=kind))
    assert rows.names == ("x", "weight")
    for name, column in COLUMNS.items():
        np.testing.assert_array_equal(rows.numbers[name], column.astype(kind))


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_lists_are_read_between_numbers_of_every_type(form):
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(form)
    header = f"ply\nformat {form} 1.0\nelement vertex 2\n"
    header += "".join(f"property {name} p{i}\n" for i, name in enumerate(TYPES))
    header += "property list uchar int views\nproperty short last\nend_header\n"
    body = b""
    for views, last in (([7, -8, 9], 5), ([], -6)):
        if order:
            body += b"".join(np.array(i, order + kind).tobytes() for i, kind in enumerate(TYPES.values()))
            body += bytes([len(views)]) + np.array(views, order + "i4").tobytes()
            body += np.array(last, order + "i2").tobytes()
        else:
            body += " ".join(map(str, [*range(len(TYPES)), len(views), *views, last])).encode() + b"\n"
    rows = read(header.encode() + body)
    assert [list(views) for views in rows.lists["views"]] == [[7, -8, 9], []]
    assert rows.numbers["last"].tolist() == [5, -6]
    assert [rows.numbers[f"p{i}"][0] for i in range(len(TYPES))] == list(range(len(TYPES)))


def test_what_is_written_is_read():
    numbers = np.array([(1.5, 2), (-1.0, 255)], [("x", "f8"), ("red", "u1")])
    views = [np.array([1, 2], np.int32), np.array([], np.int32)]
    content = ply_bytes(numbers, ["a comment"], {"views": views})
    assert read_header(content).comments == ("a comment",)
    rows = read(content)
    assert np.array_equal(rows.numbers, numbers)
    assert [list(each) for each in rows.lists["views"]] == [[1, 2], []]


def test_an_element_before_the_vertices_is_passed_over():
    header = f"{HEAD}element other 2\nproperty short a\nelement vertex 1\nproperty uchar b\nend_header\n"
    assert read(header.encode() + bytes([1, 0, 2, 0, 9])).numbers["b"].tolist() == [9]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "does not begin"),
        ("ply\nformat ascii 1.0\n", "does not begin"),
        (f"{HEAD}element vertex 3\nproperty float x\nend_header\n12345678901", "promises 3 vertex, at least 12"),
        (f"{HEAD}element vertex 999999999999999\nproperty float x\nend_header\n", "promises 999999999999999"),
        (f"{HEAD}element vertex -1\nproperty float x\nend_header\n", "no PLY"),
        (f"{HEAD}element face 0\nproperty float x\nend_header\n", "no element 'vertex'"),
        (f"{HEAD}element vertex 0\nproperty half x\nend_header\n", "property half x"),
        (f"{HEAD}element vertex 0\nproperty int x\nproperty int x\nend_header\n", "'x' twice"),
        (f"{HEAD}property float x\nelement vertex 0\nend_header\n", "no PLY"),
        ("ply\nformat binary_middle 1.0\nelement vertex 0\nend_header\n", "no PLY"),
        ("ply\nelement vertex 0\nproperty float x\nend_header\n", "does not name a format"),
        ("ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1 two\n", "no row of numbers"),
        (f"{HEAD}{LIST}\xff\xff\xff\x7f", "more than the file"),
        (f"{HEAD}{LIST}\xff\xff\xff\xff", "-1 numbers"),
    ],
)
def test_what_is_no_ply_is_refused(content, message):
    refused(message, read, content.encode("latin-1"))
