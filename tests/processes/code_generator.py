"""What the suite has XLA compile with, and its commands mostly.

The suite's time is mostly compiling. The older code generator for CPUs takes half as long, and a
program in one piece a seventh less than in many, since all cores are busy anyway. Without LLVM's
optimisations it takes half of the rest, and without the passes that move computations out of loops
two thirds of that (`lighter`), where no slow tests are run. What users have is tested too, by slow
tests, where a command is given the environment `of_users`.
"""

import os
from importlib import metadata

_FASTER = ("--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1")
_LIGHTER = ("--xla_disable_hlo_passes=while-loop-invariant-code-motion,simplify-while-loops",)

# Has JAX compile without LLVM's optimisations.
_LIGHTLY = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}


def faster() -> dict[str, str]:
    """Returns what the environment must have for a faster code generator."""
    return {"XLA_FLAGS": _with(_FASTER)}


def lighter() -> dict[str, str]:
    """Returns what the environment must have for programs that are compiled fast and run slower."""
    return _LIGHTLY | {"XLA_FLAGS": _with(_LIGHTER)}


def of_users() -> dict[str, str]:
    """Returns the environment of a command as its users have it."""
    flags = os.environ.get("XLA_FLAGS", "").split()
    kept = {name: value for name, value in os.environ.items() if name not in _LIGHTLY}
    ours = {*_FASTER, *_LIGHTER}
    return kept | {"XLA_FLAGS": " ".join(flag for flag in flags if flag not in ours)}


def _with(added: tuple[str, ...]) -> str:
    """Returns the flags of XLA with others, if this version knows them."""
    flags = os.environ.get("XLA_FLAGS", "")
    # A flag that XLA does not know ends the process.
    known = metadata.version("jaxlib").startswith("0.10.")
    return " ".join([flags, *(flag for flag in added if known and flag not in flags)]).strip()
