"""The small networks behind a hash grid, which several kinds of field share.

Functions for the body of a compact linen module: their layers are that module's.
"""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax.choices import Precision
from refref_jax.fields.encodings import spherical_harmonics
from refref_jax.fields.hash_grid import HashGridConfig, MultisampledGrid
from refref_jax.fields.kinds import DensityConfig, RadianceConfig
from refref_jax.fields.precision import dense
from refref_jax.sampling.cones import Gaussians


@dataclasses.dataclass(frozen=True)
class GridRadianceConfig(RadianceConfig):
    """Shape of a radiance field on a hash grid.

    Attributes:
      grid: the hash grid.
      density_width: units of the density network's hidden layer.
      bottleneck: features that the density network hands to the colour network.
      colour_width: units of the colour network's hidden layers.
      colour_depth: number of those layers.
    """

    grid: HashGridConfig
    density_width: int
    bottleneck: int
    colour_width: int
    colour_depth: int


@dataclasses.dataclass(frozen=True)
class GridDensityConfig(DensityConfig):
    """Shape of a density field on a hash grid.

    Attributes:
      grid: the hash grid.
      width: units of the hidden layer.
    """

    grid: HashGridConfig
    width: int


def nowhere() -> Gaussians:
    """Returns one point, with which a module's parameters are made."""
    return Gaussians(jnp.zeros((1, 3), jnp.float32), jnp.zeros(1, jnp.float32))


def grid_network(
    gaussians: Gaussians,
    grid: HashGridConfig,
    *,
    width: int,
    outputs: int,
    precision: Precision,
) -> Float[Array, " outputs"]:
    """Returns what a network with one hidden layer says of the grid's mean features.

    Args:
      gaussians: in the unit cube.
      grid: the hash grid.
      width: units of the hidden layer.
      outputs: number of outputs, which no activation follows.
      precision: of tables and matrix products.
    """
    layer = dense(precision)
    features = MultisampledGrid(grid, precision)(gaussians)
    # Flax numbers layers as they are made, and checkpoints have their names.
    hidden = nn.relu(layer(width)(features))
    return layer(outputs)(hidden)


def colour(
    bottleneck: Float[Array, " bottleneck"],
    direction: Float[Array, "3"],
    config: GridRadianceConfig,
) -> Float[Array, "3"]:
    """Returns a colour in `[0, 1]`, of the density network's features and a unit direction."""
    layer = dense(config.precision)
    hidden = jnp.concatenate([bottleneck, spherical_harmonics(direction)])
    for _ in range(config.colour_depth):
        hidden = nn.relu(layer(config.colour_width)(hidden))
    return jax.nn.sigmoid(layer(3)(hidden))
