"""Zip-NeRF's proposal field: density only, cheap to query many times along a path.

Its interface is pure functions over Gaussians in the unit cube; the linen module is private.

Source: Barron et al., Mip-NeRF 360 (2022), section 3; Zip-NeRF (2023) for the hash grid.
"""

import dataclasses
from typing import Literal

import flax.linen as nn
import jax
from jaxtyping import Array, Float

from refref_jax.fields.kinds import Params
from refref_jax.fields.networks import GridDensityConfig, grid_network, nowhere
from refref_jax.sampling.cones import Gaussians

# Shift of the softplus: the density of an untrained field is low, but not zero.
_DENSITY_SHIFT = -1.0


@dataclasses.dataclass(frozen=True)
class DensityFieldConfig(GridDensityConfig):
    """Shape of a density field; see `GridDensityConfig`."""

    kind: Literal["zipnerf"] = dataclasses.field(default="zipnerf", kw_only=True)


def init(key: Array, config: DensityFieldConfig) -> Params:
    """Returns initial parameters."""
    return _DensityField(config).init(key, nowhere())


def density(params: Params, config: DensityFieldConfig, gaussians: Gaussians) -> Float[Array, ""]:
    """Returns the density of one interval, averaged over its multisamples, per scene radius.

    Args:
      params: parameters, from `init`.
      config: shape of the field, as in `init`.
      gaussians: multisamples in the unit cube, as fractions of its edge.
    """
    return _DensityField(config).apply(params, gaussians)


def activate_density(raw: Float[Array, ""]) -> Float[Array, ""]:
    """Returns the density for a network output: a shifted softplus, linear for large inputs."""
    return jax.nn.softplus(raw + _DENSITY_SHIFT)


class _DensityField(nn.Module):
    config: DensityFieldConfig

    @nn.compact
    def __call__(self, gaussians: Gaussians) -> Float[Array, ""]:
        config = self.config
        raw = grid_network(
            gaussians, config.grid, width=config.width, outputs=1, precision=config.precision
        )
        return activate_density(raw[0])
