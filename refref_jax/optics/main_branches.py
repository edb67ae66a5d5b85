"""Traces the main branches of a ray, which carry most of its light, with gradients.

They are the main path, which is refracted wherever it can be, and the paths that are reflected
once, at one of the first surfaces, and then refracted like the main path. In clear glass, all other
paths together carry 1 % of the light. Throughput that the threshold moves to siblings stays on
these branches.

A reflection that does not occur is an empty path: the path has already left the objects, or the
reflection is total and therefore part of the main path.

Source: paper (arXiv 2505.05848), section 4.2; its two paths are the first two of these.
"""

import jax
import jax.numpy as jnp

from refref_jax.geometry.rays import Rays
from refref_jax.optics.budgets import Budget
from refref_jax.optics.light_paths import LightPaths, PathStatus
from refref_jax.optics.scene import Scene
from refref_jax.optics.single_path import follow_branch


def follow_main_branches(
    geometry: Scene, ray: Rays, *, budget: Budget, reflections: int
) -> LightPaths:
    """Traces one ray along its main path, and along the paths that are reflected once.

    Args:
      geometry: the scene.
      ray: one camera ray.
      budget: path settings.
      reflections: number of first surfaces at which a reflection is followed.

    Returns:
      `1 + reflections` paths, the main path first; paths that do not exist are `EMPTY`. Their ray
      index is 0.

    Raises:
      ValueError: if there are more reflections than bends.

    Example:
      A glass cube in front of a red wall, and the derivative of its colour with respect to the
      index: with a higher index, more of the black behind the camera is reflected.

      >>> import jax, numpy as np, trimesh
      >>> import refref_jax
      >>> from refref_jax.render import shade
      >>> glass = refref_jax.single_body(trimesh.creation.box(), index=1.5)
      >>> ray = refref_jax.Rays(np.array([-2.0, 0.1, 0.2]), np.array([1.0, 0.0, 0.0]), 1e-3)
      >>> red = jax.numpy.array([1.0, 0.0, 0.0])
      >>> wall = lambda origin, direction: jax.numpy.where(direction[0] > 0.0, red, 0.0)
      >>> def colour(index):
      ...     paths = refref_jax.follow_main_branches(
      ...         refref_jax.with_index(glass, index),
      ...         ray,
      ...         budget=refref_jax.Budget(bends=2, reflections="all"),
      ...         reflections=1,
      ...     )
      ...     return shade(paths, wall, rays=1)[0]
      >>> value, slope = jax.jit(lambda n: jax.jvp(colour, (n,), (1.0,)))(1.5)
      >>> print(f"{value[0]:.4f} {slope[0]:.4f}")  # (4 n / (n + 1)^2)^2, and its derivative
      0.9216 -0.2458
    """
    if not 0 <= reflections <= budget.bends:
        raise ValueError(
            f"reflections is {reflections}, outside 0 to {budget.bends}, the max bends. Choose a "
            "number in that range."
        )
    first = jnp.arange(reflections, dtype=jnp.int32)
    once = first[:, None] == jnp.arange(budget.bends, dtype=jnp.int32)[None]
    choices = jnp.concatenate([jnp.zeros_like(once, shape=(1, budget.bends)), once])
    paths = jax.vmap(lambda choice: follow_branch(geometry, ray, choice, budget=budget))(choices)
    # If the main path stays in its medium at a bend, reflection is total there.
    total = paths.media[0, 1:] == paths.media[0, :-1]
    real = jnp.append(True, (paths.bends[1:] > first) & ~total[:reflections])
    return paths._replace(
        statuses=jnp.where(real, paths.statuses, PathStatus.EMPTY),
        weights=jnp.where(real[:, None], paths.weights, 0.0),
    )
