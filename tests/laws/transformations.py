"""That JAX's transformations change nothing: `jit` is no `jit`, and `vmap` is a loop.

A case is a function and batches of its arguments; every argument has a leading axis.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

# XLA may fuse what runs op by op without `jit`: a few units in the last place.
_FUSION = 5e-6


def jitted(function, batches):
    """Compares the function with and without `jit` on the first item."""
    first = _item(batches, 0)
    _assert_close(_compiled(function)(*first), function(*first))


def mapped(function, batches):
    """Compares `vmap` with a loop."""
    _assert_equals_loop(jax.jit(jax.vmap(function))(*batches), _compiled(function), batches)


def batched(function, batches):
    """Compares a function that takes leading axes with a loop over the first of them."""
    _assert_equals_loop(_compiled(function)(*batches), _compiled(function), batches)


ALL = (jitted, mapped)


@functools.cache
def _compiled(function):
    return jax.jit(function)


def _item(tree, index):
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[index]), tree)


def _assert_equals_loop(together, compiled, batches):
    for index in range(jax.tree.leaves(batches)[0].shape[0]):
        _assert_close(_item(together, index), compiled(*_item(batches, index)))


def _assert_close(got, expected):
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert a.shape == b.shape and a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=_FUSION, atol=_FUSION)
