"""The proposal field: density alone, cheap enough to be asked many times along a path.

Plain functions over Gaussians in the unit cube; the linen module stays inside.

Source: Barron et al., Mip-NeRF 360 (2022), section 3; Zip-NeRF (2023) for the hash grid.
"""

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax.fields import precision
from refref_jax.fields.hash_grid import HashGridConfig, MultisampledGrid
from refref_jax.fields.precision import Precision, check_precision
from refref_jax.sampling.cones import Gaussians

Params = Any
"""A pytree of arrays, as `init` makes it."""

# Where softplus starts to rise: an untrained field is thin, but not empty.
_DENSITY_SHIFT = -1.0


@dataclasses.dataclass(frozen=True)
class DensityFieldConfig:
    """Shape of a density field.

    Attributes:
      grid: the hash grid.
      width: units of the hidden layer.
      precision: of tables and matrix products.
    """

    grid: HashGridConfig
    width: int
    precision: Precision = "float32"

    def __post_init__(self) -> None:
        """Checks the choice."""
        check_precision(self.precision)


def init(key: Array, config: DensityFieldConfig) -> Params:
    """Returns new parameters."""
    nowhere = Gaussians(jnp.zeros((1, 3)), jnp.zeros(1))
    return _DensityField(config).init(key, nowhere)


def density(params: Params, config: DensityFieldConfig, gaussians: Gaussians) -> Float[Array, ""]:
    """Returns the density that the multisamples of one interval see, per scene radius.

    Args:
      params: from `init`.
      config: the same as there.
      gaussians: multisamples in the unit cube, as fractions of its edge.
    """
    return _DensityField(config).apply(params, gaussians)


def activate_density(raw: Float[Array, ""]) -> Float[Array, ""]:
    """Returns the density of a network's output: a shifted softplus, linear for large input."""
    return jax.nn.softplus(raw + _DENSITY_SHIFT)


class _DensityField(nn.Module):
    config: DensityFieldConfig

    @nn.compact
    def __call__(self, gaussians: Gaussians) -> Float[Array, ""]:
        config = self.config
        dense = precision.dense(config.precision)
        features = MultisampledGrid(config.grid, config.precision)(gaussians)
        hidden = nn.relu(dense(config.width)(features))
        return activate_density(dense(1)(hidden)[0])
