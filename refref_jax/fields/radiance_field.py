"""The radiance field: density, and colour by direction.

Plain functions over Gaussians in the unit cube; the linen module stays inside.

Source: paper (arXiv 2505.05848), supplement (f for density, g for colour, spherical harmonics of
the local direction); Zip-NeRF (2023) for the hash grid and the bottleneck.
"""

import dataclasses
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax.fields import precision
from refref_jax.fields.density_field import activate_density
from refref_jax.fields.encodings import spherical_harmonics
from refref_jax.fields.hash_grid import HashGridConfig, MultisampledGrid
from refref_jax.fields.precision import Precision, check_precision
from refref_jax.sampling.cones import Gaussians

Params = Any
"""A pytree of arrays, as `init` makes it."""

# Colours may leave [0, 1] by this much, so that black and white lie at finite network outputs.
_COLOUR_PADDING = 0.001


@dataclasses.dataclass(frozen=True)
class RadianceFieldConfig:
    """Shape of a radiance field.

    Attributes:
      grid: the hash grid.
      density_width: units of the density network's hidden layer.
      bottleneck: features that the density network hands to the colour network.
      colour_width: units of the colour network's hidden layers.
      colour_depth: number of those layers.
      precision: of tables and matrix products.
    """

    grid: HashGridConfig
    density_width: int
    bottleneck: int
    colour_width: int
    colour_depth: int
    precision: Precision = "float32"

    def __post_init__(self) -> None:
        """Checks the choice."""
        check_precision(self.precision)


class Radiance(NamedTuple):
    """The field at a point.

    Attributes:
      density: per scene radius, not negative.
      rgb: linear radiance towards the camera, in `[-0.001, 1.001]`.
    """

    density: Float[Array, ""]
    rgb: Float[Array, "3"]


def init(key: Array, config: RadianceFieldConfig) -> Params:
    """Returns new parameters."""
    nowhere = Gaussians(jnp.zeros((1, 3)), jnp.zeros(1))
    return _RadianceField(config).init(key, nowhere, jnp.zeros(3))


def radiance(
    params: Params,
    config: RadianceFieldConfig,
    gaussians: Gaussians,
    direction: Float[Array, "3"],
) -> Radiance:
    """Returns density and colour of one interval of a path.

    Args:
      params: from `init`.
      config: the same as there.
      gaussians: multisamples in the unit cube, as fractions of its edge.
      direction: unit direction of travel at the interval, world frame.
    """
    return _RadianceField(config).apply(params, gaussians, direction)


class _RadianceField(nn.Module):
    config: RadianceFieldConfig

    @nn.compact
    def __call__(self, gaussians: Gaussians, direction: Float[Array, "3"]) -> Radiance:
        config = self.config
        dense = precision.dense(config.precision)
        features = MultisampledGrid(config.grid, config.precision)(gaussians)
        hidden = nn.relu(dense(config.density_width)(features))
        raw = dense(1 + config.bottleneck)(hidden)
        hidden = jnp.concatenate([raw[1:], spherical_harmonics(direction)])
        for _ in range(config.colour_depth):
            hidden = nn.relu(dense(config.colour_width)(hidden))
        rgb = jax.nn.sigmoid(dense(3)(hidden))
        padded = rgb * (1.0 + 2.0 * _COLOUR_PADDING) - _COLOUR_PADDING
        return Radiance(activate_density(raw[0]), padded)
