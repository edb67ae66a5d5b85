"""Queries of a model's radiance field at world points, without light paths.

They are used to export surfaces and point clouds. The field inside objects is meaningless if the
model takes no samples there.
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
    """Values of the field at a point.

    Attributes:
      density: density per world unit, non-negative: the transmittance of a short distance `dt` is
        `exp(-density dt)`.
      linear: linear RGB radiance, opposite to the direction of travel.
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
      params: parameters of the model.
      config: configuration of the model.
      point: position in world units; beyond the scene bounds, their nearest point is used.
      direction: unit direction of travel of the viewing path.
      width: edge of the cell around the point, world units: finer detail is blurred.
    """
    # Standard deviation of a cube along each axis.
    scale = jnp.full((1,), width, point.dtype) / jnp.sqrt(jnp.asarray(12.0, point.dtype))
    bounds = transport.domain(config)
    held = domains.nearest_within(bounds, point)
    cell = domains.to_unit_cube(bounds, Gaussians(held[None], scale))
    seen = registry.radiance(params.field, config.field, cell, direction)
    return FieldPoint(seen.density / config.radius, seen.rgb)
