"""Level sets of solids with formulas, as functions that `jit` takes."""

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from refref_jax.geometry.surfaces import LevelSet
from refref_jax.optics import interface_rules
from refref_jax.optics.media import Scene, with_index


def ball_value(centre, radius, factor, point):
    """A factor times the distance to a ball."""
    return factor * (jnp.linalg.norm(point - centre) - radius)


def torus_value(radii, point):
    """The distance to a torus around the z axis; radii of its circle and its tube."""
    ring = jnp.linalg.norm(point[:2]) - radii[0]
    return jnp.sqrt(ring**2 + point[2] ** 2) - radii[1]


def level_set(value, *constants, radius=2.0):
    """Returns the level set of a function of constants and a point, in a ball around the origin."""
    slope = jax.grad(value, argnums=len(constants))
    kind = jnp.result_type(float)
    bounds = jnp.zeros(3, kind), jnp.asarray(radius, kind)
    return LevelSet(Partial(value, *constants), Partial(slope, *constants), *bounds)


def ball(centre, radius, factor=1.0):
    kind = jnp.result_type(float)
    return level_set(ball_value, *(jnp.asarray(x, kind) for x in (centre, radius, factor)))


def torus(radii):
    return level_set(torus_value, jnp.asarray(radii, jnp.result_type(float)))


def scene(surface, index=1.5):
    """Returns a scene of a level set of glass in air."""
    glass = interface_rules.nested([1.5], [interface_rules.NO_PARENT])
    return with_index(Scene(surface, glass), index)
