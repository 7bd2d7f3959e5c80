"""PTX as Triton's compiler writes it: instructions, and where the jumps go.

opcode     its dotted parts: ("ld", "global", "v2", "b32")
operands   names of registers ("%r1"), numbers as text, names of parameters, groups in braces, addresses in brackets
guard      the predicate that an instruction is executed under, and whether it must be true
"""

import re
from dataclasses import dataclass
from functools import cache, cached_property

import networkx as nx

WIDTHS = {"pred": 8, "b16": 16, "b32": 32, "b64": 64}
_DECLARATION = re.compile(r"\.reg \.(\w+)\s+%(\w+)<(\d+)>")
_GUARD = re.compile(r"@(!?)(%\w+)\s+(.*)", re.DOTALL)
_OPERAND = re.compile(r"\{[^}]*\}|\[[^]]*\]|[^\s,{}\[\]]+")
_HALVES = re.compile(r"\{ \.reg \.b32 tmp; (.*?;) \}")  # a register of its own for the half that nobody wants


@dataclass(frozen=True)
class Instruction:
    """One line of a kernel."""

    opcode: tuple[str, ...]
    operands: tuple[str, ...]
    guard: tuple[str, bool] | None
    text: str


@dataclass(frozen=True, eq=False)
class Program:
    """A kernel. registers: bits by prefix ("r": 32) with how many; labels: the instruction that follows each."""

    name: str
    parameters: tuple[str, ...]
    registers: dict[str, tuple[int, int]]
    instructions: tuple[Instruction, ...]
    labels: dict[str, int]

    @property
    def end(self) -> int:
        """Behind the last instruction."""
        return len(self.instructions)

    @cached_property
    def blocks(self) -> list[tuple[int, int]]:
        """Instructions first .. last - 1 that are run in one go, in an order in which threads that part meet where they can.

        Every block comes behind those that lead to it, loops aside; and what follows a loop behind all of the loop.
        """
        jumps = [i for i, line in enumerate(self.instructions) if line.opcode[0] in ("bra", "ret")]
        targets = {self.labels[line.operands[0]] for line in self.instructions if line.opcode[0] == "bra"}
        starts = sorted({0, *targets, *(i + 1 for i in jumps)} - {self.end})
        lasts = dict(zip(starts, [*starts[1:], self.end], strict=True))
        ways = nx.DiGraph()
        ways.add_nodes_from(starts)
        for first, last in lasts.items():
            line = self.instructions[last - 1]
            if line.opcode[0] == "bra":
                ways.add_edge(first, self.labels[line.operands[0]])
            if last in lasts and (line.guard or line.opcode[0] not in ("bra", "ret")):
                ways.add_edge(first, last)
        return [(first, lasts[first]) for first in _in_order(ways, 0)]

    def block_at(self, first: int) -> int:
        """Which block begins with an instruction; behind the last one, the number of blocks."""
        return self._block_of.get(first, len(self.blocks))

    @cached_property
    def _block_of(self) -> dict[int, int]:
        return {first: block for block, (first, _) in enumerate(self.blocks)}


def _in_order(ways: nx.DiGraph, entry: int) -> list[int]:
    """The blocks of a part of a program: those of a loop side by side, beginning with the one by which it is entered."""
    ahead = ways.copy()
    ahead.remove_edges_from(list(ways.in_edges(entry)))
    condensed = nx.condensation(ahead)
    found: list[int] = []
    for component in nx.lexicographical_topological_sort(condensed, lambda c: min(condensed.nodes[c]["members"])):
        members = condensed.nodes[component]["members"]
        if len(members) == 1:
            found += members
        else:
            entered = [to for source, to in ahead.in_edges(members) if source not in members]
            found += _in_order(ahead.subgraph(members), min(entered))
    return found


@cache
def parse(text: str) -> Program:
    """The one kernel of a PTX file.  ValueError where there is none, or several."""
    text = re.sub(r"//[^\n]*", "", text)
    entries = re.findall(r"\.entry (\w+)\((.*?)\)[^{]*\{(.*?)\n\}", text, re.DOTALL)
    if len(entries) != 1:
        raise ValueError(f"expected one kernel, got {len(entries)}")
    (name, parameters, body) = entries[0]
    registers = {prefix: (WIDTHS[kind], int(count)) for kind, prefix, count in _DECLARATION.findall(body)}
    body = _HALVES.sub(
        lambda found: found[1].replace("tmp", "_"),
        re.sub(r"^\s*\.(loc|reg|file|section)\b[^\n]*", "", body, flags=re.MULTILINE),
    )
    instructions, labels = [], {}
    for statement in re.sub(r"^(\$\w+:)", r"\1;", body, flags=re.MULTILINE).split(";"):
        statement = statement.strip()
        if statement.endswith(":"):
            labels[statement[:-1]] = len(instructions)
        elif statement:
            instructions.append(_instruction(statement))
    return Program(name, tuple(re.findall(rf"{name}_param_\d+", parameters)), registers, tuple(instructions), labels)


def _instruction(text: str) -> Instruction:
    guard, rest = None, text
    if found := _GUARD.fullmatch(text):
        guard, rest = (found[2], not found[1]), found[3]
    opcode, *operands = rest.split(None, 1)
    return Instruction(
        tuple(opcode.split(".")),
        tuple(_OPERAND.findall(operands[0])) if operands else (),
        guard,
        " ".join(text.split()),
    )
