"""Where the suite's programs are lowered to MLIR.

JAX makes a context for each program, and loads all dialects into it. The suite lowers thousands of
programs of one or a few operations, and making contexts took a seventh of the time of such tests.
"""

import threading

from jax._src.interpreters import mlir
from jax._src.lib.mlir import ir

# A context keeps the constants of its programs until it is freed.
_PROGRAMS_PER_CONTEXT = 10


def reuse() -> None:
    """Has JAX lower several programs of a thread in one context."""
    make = getattr(mlir, "make_ir_context", None)
    if make is None:
        return
    kept = threading.local()

    def context():
        # What is compiled while another program is lowered must not end up in that one.
        if ir.Context.current is not None:
            return make()
        uses = getattr(kept, "uses", 0)
        if uses % _PROGRAMS_PER_CONTEXT == 0:
            kept.context = make()
        kept.uses = uses + 1
        return kept.context

    mlir.make_ir_context = context
