"""Zip-NeRF's radiance field: density and view-dependent colour.

Its interface is pure functions over Gaussians in the unit cube; the linen module is private.

Source: paper (arXiv 2505.05848), supplement (f for density, g for colour, spherical harmonics of
the local direction); Zip-NeRF (2023) for the hash grid and the bottleneck.
"""

import dataclasses
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax.fields.density_field import activate_density
from refref_jax.fields.kinds import Params, Radiance
from refref_jax.fields.networks import GridRadianceConfig, colour, grid_network, nowhere
from refref_jax.sampling.cones import Gaussians

# Colours may exceed [0, 1] by this much, so that black and white have finite network outputs.
_COLOUR_PADDING = 0.001


@dataclasses.dataclass(frozen=True)
class RadianceFieldConfig(GridRadianceConfig):
    """Shape of a radiance field; see `GridRadianceConfig`."""

    kind: Literal["zipnerf"] = dataclasses.field(default="zipnerf", kw_only=True)


def init(key: Array, config: RadianceFieldConfig) -> Params:
    """Returns initial parameters."""
    return _RadianceField(config).init(key, nowhere(), jnp.zeros(3, jnp.float32))


def radiance(
    params: Params,
    config: RadianceFieldConfig,
    gaussians: Gaussians,
    direction: Float[Array, "3"],
) -> Radiance:
    """Returns density and colour of one interval of a path.

    Args:
      params: parameters, from `init`.
      config: shape of the field, as in `init`.
      gaussians: multisamples in the unit cube, as fractions of its edge.
      direction: unit direction of travel at the interval, world frame.
    """
    return _RadianceField(config).apply(params, gaussians, direction)


class _RadianceField(nn.Module):
    config: RadianceFieldConfig

    @nn.compact
    def __call__(self, gaussians: Gaussians, direction: Float[Array, "3"]) -> Radiance:
        config = self.config
        raw = grid_network(
            gaussians,
            config.grid,
            width=config.density_width,
            outputs=1 + config.bottleneck,
            precision=config.precision,
        )
        rgb = colour(raw[1:], direction, config)
        padded = rgb * (1.0 + 2.0 * _COLOUR_PADDING) - _COLOUR_PADDING
        return Radiance(activate_density(raw[0]), padded)
