"""What the suite has XLA compile with, and its commands mostly.

The suite's time is mostly compiling. The older code generator for CPUs takes half as long, and a
program in one piece a seventh less than in many, since all cores are busy anyway. Without LLVM's
optimisations it takes half of the rest (`LIGHTLY`), where no slow tests are run. What users have is
tested too, by slow tests, where a command is given the environment `of_users`.
"""

import os
from importlib import metadata

_FASTER = ("--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1")

LIGHTLY = "JAX_DISABLE_MOST_OPTIMIZATIONS"
"""Variable of the environment that has JAX compile without LLVM's optimisations, if it is 1."""


def faster(flags: str) -> str:
    """Returns XLA's flags with those that make it compile faster."""
    # A flag that XLA does not know ends the process.
    known = metadata.version("jaxlib").startswith("0.10.")
    return " ".join([flags, *(flag for flag in _FASTER if known and flag not in flags)]).strip()


def of_users() -> dict[str, str]:
    """Returns the environment of a command as its users have it."""
    flags = os.environ.get("XLA_FLAGS", "").split()
    kept = {name: value for name, value in os.environ.items() if name != LIGHTLY}
    return kept | {"XLA_FLAGS": " ".join(flag for flag in flags if flag not in _FASTER)}
