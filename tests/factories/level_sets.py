"""Level sets of solids with formulas, as functions that `jit` takes."""

import jax.numpy as jnp
from jax.tree_util import Partial

from refref_jax.geometry.surfaces import LevelSet
from refref_jax.optics import interface_rules
from refref_jax.optics.media import Scene, with_index


def ball_values(centre, radius, factor, points):
    """A factor times the distances to a ball."""
    return factor * (jnp.linalg.norm(points - centre[None], axis=-1) - radius)


def torus_values(radii, points):
    """The distances to a torus around the z axis; radii of its circle and its tube."""
    ring = jnp.linalg.norm(points[:, :2], axis=-1) - radii[0]
    return jnp.sqrt(ring**2 + points[:, 2] ** 2) - radii[1]


def level_set(value, *constants, radius=2.0):
    """Returns the level set of a function of constants and points, in a ball around the origin."""
    kind = jnp.result_type(float)
    step = 3e-5 if kind == jnp.float64 else 3e-3
    return LevelSet(
        Partial(value, *constants),
        *(jnp.asarray(x, kind) for x in (step, (0.0, 0.0, 0.0), radius)),
    )


def ball(centre, radius, factor=1.0):
    kind = jnp.result_type(float)
    return level_set(ball_values, *(jnp.asarray(x, kind) for x in (centre, radius, factor)))


def torus(radii):
    return level_set(torus_values, jnp.asarray(radii, jnp.result_type(float)))


def scene(surface, index=1.5):
    """Returns a scene of a level set of glass in air."""
    glass = interface_rules.nested([1.5], [interface_rules.NO_PARENT])
    return with_index(Scene(surface, glass), index)
