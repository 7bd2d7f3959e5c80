"""What may be wrong with a file: its bytes, the words of its text, the values of its structure, the type of its arrays."""

import random
import re
from collections.abc import Callable
from typing import Any

import numpy as np

Random = random.Random
WORDS = re.compile(r"[^\s,\[\]{}:=\"']+")
NUMBERS = (
    "nan",
    "inf",
    "-inf",
    "-1",
    "0",
    "1e400",
    "1e308",
    "-1e-320",
    "99999999999999999999",
    "4294967295",
    "0x10",
    "1.5",
)
TEXTS = (
    "",
    "[/x]",
    "[bold]",
    "x" * 300,
    "\u202e",
    "\x00",
    "é\n",
    "../../etc/passwd",
    "/etc/passwd",
    "true",
    "null",
    "=1+1",
)
COUNTS = (0, 1, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 2**40, 2**63 - 1, 2**64 - 1)
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, -(2**70), 0.5, -0.0, 1e308, -1e308, 5e-324, float("nan"), float("inf"),
    "", "NaN", "Infinity", "text", "[/x]", "../../x", "\x00", [], {}, [[]], {"": None}, [None], [0.0] * 3,
)  # fmt: skip
KINDS = ("f2", "f4", "f8", "i1", "i8", "u1", "u8", "c16", "?", "U4", "S4", "M8[s]", "O", "V8", ">f8", "f4,i4")
DEPTHS = (30, 900, 20_000)


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
                lines[chance.randrange(len(lines))] = chance.choice(
                    ["", chance.choice(lines) * 2, "\n", "[" * chance.choice(DEPTHS)]
                )
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
    inside = isinstance(tree, dict | list) and len(tree) > 0
    if inside and chance.random() < 0.85:
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
