"""What the suite has XLA compile with, and its commands not.

The suite's time is mostly compiling, which takes half as long with the older code generator for
CPUs. The commands, in processes of their own, are tested with the one that users have.
"""

import os
from importlib import metadata

_OLDER = "--xla_cpu_use_fusion_emitters=false"


def faster(flags: str) -> str:
    """Returns XLA's flags with that of the older code generator."""
    # A flag that XLA does not know ends the process.
    known = metadata.version("jaxlib").startswith("0.10.")
    return f"{flags} {_OLDER}".strip() if known and _OLDER not in flags else flags


def of_users() -> dict[str, str]:
    """Returns the environment of a command as its users have it."""
    return os.environ | {"XLA_FLAGS": os.environ.get("XLA_FLAGS", "").replace(_OLDER, "")}
