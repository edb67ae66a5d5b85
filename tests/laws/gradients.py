"""Checks of gradients against finite differences, in float64.

`jax.test_util.check_grads` hands NumPy arrays to the function, which the shape checks refuse:
they are turned into JAX arrays on the way.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.test_util import check_grads


def assert_numerical(function, *arguments, order=1, modes=("fwd", "rev"), rtol=None):
    """Asserts that the derivatives of a function are what finite differences say.

    Args:
      function: of floating-point arrays, smooth near the arguments.
      *arguments: anything that turns into arrays; taken as float64.
      order: highest derivative to check.
      modes: forward, reverse or both.
      rtol: relative tolerance, for functions that bend over the step of the differences.
    """
    with jax.enable_x64(True):
        arrays = tuple(jnp.asarray(x, jnp.float64) for x in arguments)
        compiled = jax.jit(lambda *x: function(*map(jnp.asarray, x)))
        check_grads(compiled, arrays, order=order, modes=modes, rtol=rtol)


def all_finite(tree):
    """Returns whether every number in a tree of arrays is finite."""
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))
