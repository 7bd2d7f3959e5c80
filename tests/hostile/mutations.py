"""What may be wrong with a file: its bytes, the words of its text, the values of its structure, the type of its arrays."""

import gzip
import io
import json
import math
import random
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tests.splat.model.files.written import zipped

Random = random.Random
WORDS = re.compile(r"[^\s,\[\]{}:=\"']+")
NUMBERS = ("nan", "inf", "-inf", "-1", "0", "1e400", "1e308", "-1e-320", "9" * 20, "4294967295", "0x10", "1.5")
TEXTS = (
    "", "[/x]", "[bold]", "x" * 300, "\u202e", "\0", "é\n", "../../etc/passwd", "/etc/passwd", "true", "null", "=1+1",
)  # fmt: skip
COUNTS = (0, 1, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 2**40, 2**63 - 1, 2**64 - 1)
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, -(2**70), 0.5, -0.0, 1e308, -1e308, 5e-324, math.nan, math.inf,
    "", "NaN", "Infinity", "text", "[/x]", "../../x", "\0", [], {}, [[]], {"": None}, [None], [0.0] * 3,
)  # fmt: skip
KINDS = ("f2", "f4", "f8", "i1", "i8", "u1", "u8", "c16", "?", "U4", "S4", "M8[s]", "O", "V8", ">f8", "f4,i4")
DTYPES = (torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.bool, torch.cfloat)
DEPTHS = (30, 900, 20_000)
BOMB = 3 * 10**6  # zeros, a hundred times what the file takes


def of_file(chance: Random, name: str, content: bytes) -> tuple[bytes, bool]:
    """A broken file, by what its suffix says that it holds; and whether its bytes were changed without regard to that."""
    suffix = Path(name).suffix
    if (suffix in ("", ".txt", ".csv", ".toml", ".json") or b"format ascii" in content[:99]) and chance.random() < 0.6:
        return of_text(chance, content.decode()).encode(), False
    if suffix in STRUCTURES and chance.random() < 0.7:
        return STRUCTURES[suffix](chance, content), False
    return of_bytes(chance, content), True


def of_bytes(chance: Random, content: bytes) -> bytes:
    """One to three of: bits turned, a run overwritten, a count written, cut, something doubled, removed or put in."""
    result = bytearray(content)
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        place, size = chance.randrange(len(result) + 1), chance.choice((1, 2, 4, 8, 64, 700))
        match chance.randrange(8):
            case 0 | 1 if result:
                result[place % len(result)] ^= 1 << chance.randrange(8)
            case 2:
                result[place : place + size] = bytes([chance.choice((0, 0xFF, 0x7F, 0x20))]) * size
            case 3:
                width = chance.choice((4, 8))
                place -= place % chance.choice((1, width))
                result[place : place + width] = (chance.choice(COUNTS) % 256**width).to_bytes(width, "little")
            case 4:
                del result[place:]
            case 5:
                result[place:place] = result[place : place + size]
            case 6:
                del result[place : place + size]
            case _:
                result[place:place] = chance.randbytes(size)
    return bytes(result)


def of_text(chance: Random, text: str) -> str:
    """One to three words replaced, or lines removed, doubled, swapped or cut."""
    for _ in range(chance.choice((1, 1, 2, 3))):
        words, lines = list(WORDS.finditer(text)), text.splitlines(keepends=True)
        match chance.randrange(6):
            case 0 | 1 | 2 if words:
                word = chance.choice(words)
                new = chance.choice(NUMBERS + TEXTS) if chance.random() < 0.8 else chance.choice(words)[0]
                text = text[: word.start()] + new + text[word.end() :]
            case 3 if lines:
                others = ["", chance.choice(lines) * 2, "\n", "[" * chance.choice(DEPTHS)]
                lines[chance.randrange(len(lines))] = chance.choice(others)
                text = "".join(lines)
            case 4 if lines:
                chance.shuffle(lines)
                text = "".join(lines)
            case _:
                text = text[: chance.randrange(len(text) + 1)]
    return text


def of_tree(chance: Random, tree: Any, odd: Callable[[Random, Any], Any] | None = None) -> Any:
    """Mappings and lists with one to three entries replaced, removed, renamed, doubled or buried deep.

    odd: makes something of a value, beside VALUES.
    """
    for _ in range(chance.choice((1, 1, 2, 3))):
        tree = _changed(chance, tree, odd)
    return tree


def _changed(chance: Random, tree: Any, odd: Callable[[Random, Any], Any] | None) -> Any:
    if isinstance(tree, dict | list) and len(tree) > 0 and chance.random() < 0.85:
        copy = dict(tree) if isinstance(tree, dict) else list(tree)
        key = chance.choice(list(copy)) if isinstance(copy, dict) else chance.randrange(len(copy))
        match chance.randrange(20):
            case 0:
                del copy[key]
            case 1 if isinstance(copy, dict):
                copy[chance.choice(["", "x", "[/x]", "format", 7])] = copy.pop(key)
            case 1 if isinstance(copy, list):
                copy.insert(key, copy[key])
            case _:
                copy[key] = _changed(chance, copy[key], odd)
        return copy
    if odd is not None and chance.random() < 0.5:
        return odd(chance, tree)
    if chance.random() < 0.03:
        for _ in range(DEPTHS[0] if odd else chance.choice(DEPTHS[:2])):  # pickle itself does not go deep
            tree = [tree]
        return tree
    return chance.choice(VALUES)


def of_array(chance: Random, array: np.ndarray) -> np.ndarray:
    """Another type, shape or order, or values that are not finite, huge or out of order."""
    with np.errstate(all="ignore"):
        match chance.randrange(7):
            case 0 | 1:
                kind = np.dtype(chance.choice(KINDS))
                return np.zeros(array.shape, kind) if {kind.kind, array.dtype.kind} & {*"VMOUS"} else array.astype(kind)
            case 2:
                return array.reshape(chance.choice([(-1,), (1, *array.shape), (*array.shape, 1), (array.size, 1)]))
            case 3:
                return array[..., :0] if array.ndim else array.reshape(1)[:0]
            case 4:
                return np.asfortranarray(np.atleast_1d(array)[::-1])
            case 5:
                return np.concatenate([array, array]) if array.ndim else np.stack([array, array])
            case _:
                copy = array.copy()
                value = chance.choice([np.nan, np.inf, -np.inf, 1e308, -1, 0, 5e-324])
                if copy.size and copy.dtype.kind == "f":
                    copy.flat[chance.randrange(copy.size)] = value
                return copy


def odd_tensor(chance: Random, value: Any) -> Any:
    """Something else in place of a tensor, or a tensor in place of something else."""
    plain = isinstance(value, torch.Tensor) and not value.is_nested and value.layout is torch.strided
    plain = plain and value.device.type == "cpu" and not value.is_quantized and value.numel() < 10**6
    n = value.numel() if plain else 3
    base = value if plain else torch.ones(3)  # a second change may meet what the first one made
    made: list[Callable[[], Any]] = [
        lambda: torch.zeros(n, dtype=chance.choice(DTYPES)),
        lambda: torch.zeros(chance.choice([0, 1, n + 1, 7, 14 * 10**4])),
        lambda: torch.zeros(1).expand(chance.choice([n, 10**10])),
        lambda: torch.full((n,), chance.choice([math.nan, math.inf, -1.0, 1e38, 1e-45, 300.0])),
        lambda: torch.zeros(n).to_sparse(),
        lambda: torch.zeros(n, requires_grad=True),
        lambda: torch.nn.Parameter(torch.zeros(n)),
        lambda: torch.nested.nested_tensor([torch.zeros(n)]),
        lambda: torch.zeros(n, device="meta"),
        lambda: torch.quantize_per_tensor(torch.zeros(n), 0.1, 0, torch.qint8),
        lambda: base[::2],
        lambda: base.reshape(1, -1),
        lambda: torch.view_as_complex(torch.zeros(n, 2)).conj(),
        lambda: torch.zeros(n)._neg_view(),
        lambda: base.clone().index_fill_(0, torch.tensor([0]), chance.choice([2, 100, -3])) if base.numel() else base,
    ]  # fmt: skip
    return chance.choice(made)()


def json_of(tree: Any) -> bytes:
    try:
        return json.dumps(tree).encode("utf-8", "surrogatepass")
    except RecursionError:  # buried twice, deeper than the encoder goes
        return b"[" * DEPTHS[-1] + b"]" * DEPTHS[-1]


def _npy(chance: Random, content: bytes) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, of_array(chance, np.load(io.BytesIO(content))), allow_pickle=True)
    return buffer.getvalue()


def _npz(chance: Random, content: bytes) -> bytes:
    """One or two arrays, or what holds them."""
    arrays: dict[str, Any] = dict(np.load(io.BytesIO(content)))
    for key in chance.choices(list(arrays), k=chance.choice((1, 1, 2))):
        arrays[key] = of_array(chance, arrays[key])
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return rezipped(chance, buffer.getvalue()) if chance.random() < 0.3 else buffer.getvalue()


def _of_torch(chance: Random, content: bytes) -> bytes:
    """Structure, or a pickle with right checksums, or what holds them."""
    if chance.random() < 0.3:
        members = _members(content)
        pickle = next(member for member in members if member.endswith("data.pkl"))
        return zipped({**members, pickle: of_bytes(chance, members[pickle])})
    tree: Any = torch.load(io.BytesIO(content), weights_only=False)  # our own
    buffer = io.BytesIO()
    torch.save(of_tree(chance, tree, odd_tensor), buffer)
    return rezipped(chance, buffer.getvalue()) if chance.random() < 0.1 else buffer.getvalue()


def _sog(chance: Random, content: bytes) -> bytes:
    members = _members(content)
    member = chance.choice(list(members))
    return zipped({**members, member: of_file(chance, member, members[member])[0]})


def _members(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def rezipped(chance: Random, content: bytes) -> bytes:
    """The same members compressed, in another order, one doubled, or one of a bomb's size."""
    members, result = list(_members(content).items()), io.BytesIO()
    chance.shuffle(members)
    with zipfile.ZipFile(result, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as new:
        for member, data in members:
            new.writestr(member, data + bytes(chance.choice([0, 0, 0, BOMB])))
        if chance.random() < 0.2:
            name = chance.choice(["x.npy", "../x.npy", "archive/data/99", members[0][0]])
            new.writestr(name, bytes(chance.choice([0, BOMB])))
    return result.getvalue()


STRUCTURES: dict[str, Callable[[Random, bytes], bytes]] = {
    ".json": lambda chance, content: json_of(of_tree(chance, json.loads(content))), ".npy": _npy, ".npz": _npz,
    ".pt": _of_torch, ".pth": _of_torch, ".ckpt": _of_torch, ".sog": _sog,
    ".spz": lambda chance, content: gzip.compress(of_bytes(chance, gzip.decompress(content)), 1),
}  # fmt: skip
