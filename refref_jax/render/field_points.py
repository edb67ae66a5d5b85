"""A model's radiance field at points of the world, without any path of light.

For surfaces and point clouds. What is inside a body where no samples are taken was never learned,
and means nothing.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax.fields import registry
from refref_jax.render import transport
from refref_jax.render.config import ModelConfig
from refref_jax.render.model import Params
from refref_jax.sampling import domains
from refref_jax.sampling.cones import Gaussians


class FieldPoint(NamedTuple):
    """The field at a point.

    Attributes:
      density: per world unit, not negative: light that goes a short way `dt` is dimmed by
        `exp(-density dt)`.
      linear: linear RGB that leaves towards where the direction comes from.
    """

    density: Float[Array, ""]
    linear: Float[Array, "3"]


def look_up(
    params: Params,
    config: ModelConfig,
    point: Float[Array, "3"],
    direction: Float[Array, "3"],
    *,
    width: float,
) -> FieldPoint:
    """Returns density and colour at one point; map it over many.

    Args:
      params: the model's parameters.
      config: the model.
      point: world units; behind a scene's walls the nearest point of them is looked at.
      direction: of travel of the light path that looks, unit.
      width: edge of the cell that the point stands for, world units: finer detail is blurred.
    """
    # A cube's standard deviation along each axis.
    scale = jnp.full((1,), width, point.dtype) / jnp.sqrt(jnp.asarray(12.0, point.dtype))
    bounds = transport.domain(config)
    held = domains.nearest_within(bounds, point)
    cell = domains.to_unit_cube(bounds, Gaussians(held[None], scale))
    seen = registry.radiance(params.field, config.field, cell, direction)
    return FieldPoint(seen.density / config.radius, seen.rgb)
