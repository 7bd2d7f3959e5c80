"""Some blocks of a launch's threads, side by side: an array for every register, in which a thread has a place."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from tests.ptx.memory import Array, Fault, Memory
from tests.ptx.program import Program

WARP = 32
ALL = slice(None)
Lanes = Any  # indices of threads, or ALL


class Threads:
    """Some blocks of threads of a launch, and all they hold."""

    def __init__(
        self,
        program: Program,
        memory: Memory,
        blocks: Array,
        grid: tuple[int, ...],
        warps: int,
        shared: int,
        arguments: Sequence[Tensor | int | float],
    ):
        self.program, self.memory, self.size = program, memory, WARP * warps
        self.block = np.repeat(blocks, self.size).astype(np.int32)
        self.count = len(self.block)
        self.registers = {
            f"%{prefix}{i}": np.zeros(self.count, bool if prefix == "p" else f"u{bits // 8}")
            for prefix, (bits, many) in program.registers.items()
            for i in range(many)
        } | {"_": np.zeros(self.count, np.uint32)}  # where halves go that nobody wants
        index = np.unravel_index(self.block, grid[::-1])[::-1]
        self.special = {f"%ctaid.{axis}": place.astype(np.uint32) for axis, place in zip("xyz", index, strict=True)}
        self.special |= {
            f"%nctaid.{axis}": np.full(self.count, n, np.uint32) for axis, n in zip("xyz", grid, strict=True)
        }
        self.special["%tid.x"] = np.tile(np.arange(self.size, dtype=np.uint32), len(blocks))
        self.shared = np.zeros((len(blocks), max(shared, 8)), np.uint8)
        self.parameters = dict(zip(program.parameters, arguments, strict=False))
        self.at = np.zeros(self.count, np.int64)  # where every thread goes on: in which of the program's blocks

    def warps(self, values: Array, lanes: Lanes) -> Array:
        """Values of lanes by warp, (warps, 32).  Fault where a warp is not complete."""
        if lanes is not ALL:
            by_warp = lanes.reshape(-1, WARP) if len(lanes) % WARP == 0 else None
            if by_warp is None or (by_warp != by_warp[:, :1] // WARP * WARP + np.arange(WARP)).any():
                raise Fault("threads of a warp are missing")
        return values.reshape(-1, WARP)

    def wait(self, lanes: Lanes) -> None:
        """A barrier of a block."""
        here = np.zeros(self.count, bool)
        here[lanes] = True
        elsewhere = (self.at < len(self.program.blocks)) & ~here
        if np.isin(self.block[lanes], self.block[elsewhere]).any():
            raise Fault("threads of a block are missing")
