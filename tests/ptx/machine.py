"""Runs a kernel's PTX on the CPU: all threads of a launch side by side, an instruction at a time.

Threads that part at a jump go on in the order of `Program.blocks`, so they meet where their ways do.  What needs others'
company (exchanges within a warp, barriers) faults where somebody is missing.  Shared memory is a block's own.
"""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from tests.ptx.instructions import steps
from tests.ptx.memory import Fault, Memory
from tests.ptx.program import parse
from tests.ptx.threads import ALL, WARP, Lanes, Threads

TOGETHER = 1 << 14  # threads at a time: blocks one after the other, as on a small GPU


def launch(
    text: str, grid: tuple[int, ...], warps: int, shared: int, arguments: Sequence[Tensor | int | float]
) -> None:
    """Run the kernel of a PTX file.  shared: bytes of shared memory a block.  Fault: see `memory`, and above."""
    program, memory = parse(text), Memory([x for x in arguments if isinstance(x, Tensor)])
    blocks, many = int(np.prod(grid)), max(1, TOGETHER // (WARP * warps))
    with np.errstate(all="ignore"):
        for first in range(0, blocks, many):
            some = np.arange(first, min(first + many, blocks))
            run(Threads(program, memory, some, grid, warps, shared, arguments))


def run(threads: Threads) -> None:
    """To the end of every thread."""
    program, instructions = threads.program, steps(threads.program)
    following = [program.block_at(last) for _, last in program.blocks]
    while (block := int(threads.at.min())) < len(program.blocks):
        lanes: Lanes = np.flatnonzero(threads.at == block)
        lanes = ALL if len(lanes) == threads.count else lanes
        threads.at[lanes] = following[block]
        for i in range(*program.blocks[block]):
            try:
                instructions[i](threads, lanes)
            except Fault as fault:
                raise Fault(f"{program.name}: {program.instructions[i].text}: {fault}") from None
