"""One ray against one axis-aligned box."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# Two roundings up on the far side, so that a triangle lying in a box face is never culled.
_FAR_PADDING = 1.0000004


def overlaps(
    origin: Float[Array, "3"],
    inverse_direction: Float[Array, "3"],
    box: Float[Array, "2 3"],
    limit: Float[Array, ""],
) -> Bool[Array, ""]:
    """Returns whether the ray passes through the box at a distance in `[0, limit]`.

    Args:
      origin: start of the ray.
      inverse_direction: `numerics.safe_reciprocal` of the direction, finite in every component.
      box: lower and upper corner.
      limit: farthest distance of interest; anything negative overlaps no box.

    Source: the slab method, Kay and Kajiya (1986).
    """
    first = (box[0] - origin) * inverse_direction
    second = (box[1] - origin) * inverse_direction
    near = jnp.max(jnp.minimum(first, second))
    far = jnp.min(jnp.maximum(first, second)) * _FAR_PADDING
    return (jnp.maximum(near, 0.0) <= far) & (near <= limit) & (limit >= 0.0)
