"""Lets XLA compile a loop nest for the CPU as one native function.

XLA:CPU runs a `while_loop` as many small kernels, dispatched one by one. A call that carries the
attribute below is instead emitted as one function with real control flow, which makes the
traversal of a tree about five times faster. The attribute is internal to XLA: where it is not
known it is ignored, and only the speed changes.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax
from jax.experimental.xla_metadata import set_xla_metadata

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def native_loop(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Marks a function of arrays for one native kernel.

    The function must use every argument and hold no sort, scatter or callback. The mark sits on
    the call of a nested `jit`. Inside, it is taken back, or every small jitted function of
    `jax.numpy` would inherit it and become a real call of its own.

    XLA aborts (JAX 0.10.2) when an argument of a marked call is a constant, as geometry is that a
    user's function closes over. So every argument first passes a barrier, behind which XLA does not
    see what it is. The barrier copies nothing.
    """

    def unmarked(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        with set_xla_metadata(xla_cpu_small_call="false", inlineable="true"):
            return function(*args, **kwargs)

    compiled = jax.jit(unmarked)

    def marked(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        args, kwargs = jax.lax.optimization_barrier((args, kwargs))
        with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
            return compiled(*args, **kwargs)

    return marked
