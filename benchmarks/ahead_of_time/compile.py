"""Compiles one program in this process, and prints its counts as JSON.

    python -m benchmarks.ahead_of_time.compile PROGRAM TARGET DUMP

`counts_of` runs it in a process of its own, since XLA reads its flags once.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.ahead_of_time import counters, hopper, programs
from benchmarks.ahead_of_time.counters import Kernel
from benchmarks.ahead_of_time.programs import Program
from refref_jax import compilation

PROGRAMS: Mapping[str, tuple[Callable[[], Program], Callable[[Kernel], str]]] = {
    "backdrop": (programs.backdrop_product, counters.part_by_loops),
    "tiny pretrace": (lambda: programs.training("tiny")[0], counters.part_by_loops),
    "tiny step": (lambda: programs.training("tiny")[1], counters.part_of_step),
    "paper pretrace": (lambda: programs.training("paper")[0], counters.part_by_loops),
    "paper step": (lambda: programs.training("paper")[1], counters.part_of_step),
    "best step": (lambda: programs.training("best")[1], counters.part_of_step),
}
"""Programs by name, with what divides each into parts."""

TARGETS = ("h100", "cpu")

RECORDED = Path(__file__).parents[1] / "results" / "compiled_programs.json"
"""Counts by program and target."""

# The longest text of a kernel: one that keeps too much in registers compiles for a minute. Gathers
# in branches: with ten of them, a kernel took three quarters of a step's time.
BOUNDED = ("kernels", "bytes", "temporaries", "longest", "gathers_in_branches")

# Counts may grow by this much before they are refused.
_ALLOWED = 1.02


def counts_of(
    program: str, target: str, *, packages: list[str] | None = None, seconds: float = 1500.0
) -> dict[str, Any]:
    """Compiles a program for a target in a new process, and returns its counts.

    Args:
      program: name in `PROGRAMS`.
      target: `h100` or `cpu`.
      packages: folders with packages of the compiler for GPUs, if they are not installed.
      seconds: time after which the process is ended.
    """
    with tempfile.TemporaryDirectory() as dump:
        settings = {**os.environ, "JAX_PLATFORMS": "cpu"}
        if target == "h100":
            settings = hopper.environment(dump=dump, packages=packages or [])
        answer = subprocess.run(
            [sys.executable, "-m", "benchmarks.ahead_of_time.compile", program, target, dump],
            env=settings,
            cwd=Path(__file__).parents[2],
            capture_output=True,
            text=True,
            timeout=seconds,
        )
    if answer.returncode:
        raise RuntimeError(f"{program} did not compile for {target}: {answer.stderr[-2000:]}")
    counted: dict[str, Any] = json.loads(answer.stdout.splitlines()[-1])
    return counted


def excess(counted: dict[str, Any], recorded: dict[str, Any]) -> list[str]:
    """Returns what is more than recorded, as text; and compare-and-swap, which is never allowed."""
    found = [
        f"{name}: {counted[name]}, recorded are {recorded[name]}"
        for name in BOUNDED
        if counted[name] > _ALLOWED * recorded[name]
    ]
    each = zip(counted["launches"], recorded["launches"], strict=True)
    found += [
        f"launches {depth} loops deep: {now}, recorded are {before}"
        for depth, (now, before) in enumerate(each)
        if depth and now > before
    ]
    return found + [f"instruction {name}" for name in counted["atomics"] if ".cas" in name]


def main(program: str, target: str, dump: str) -> None:
    compilation.add_missing_flags()
    make, part = PROGRAMS[program]
    place = hopper.placed if target == "h100" else lambda tree: tree
    compiled = make().trace(place).lower().compile()
    print(json.dumps(_counts(compiled, part, target, Path(dump))))


def _counts(
    compiled: Any, part: Callable[[Kernel], str], target: str, dump: Path
) -> dict[str, Any]:
    parsed = counters.parse(compiled.as_text())
    found = counters.kernels(parsed)
    texts = [path.read_text() for path in dump.glob("*.ptx")]
    # JAX 0.11.2 writes none unless it is asked.
    assert texts or target != "h100", "the compiler wrote no PTX, whose atomics are checked"
    # JAX has no cost analysis of programs for GPUs.
    cost = compiled.cost_analysis() or {}
    return {
        "kernels": len(found),
        "bytes": sum(kernel.bytes for kernel in found),
        "temporaries": compiled.memory_analysis().temp_size_in_bytes,
        "accessed": int(cost.get("bytes accessed", 0)),
        "flops": int(cost.get("flops", 0)),
        "launches": [counters.launches(found, depth) for depth in range(4)],
        "largest_pad": _largest_pad(found),
        "parts": {name: list(count) for name, count in counters.by_part(found, part).items()},
        "longest": max(map(len, texts), default=0),
        "gathers_in_branches": counters.gathers_in_branches(parsed),
        "atomics": sorted(set(re.findall(r"\batom\.[\w.:]*", "".join(texts)))),
    }


def _largest_pad(found: list[Kernel]) -> int:
    """Returns the bytes of the largest kernel that only copies or pads."""
    moved = [each.bytes for each in found if each.opcode in ("copy", "pad")]
    return max(moved, default=0)


if __name__ == "__main__":
    main(*sys.argv[1:])
