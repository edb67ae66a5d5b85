"""Arrays as the library takes them."""

import jax
import jax.numpy as jnp
import numpy as np


def single(values):
    """Returns an array in single precision."""
    return jnp.asarray(values, jnp.float32)


def singles(*arrays):
    """Returns several arrays in single precision."""
    return tuple(single(array) for array in arrays)


def unit(vectors):
    """Returns vectors of length one, in double precision."""
    vectors = np.asarray(vectors, np.float64)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def drawn(shapes, *, scale):
    """Returns normally distributed arrays of given shapes, always the same, in single precision."""
    rng = np.random.default_rng(1)
    return jax.tree.map(lambda x: single(scale * rng.normal(size=x.shape)), shapes)
