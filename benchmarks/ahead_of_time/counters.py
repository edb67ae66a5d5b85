"""Counts of a compiled program, read off its text: kernels, bytes, temporaries, launches of loops.

XLA's text (HLO) has one line for each instruction. What runs as a kernel of its own on a GPU is an
instruction of the entry computation, or of a loop or branch that it calls; a fusion is one kernel.
Bytes are those of the operands and results of all kernels: traffic as if nothing stayed in a cache
and everything were read. A table that is read at few places therefore counts as a whole, and
rereading of places does not count.
"""

import collections
import re
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

_HEADING = re.compile(r"^(ENTRY )?%?([\w.\-]+) \(.*\{$")
_LINE = re.compile(r"^\s+(?:ROOT )?%?([\w.\-]+) = (.*)$")
_SHAPE = re.compile(r"\b([a-z]+\d+|pred)\[([\d,]*)\]")
_CALLED = re.compile(r"(condition|body|to_apply|true_computation|false_computation)=%?([\w.\-]+)")
_BRANCHES = re.compile(r"branch_computations=\{([^}]*)\}")
_SCOPE = re.compile(r'op_name="([^"]*)"')

# Instructions that only name values.
_FREE = {
    *("parameter", "get-tuple-element", "tuple", "bitcast", "constant", "after-all"),
    *("opt-barrier", "partition-id"),
}


class Instruction(NamedTuple):
    """One line of a computation.

    Attributes:
      name: name of the value.
      opcode: operation.
      shape: text of its result's shape.
      operands: names of the arguments.
      calls: names of computations that run as its parts; without those of a fusion.
      scope: names of the functions and transformations in JAX that it comes from.
    """

    name: str
    opcode: str
    shape: str
    operands: tuple[str, ...]
    calls: tuple[str, ...]
    scope: str


class Program(NamedTuple):
    """A compiled program: its computations by name, and the name of the first."""

    computations: Mapping[str, tuple[Instruction, ...]]
    entry: str


class Kernel(NamedTuple):
    """One launch.

    Attributes:
      loops: names of the loops around it, outermost first.
      opcode: operation.
      bytes: size of operands and results.
      shape: text of its result's shape.
      scope: origin in the traced program, as in `Instruction`.
    """

    loops: tuple[str, ...]
    opcode: str
    bytes: int
    shape: str
    scope: str


def parse(text: str) -> Program:
    """Returns the computations of a program in XLA's text format."""
    computations: dict[str, list[Instruction]] = {}
    entry, current = "", None
    for line in text.splitlines():
        if heading := _HEADING.match(line):
            current = computations.setdefault(heading[2], [])
            entry = heading[2] if heading[1] else entry
        elif current is not None and (found := _LINE.match(line)):
            current.append(_instruction(*found.groups()))
    if not entry:
        raise ValueError("The text has no ENTRY computation. Give that of Compiled.as_text().")
    return Program({name: tuple(lines) for name, lines in computations.items()}, entry)


def _instruction(name: str, rest: str) -> Instruction:
    """Returns an instruction from its name, and the text after `=`."""
    end = _closing(rest, 0) + 1 if rest.startswith("(") else rest.index(" ")
    shape, rest = rest[:end], rest[end:].lstrip()
    opening = rest.index("(")
    closing = _closing(rest, opening)
    after = rest[closing:]
    calls = [called for _, called in _CALLED.findall(after)]
    if branches := _BRANCHES.search(after):
        calls += [each.strip().lstrip("%") for each in branches[1].split(",")]
    opcode, scope = rest[:opening], _SCOPE.search(after)
    return Instruction(
        name,
        opcode,
        shape,
        tuple(re.findall(r"%([\w.\-]+)", rest[opening:closing])),
        tuple(calls) if opcode in ("while", "conditional", "call") else (),
        scope[1] if scope else "",
    )


def _closing(text: str, opening: int) -> int:
    """Returns the place of the bracket that closes the one at `opening`."""
    depth = 0
    for place in range(opening, len(text)):
        depth += {"(": 1, ")": -1}.get(text[place], 0)
        if not depth:
            return place
    raise ValueError(f"Brackets do not match in {text[:80]!r}.")


def size_of(shape: str) -> int:
    """Returns the number of bytes of a shape, such as `(f32[2,3]{1,0}, pred[])`."""
    total = 0
    for kind, dimensions in _SHAPE.findall(shape):
        count = 1
        for each in filter(None, dimensions.split(",")):
            count *= int(each)
        digits = re.search(r"\d+", kind)
        total += count * max(1, int(digits[0]) // 8) if digits else count
    return total


def kernels(program: Program) -> list[Kernel]:
    """Returns all kernels; of the branches of a conditional, those of the one with most."""
    return list(_kernels_of(program, program.entry, ()))


def _kernels_of(program: Program, name: str, loops: tuple[str, ...]) -> Iterator[Kernel]:
    lines = program.computations[name]
    shapes = {line.name: line.shape for line in lines}
    for line in lines:
        if line.opcode in _FREE:
            continue
        if line.opcode == "while":
            for called in line.calls:
                yield from _kernels_of(program, called, (*loops, line.name))
        elif line.calls:
            branches = [list(_kernels_of(program, called, loops)) for called in line.calls]
            yield from max(branches, key=len)
        else:
            read = sum(size_of(shapes.get(operand, "")) for operand in line.operands)
            yield Kernel(loops, line.opcode, read + size_of(line.shape), line.shape, line.scope)


class Count(NamedTuple):
    """Kernels and their bytes."""

    kernels: int
    bytes: int


def by_part(found: list[Kernel], part: Callable[[Kernel], str]) -> dict[str, Count]:
    """Returns kernels and bytes of each part, the largest first."""
    number: collections.Counter[str] = collections.Counter()
    size: collections.Counter[str] = collections.Counter()
    for kernel in found:
        number[part(kernel)] += 1
        size[part(kernel)] += kernel.bytes
    return {name: Count(number[name], total) for name, total in size.most_common()}


def launches(found: list[Kernel], depth: int) -> int:
    """Returns the launches of an iteration of the longest loop that has `depth - 1` around it."""
    each = collections.Counter(kernel.loops for kernel in found if len(kernel.loops) == depth)
    return max(each.values(), default=0)


def gathers_in_branches(program: Program) -> int:
    """Returns the most gathers that lead to a concatenation within one kernel.

    Neighbouring threads of such a kernel compute different parts of its result, and wait for each
    other's gathers.
    """
    bodies = program.computations
    launched = {called for lines in bodies.values() for line in lines for called in line.calls}
    fused = bodies.keys() - launched - {program.entry}
    return max((_gathers_below(bodies[name]) for name in fused), default=0)


def _gathers_below(lines: tuple[Instruction, ...]) -> int:
    """Returns the most gathers that a concatenation among some instructions depends on."""
    most, gathers = 0, dict[str, set[str]]()
    for line in lines:
        below = set[str]().union(*(gathers.get(operand, set()) for operand in line.operands))
        most = max(most, len(below)) if line.opcode == "concatenate" else most
        gathers[line.name] = below | {line.name} if line.opcode == "gather" else below
    return most


def part_of_step(kernel: Kernel) -> str:
    """Returns which part of a training step a kernel belongs to."""
    if len(kernel.loops) != 1:
        return "outside the step"
    scope = kernel.scope
    if "Grid_" in scope:
        backward = "transpose(" in scope
        if "scatter" in scope:
            return "hash grid, sums of slopes"
        return "hash grid, backward" if backward else "hash grid, forward"
    if "Dense_" in scope:
        return "networks"
    if "Field)" in scope:
        return "fields, rest"
    if "jvp(" not in scope and "vmap(" not in scope:
        return "optimizer and rest"
    return "sampling, compositing, losses"


def part_by_loops(kernel: Kernel) -> str:
    """Returns how many loops a kernel is in."""
    return ("outside loops", "loop", "loop in a loop", "innermost loop")[len(kernel.loops[:3])]
