"""That JAX's transformations change nothing: `jit` is no `jit`, and `vmap` is a loop.

A case is a function and batches of its arguments; every argument has a leading axis.
"""

import jax
import numpy as np

# XLA may fuse what runs op by op without `jit`: a few units in the last place.
_FUSION = 5e-6


def jitted(function, batches):
    """Compares the function with and without `jit` on the first item."""
    first = jax.tree.map(lambda x: x[0], batches)
    _assert_close(jax.jit(function)(*first), function(*first))


def mapped(function, batches):
    """Compares `vmap` with a loop."""
    compiled = jax.jit(function)
    together = jax.jit(jax.vmap(function))(*batches)
    for index in range(jax.tree.leaves(batches)[0].shape[0]):
        one = compiled(*jax.tree.map(lambda x, index=index: x[index], batches))
        _assert_close(jax.tree.map(lambda x, index=index: x[index], together), one)


ALL = (jitted, mapped)


def _assert_close(got, expected):
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert a.shape == b.shape and a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=_FUSION, atol=_FUSION)
