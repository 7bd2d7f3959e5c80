"""PLY files: a header in text, then the rows of each element in binary of either byte order, or in text.

    element NAME COUNT
    property TYPE NAME                     a number in every row of the element above
    property list COUNT_TYPE TYPE NAME     in every row a count and so many numbers

The rows of one element are read, those of the elements after it are not.  Nothing is allocated for rows that the file is too
short to hold.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from landscape.errors import InputError

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
NAMES = {kind: name for name, kind in reversed(TYPES.items())}  # the first name of each
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
MAGIC, END, LONGEST_HEADER = b"ply", b"end_header", 1 << 20


@dataclass(frozen=True)
class Property:
    """kind: a NumPy type such as f4; count: that of a list's count, None of a single number."""

    name: str
    kind: str
    count: str | None = None


@dataclass(frozen=True)
class Element:
    name: str
    rows: int
    properties: tuple[Property, ...]

    def dtype(self, order: str) -> np.dtype:
        """The type of the single numbers of a row; order: < or >."""
        return np.dtype([(p.name, order + p.kind) for p in self.properties if p.count is None])

    @property
    def lists(self) -> tuple[Property, ...]:
        return tuple(p for p in self.properties if p.count is not None)

    def least_bytes(self, order: str) -> int:
        """Least size of all rows; in text a digit and a space for each number."""
        if not order:
            return 2 * len(self.properties) * self.rows
        return self.rows * (self.dtype(order).itemsize + sum(np.dtype(p.count).itemsize for p in self.lists))


@dataclass(frozen=True)
class Header:
    """order: of the bytes, < or >, empty in text; start: where the rows begin."""

    order: str
    comments: tuple[str, ...]
    elements: tuple[Element, ...]
    start: int

    def element(self, name: str) -> Element:
        """InputError where there is none."""
        for element in self.elements:
            if element.name == name:
                return element
        raise InputError(f"it has no element {name!r}")


@dataclass(frozen=True, eq=False)
class Rows:
    """numbers: a structured array with a field for each property; lists: those properties that have several in a row."""

    numbers: np.ndarray
    lists: dict[str, list[np.ndarray]]

    @property
    def names(self) -> tuple[str, ...]:
        return self.numbers.dtype.names or ()

    def __len__(self) -> int:
        return len(self.numbers)


def read_header(content: bytes) -> Header:
    """InputError where it is none, or promises more than the content has."""
    end = content.find(END, 0, LONGEST_HEADER)
    newline = content.find(b"\n", end)
    if not content.startswith(MAGIC) or end < 0 or newline < 0:
        raise InputError("it does not begin with the header of a PLY file")
    order, comments, elements = None, [], []
    for line in content[:end].decode("utf-8", errors="replace").split("\n")[1:]:  # no other character ends a line
        match line.split(maxsplit=1)[:1], line.split():
            case ["comment" | "obj_info"], _:
                comments.append(line.split(maxsplit=1)[1] if len(line.split()) > 1 else "")
            case _, ["format", name, _] if name in ORDERS:
                order = ORDERS[name]
            case _, ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 16:
                elements.append(Element(name, int(count), ()))
            case _, ["property", *words] if elements and (found := _property(words)):
                elements[-1] = _with(elements[-1], found)
            case _, []:
                pass
            case _:
                raise InputError(f"its header has the line {line[:80]!r}, which is no PLY")
    if order is None:
        raise InputError("its header does not name a format that is known")
    header = Header(order, tuple(comments), tuple(elements), newline + 1)
    promised = sum(element.least_bytes(order) for element in elements)
    if promised > len(content) - header.start + (not order):  # the last number in text needs no space
        counts = ", ".join(f"{element.rows} {element.name}" for element in elements)
        raise InputError(
            f"it promises {counts}, at least {promised} bytes, and has {len(content) - header.start}: it is cut short"
        )
    return header


def _property(words: list[str]) -> Property | None:
    match words:
        case [kind, name] if kind in TYPES:
            return Property(name, TYPES[kind])
        case ["list", count, kind, name] if count in TYPES and kind in TYPES and TYPES[count][0] in "iu":
            return Property(name, TYPES[kind], TYPES[count])
    return None


def _with(element: Element, added: Property) -> Element:
    if any(p.name == added.name for p in element.properties):
        raise InputError(f"its element {element.name!r} has the property {added.name[:80]!r} twice")
    return Element(element.name, element.rows, (*element.properties, added))


def read_rows(content: bytes, header: Header, name: str = "vertex") -> Rows:
    """The rows of an element.  InputError where they are not all there."""
    element, place = header.element(name), header.start
    before = header.elements[: header.elements.index(element)]
    if not header.order:
        words = iter(content[place:].split())
        for other in before:
            _text_rows(other, words)
        return _text_rows(element, words)
    for other in before:
        if other.lists:
            raise InputError(f"its element {other.name!r} with lists stands before {name!r}; write that first")
        place += other.least_bytes(header.order)
    dtype = element.dtype(header.order)
    if not element.lists:
        return Rows(np.frombuffer(content, dtype, element.rows, place), {})
    return _binary_rows(element, content, place, header.order)


def _binary_rows(element: Element, content: bytes, place: int, order: str) -> Rows:
    """Rows of different lengths, one after the other."""
    numbers = bytearray()
    lists: dict[str, list[np.ndarray]] = {p.name: [] for p in element.lists}
    sizes = [(p, np.dtype(order + (p.count or p.kind))) for p in element.properties]
    for _ in range(element.rows):
        for p, kind in sizes:
            if place + kind.itemsize > len(content):
                raise InputError("its rows end before all of them were read: it is cut short")
            if p.count is None:
                numbers += content[place : place + kind.itemsize]
                place += kind.itemsize
                continue
            count = int(np.frombuffer(content, kind, 1, place)[0])
            place, values = place + kind.itemsize, np.dtype(order + p.kind)
            if count < 0 or place + count * values.itemsize > len(content):
                raise InputError(f"a list {p.name!r} of its rows has {count} numbers, more than the file")
            lists[p.name].append(np.frombuffer(content, values, count, place))
            place += count * values.itemsize
    return Rows(np.frombuffer(bytes(numbers), element.dtype(order), element.rows), lists)


def _text_rows(element: Element, words: Iterator[bytes]) -> Rows:
    numbers = np.zeros(element.rows, element.dtype("="))
    lists: dict[str, list[np.ndarray]] = {p.name: [] for p in element.lists}
    columns: dict[str, list[float]] = {name: [] for name in numbers.dtype.names or ()}
    try:
        for _ in range(element.rows):
            for p in element.properties:
                if p.count is None:
                    columns[p.name].append(float(next(words)))
                else:
                    values = [float(next(words)) for _ in range(int(next(words)))]
                    lists[p.name].append(np.array(values).astype(p.kind))
        with np.errstate(all="ignore"):  # a number outside its type is found by whoever asks for finite ones
            for name, column in columns.items():
                numbers[name] = np.array(column).astype(numbers.dtype[name])
    except StopIteration:
        raise InputError("its rows end before all of them were read: it is cut short") from None
    except ValueError as error:
        raise InputError(f"one of its rows is no row of numbers ({error})") from error
    return Rows(numbers, lists)


def ply_bytes(
    numbers: np.ndarray, comments: Sequence[str] = (), lists: Mapping[str, Sequence[np.ndarray]] | None = None
) -> bytes:
    """A binary little-endian file with the one element `vertex`.

    numbers: a structured array; lists: further properties, of whole numbers of 32 bits, with several in each row.
    """
    lists, dtype = lists or {}, numbers.dtype
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header += [f"element vertex {len(numbers)}"]
    header += [f"property {NAMES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    header += [f"property list uint int {name}" for name in lists]
    body = numbers.astype(dtype.newbyteorder("<")).tobytes()
    if lists:
        rows, size = [], dtype.itemsize
        for i in range(len(numbers)):
            rows.append(body[i * size : (i + 1) * size])
            for each in lists.values():
                rows += [np.uint32(len(each[i])).tobytes(), np.asarray(each[i], "<i4").tobytes()]
        body = b"".join(rows)
    return "\n".join([*header, "end_header\n"]).encode() + body
