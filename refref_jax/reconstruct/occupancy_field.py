"""An occupancy field: a body as the output of a small network, in the manner of UNISURF.

Letters: positions `x` lie in the unit cube; `f(x)` is the network's output, negative inside the
body and, held to a slope of 1 while it is trained, about the distance to the surface, in edges of
the cube. The occupancy is `o(x) = 1 / (1 + exp(f(x) / b))` with the softness `b` of a step of the
training. UNISURF learns the logit of `o` itself; here it is `-f / b`, so that `o` hardens on a
schedule, and one field serves all softnesses. The surface is where `o = 1/2`, that is `f = 0`.

Plain functions over positions; the linen module stays inside.

Source: Oechsle, Peng and Geiger, UNISURF: Unifying Neural Implicit Surfaces and Radiance Fields for
Multi-View Reconstruction (2021), section 3; Mueller et al., Instant NGP (2022), for the grid.
"""

import dataclasses
import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.fields.hash_grid import HashGrid, HashGridConfig

Params = Any
"""A pytree of arrays, as `init` makes it."""

# Every vertex of the finest level has an entry of its own.
_GRID = HashGridConfig(levels=4, coarsest=8, finest=64, entries=1 << 19, features=2)

# Corners of a regular tetrahedron, whose outer products sum to 4 times the identity.
_TETRAHEDRON = ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))


@dataclasses.dataclass(frozen=True)
class OccupancyFieldConfig:
    """Shape of an occupancy field.

    Attributes:
      grid: the hash grid; its finest cells bound the detail of the surface.
      width: units of the hidden layer.
      start: radius of the ball that an untrained field is, in edges of the cube.
    """

    grid: HashGridConfig = _GRID
    width: int = 32
    start: float = 0.4

    def __post_init__(self) -> None:
        """Checks the ball."""
        if not 0.0 < self.start <= 0.5:
            raise ValueError(
                f"The field starts as a ball of radius {self.start} in a cube of edge 1. Choose a "
                "radius above 0, at most 0.5."
            )


def init(key: Array, config: OccupancyFieldConfig) -> Params:
    """Returns new parameters: a ball in the middle of the cube, but for noise."""
    return _OccupancyField(config).init(key, jnp.zeros(3))


def signed(
    params: Params, config: OccupancyFieldConfig, position: Float[Array, "3"]
) -> Float[Array, ""]:
    """Returns `f` at a point: negative inside, in edges of the cube.

    Args:
      params: from `init`.
      config: the same as there.
      position: in the unit cube; beyond it the grid's outer cells go on as they end.
    """
    return _OccupancyField(config).apply(params, position)


def slope(
    params: Params, config: OccupancyFieldConfig, position: Float[Array, "3"], *, step: float
) -> Float[Array, "3"]:
    """Returns the gradient of `f`, outward, by differences between corners of a tetrahedron.

    Differences see past the edges of the grid's cells, where the derivative jumps, and can be
    derived once more by the parameters at the cost of four values. The error is about the step
    times the second derivative.

    Args:
      params: from `init`.
      config: the same as there.
      position: in the unit cube.
      step: of each coordinate, in edges of the cube; about a cell of the finest level.
    """
    corners = jnp.asarray(_TETRAHEDRON)
    values = jax.vmap(functools.partial(signed, params, config))(position[None] + step * corners)
    return values @ corners / (4.0 * step)


class _OccupancyField(nn.Module):
    config: OccupancyFieldConfig

    @nn.compact
    def __call__(self, position: Float[Array, "3"]) -> Float[Array, ""]:
        config = self.config
        ball = numerics.length(position - 0.5) - config.start
        features = HashGrid(config.grid, name="grid")(position, jnp.zeros_like(ball))
        hidden = nn.softplus(nn.Dense(config.width)(jnp.concatenate([features, position - 0.5])))
        # From zero, so that the ball is all there is at first.
        return ball + nn.Dense(1, kernel_init=nn.initializers.zeros)(hidden)[0]
