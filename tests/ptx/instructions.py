"""PTX instructions as functions of threads."""

import re
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from torch import Tensor

from tests.ptx.arithmetic import Operation, dtype, number, operation
from tests.ptx.memory import Array, Fault
from tests.ptx.program import Instruction, Program
from tests.ptx.threads import ALL, WARP, Lanes, Threads

Step = Callable[[Threads, Lanes], None]


@cache
def steps(program: Program) -> list[Step]:
    """What every instruction does to threads.  NotImplementedError for one that is not known here."""
    return [_guarded(line, _step(line, program)) for line in program.instructions]


def _guarded(line: Instruction, step: Step) -> Step:
    if line.guard is None or line.opcode[0] in ("bra", "ret"):
        return step
    name, wanted = line.guard

    def some(threads: Threads, lanes: Lanes) -> None:
        holds = threads.registers[name][lanes] == wanted
        if holds.all():
            step(threads, lanes)
        elif holds.any():
            step(threads, np.flatnonzero(holds) if lanes is ALL else lanes[holds])

    return some


def _step(line: Instruction, program: Program) -> Step:
    name, kind, operands = line.opcode[0], line.opcode[-1], line.operands
    if name == "bra":
        return _jump(line.guard, program.block_at(program.labels[operands[0]]))
    if name == "ret":
        return _jump(line.guard, program.block_at(program.end))
    if name == "bar":
        waits = "warp" not in line.opcode
        return lambda threads, lanes: threads.wait(lanes) if waits else _complete(threads, lanes)
    if name == "atom":  # a sum that gives what was there before, which nobody may want here
        return _both(_move(kind, (operands[0], "-1")), _access(("red", *line.opcode[1:]), operands[1:]))
    if name in ("ld", "st", "red"):
        return _access(line.opcode, operands)
    if name == "stmatrix":
        return _matrices(line.opcode, operands)
    if name == "shfl":
        return _exchange(line.opcode, operands)
    if name == "redux":
        return _reduction(line.opcode, operands)
    if name == "mov":
        return _move(kind, operands)
    return _computation(operation(line.opcode), operands)


def _both(first: Step, second: Step) -> Step:
    def both(threads: Threads, lanes: Lanes) -> None:
        first(threads, lanes)
        second(threads, lanes)

    return both


def _complete(threads: Threads, lanes: Lanes) -> None:
    threads.warps(threads.at[lanes], lanes)


def _jump(guard: tuple[str, bool] | None, target: int) -> Step:
    def jump(threads: Threads, lanes: Lanes) -> None:
        if guard is None:
            threads.at[lanes] = target
        else:
            threads.at[lanes] = np.where(threads.registers[guard[0]][lanes] == guard[1], target, threads.at[lanes])

    return jump


def _computation(op: Operation, operands: tuple[str, ...]) -> Step:
    put, sources = (
        _writer(operands[0], op.result),
        [_reader(x, k) for x, k in zip(operands[1:], op.operands, strict=True)],
    )
    return lambda threads, lanes: put(threads, lanes, op.function(*(get(threads, lanes) for get in sources)))


def _reader(operand: str, kind: str) -> Callable[[Threads, Lanes], Array]:
    """How an operand is read: a register, of which the lower part may be meant, a number, or a shared array's address."""
    wanted = dtype(kind)
    if operand.startswith("%") and "." not in operand:

        def get(threads: Threads, lanes: Lanes) -> Array:
            bits = threads.registers[operand][lanes]
            return (bits if bits.itemsize == wanted.itemsize else bits.astype(f"u{wanted.itemsize}")).view(wanted)

        return get
    if operand.startswith("%"):
        return lambda threads, lanes: threads.special[operand][lanes]
    constant = number("0" if operand == "global_smem" else operand, kind)
    return lambda _threads, _lanes: constant


def _writer(operand: str, kind: str) -> Callable[[Threads, Lanes, Any], None]:
    """How a register is written: a shorter number is filled up, with its sign where it has one."""
    wanted = dtype(kind)

    def put(threads: Threads, lanes: Lanes, values: Any) -> None:
        register, values = threads.registers[operand], np.asarray(values, wanted)
        if values.itemsize != register.itemsize:
            values = values.astype(("i" if wanted.kind == "i" else "u") + str(register.itemsize))
        register[lanes] = values.view(register.dtype)

    return put


def _move(kind: str, operands: tuple[str, ...]) -> Step:
    to, source = operands
    if to.startswith("{"):  # a number's halves
        low, high = (_writer(name, "b32") for name in re.findall(r"%?\w+", to))
        get = _reader(source, "b64")

        def part(threads: Threads, lanes: Lanes) -> None:
            whole = get(threads, lanes)
            low(threads, lanes, whole.astype(np.uint32))
            high(threads, lanes, (whole >> np.uint64(32)).astype(np.uint32))

        return part
    if source.startswith("{"):
        low_of, high_of = (_reader(name, "b32") for name in re.findall(r"%?\w+", source))
        put = _writer(to, "b64")

        def whole(threads: Threads, lanes: Lanes) -> None:
            halves = (get(threads, lanes).astype(np.uint64) for get in (low_of, high_of))
            put(threads, lanes, next(halves) | next(halves) << np.uint64(32))

        return whole
    put, get = _writer(to, kind), _reader(source, kind)
    return lambda threads, lanes: put(threads, lanes, get(threads, lanes))


def _access(opcode: tuple[str, ...], operands: tuple[str, ...]) -> Step:
    """Loads, stores and atomic sums of one number a thread, or of several side by side."""
    name, space, kind = opcode[0], opcode[1], opcode[-1]
    place, rest = (operands[1], operands[0]) if name == "ld" else operands
    base, offset = _place(place)
    if space == "param":
        return _parameter(base, kind, _writer(rest, kind))
    names, wanted = re.findall(r"[%\w]+", rest), dtype(kind)
    address_of = _reader(base, "u64" if space == "global" else "u32")
    places = [np.uint64(offset + wanted.itemsize * i) for i in range(len(names))]
    access = {"global": _global, "shared": _shared}[space](name, wanted)
    readers, writers = [_reader(x, kind) for x in names], [_writer(x, kind) for x in names]

    def step(threads: Threads, lanes: Lanes) -> None:
        base_address = np.broadcast_to(address_of(threads, lanes).astype(np.uint64), threads.block[lanes].shape)
        if ((base_address + places[0]) % np.uint64(wanted.itemsize * len(names))).any():
            raise Fault("an access that is not aligned to its width")
        for address, get, put in zip(places, readers, writers, strict=True):
            if name == "ld":
                put(threads, lanes, access(threads, lanes, base_address + address))
            else:
                values = np.broadcast_to(get(threads, lanes), base_address.shape)
                access(threads, lanes, base_address + address, np.ascontiguousarray(values))

    return step


def _global(name: str, kind: np.dtype) -> Callable[..., Any]:
    if name == "ld":
        return lambda threads, lanes, address: threads.memory.load(address, kind, threads.block[lanes] + 1)
    if name == "st":
        return lambda threads, lanes, address, values: threads.memory.store(address, values, threads.block[lanes] + 1)
    return lambda threads, _lanes, address, values: threads.memory.add(address, values)


def _shared(name: str, kind: np.dtype) -> Callable[..., Any]:
    def access(threads: Threads, lanes: Lanes, address: Array, values: Array | None = None) -> Array | None:
        if int(address.max()) + kind.itemsize > threads.shared.shape[1]:
            raise Fault("an access outside of the block's shared memory")
        numbers = threads.shared.view(kind)
        at = threads.block[lanes] - threads.block[0], (address // np.uint64(kind.itemsize)).astype(np.int64)
        if values is None:
            return numbers[at]
        numbers[at] = values

    return access


def _parameter(name: str, kind: str, put: Callable[[Threads, Lanes, Any], None]) -> Step:
    def step(threads: Threads, lanes: Lanes) -> None:
        value = threads.parameters[name]
        if isinstance(value, Tensor):
            put(threads, lanes, np.uint64(value.data_ptr()))
        else:
            bits = (
                np.float32(value).view(np.uint32)
                if isinstance(value, float)
                else value % 2 ** (8 * dtype(kind).itemsize)
            )
            put(threads, lanes, np.array(bits, f"u{dtype(kind).itemsize}").view(dtype(kind)))

    return step


def _matrices(opcode: tuple[str, ...], operands: tuple[str, ...]) -> Step:
    """Stores matrices of 8 x 8 halves of words, four threads a row: thread 8 m + r knows where row r of matrix m goes."""
    names = re.findall(r"[%\w]+", operands[1])
    if opcode[1:5] != ("sync", "aligned", "m8n8", f"x{len(names)}") or "trans" in opcode:
        raise NotImplementedError(f"the instruction {'.'.join(opcode)}")
    (base, offset), use = _place(operands[0]), [_reader(name, "b32") for name in names]
    address_of, access, lane = _reader(base, "u32"), _shared("st", np.dtype("u4")), np.arange(WARP)

    def step(threads: Threads, lanes: Lanes) -> None:
        rows = threads.warps(address_of(threads, lanes).astype(np.uint64) + np.uint64(offset), lanes)
        if (rows % np.uint64(16)).any():
            raise Fault("a row that is not aligned to its width")
        for matrix, get in enumerate(use):
            address = rows[:, 8 * matrix + lane // 4] + (4 * (lane % 4)).astype(np.uint64)
            access(threads, lanes, address.ravel(), get(threads, lanes))

    return step


def _place(operand: str) -> tuple[str, int]:
    """The base and the offset of an address in brackets."""
    base, offset = re.fullmatch(r"\[\s*([%\w]+)\s*\+?\s*(-?\d*)\s*\]", operand).groups()  # pyright: ignore[reportOptionalMemberAccess]
    return base, int(offset or 0)


def _exchange(opcode: tuple[str, ...], operands: tuple[str, ...]) -> Step:
    mode, (to, source, other, clamp, mask) = opcode[2], operands
    if (mode, clamp, mask) not in (("bfly", "31", "-1"), ("idx", "31", "-1")):
        raise NotImplementedError(f"the exchange {opcode} of {operands}")
    put, get, which = _writer(to, "b32"), _reader(source, "b32"), _reader(other, "u32")

    def step(threads: Threads, lanes: Lanes) -> None:
        values, partner = threads.warps(get(threads, lanes), lanes), which(threads, lanes)
        partner = np.broadcast_to(partner, values.size).reshape(values.shape).astype(np.int64)
        partner = partner % WARP if mode == "idx" else np.arange(WARP) ^ partner
        put(threads, lanes, np.take_along_axis(values, partner, 1).ravel())

    return step


def _reduction(opcode: tuple[str, ...], operands: tuple[str, ...]) -> Step:
    reduce = {"max": np.max, "min": np.min, "add": np.sum}[opcode[2]]
    put, get, mask_of = _writer(operands[0], opcode[-1]), _reader(operands[1], opcode[-1]), _reader(operands[2], "s32")

    def step(threads: Threads, lanes: Lanes) -> None:
        if (np.asarray(mask_of(threads, lanes)) != -1).any():
            raise NotImplementedError("a reduction over part of a warp")
        values = threads.warps(get(threads, lanes), lanes)
        put(threads, lanes, np.broadcast_to(reduce(values, 1, keepdims=True), values.shape).ravel())

    return step
