"""Makes XLA compile a loop nest for the CPU as one native function.

XLA:CPU runs a `while_loop` as many small kernels, dispatched one by one. A call with the attribute
set by `native_loop` is instead emitted as one function with real control flow, which makes BVH
traversal about five times faster. The attribute is internal to XLA: versions that do not know it
ignore it, and only the speed changes.
"""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def native_loop(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Marks a function of arrays for compilation as one native kernel.

    The function must use every argument and must not contain a sort, scatter or callback. The
    attribute is set on the call of a nested `jit`. Inside, it is reset; otherwise every small
    jitted function of `jax.numpy` would inherit it and become a real call.

    XLA aborts (JAX 0.10.2) if an argument of a marked call is a constant, such as a scene that a
    user's function closes over. Every argument therefore passes an optimization barrier first,
    which hides constants from XLA. The barrier does not copy.
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


def record(values: Any, index: Array) -> Any:
    """Returns one record of arrays, as a native loop reads it."""

    def pick(x: Array) -> Array:
        return jax.lax.dynamic_index_in_dim(x, index, keepdims=False, allow_negative_indices=False)

    return jax.tree.map(pick, values)


def with_record(values: Array, at: Array, value: Array) -> Array:
    """Returns an array with one record replaced."""
    update = jax.lax.dynamic_update_index_in_dim
    return update(values, value, at, axis=0, allow_negative_indices=False)
