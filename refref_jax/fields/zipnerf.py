"""Zip-NeRF field kind: proposal field, radiance field and preset sizes.

The proposal field has density only, and is cheap to query many times along a path. The radiance
field has density and view-dependent colour. The interface of both is pure functions over Gaussians
in the unit cube; the linen modules are private.

Source: Barron et al., Mip-NeRF 360 (2022), section 3, for proposals; Zip-NeRF (2023) for the hash
grid and the bottleneck; paper (arXiv 2505.05848), supplement (implementation details), for the
networks (f for density, g for colour, spherical harmonics of the local direction) and, with
Zip-NeRF, the size `paper`. The other sizes are ours.
"""

import dataclasses
from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax.fields.base import (
    FieldKind,
    FieldSize,
    Params,
    Radiance,
    evaluate,
    in_half_precision,
)
from refref_jax.fields.hash_grid import (
    GridDensityConfig,
    GridRadianceConfig,
    HashGridConfig,
    density_and_colour,
    grid_network,
    nowhere,
)
from refref_jax.sampling.polylines import Gaussians

# Shift of the softplus: the density of an untrained field is low, but not zero.
_DENSITY_SHIFT = -1.0

# Colours may exceed [0, 1] by this much, so that black and white have finite network outputs.
_COLOUR_PADDING = 0.001


@dataclasses.dataclass(frozen=True)
class DensityFieldConfig(GridDensityConfig):
    """Shape of a density field; see `GridDensityConfig`."""

    kind: Literal["zipnerf"] = dataclasses.field(default="zipnerf", kw_only=True)


def init_density(key: Array, config: GridDensityConfig) -> Params:
    """Returns initial parameters."""
    return _DensityField(config).init(key, nowhere())


def density(params: Params, config: GridDensityConfig, gaussians: Gaussians) -> Float[Array, ""]:
    """Returns the density of one interval, averaged over its multisamples, per scene radius.

    Args:
      params: parameters, from `init_density`.
      config: shape of the field, as in `init_density`.
      gaussians: multisamples in the unit cube, as fractions of its edge.
    """
    return evaluate(_DensityField(config), params, gaussians)


def activate_density(raw: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Returns the density for a network output: a shifted softplus, linear for large inputs."""
    return jax.nn.softplus(raw + _DENSITY_SHIFT)


def pad_colour(rgb: Float[Array, "*shape"], *, brightest: float = 1.0) -> Float[Array, "*shape"]:
    """Widens the range of colours from `[0, 1]` to `[-0.001, brightest + 0.001]`."""
    return rgb * (brightest + 2.0 * _COLOUR_PADDING) - _COLOUR_PADDING


class _DensityField(nn.Module):
    config: GridDensityConfig

    @nn.compact
    def __call__(self, gaussians: Gaussians) -> Float[Array, ""]:
        config = self.config
        raw = grid_network(
            gaussians, config.grid, width=config.width, outputs=1, precision=config.precision
        )
        return activate_density(raw[0])


@dataclasses.dataclass(frozen=True)
class RadianceFieldConfig(GridRadianceConfig):
    """Shape of a radiance field; see `GridRadianceConfig`."""

    kind: Literal["zipnerf"] = dataclasses.field(default="zipnerf", kw_only=True)


def init_radiance(key: Array, config: RadianceFieldConfig) -> Params:
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
      params: parameters, from `init_radiance`.
      config: shape of the field, as in `init_radiance`.
      gaussians: multisamples in the unit cube, as fractions of its edge.
      direction: unit direction of travel at the interval, world frame.
    """
    return evaluate(_RadianceField(config), params, gaussians, direction)


class _RadianceField(nn.Module):
    config: RadianceFieldConfig

    @nn.compact
    def __call__(self, gaussians: Gaussians, direction: Float[Array, "3"]) -> Radiance:
        config = self.config
        density, rgb = density_and_colour(gaussians, direction, config)
        return Radiance(activate_density(density), pad_colour(rgb, brightest=config.brightest))


def _proposal(
    *, levels: int, max_res: int, hashmap_size: int, features: int, width: int
) -> DensityFieldConfig:
    grid = HashGridConfig(
        levels, base_res=16, max_res=max_res, hashmap_size=hashmap_size, features=features
    )
    return DensityFieldConfig(grid, width=width)


_TINY = FieldSize(
    field=RadianceFieldConfig(
        HashGridConfig(levels=6, base_res=16, max_res=512, hashmap_size=1 << 17, features=4),
        density_width=32,
        bottleneck=15,
        colour_width=32,
        colour_depth=1,
    ),
    proposals=(_proposal(levels=4, max_res=64, hashmap_size=1 << 15, features=2, width=16),),
    samples=(32, 20),
    multisamples=1,
    footprint="differential",
    dilation=0.0,
    background_samples=(16, 8),
)

_SMALL = FieldSize(
    field=RadianceFieldConfig(
        HashGridConfig(levels=8, base_res=16, max_res=2048, hashmap_size=1 << 19, features=4),
        density_width=64,
        bottleneck=31,
        colour_width=64,
        colour_depth=1,
    ),
    proposals=(_proposal(levels=6, max_res=256, hashmap_size=1 << 17, features=2, width=32),),
    samples=(48, 32),
    multisamples=1,
    footprint="differential",
    dilation=0.0,
)

_PAPER = FieldSize(
    field=RadianceFieldConfig(
        HashGridConfig(levels=10, base_res=16, max_res=8192, hashmap_size=1 << 21, features=4),
        density_width=64,
        bottleneck=255,
        colour_width=256,
        colour_depth=2,
    ),
    proposals=(
        _proposal(levels=6, max_res=512, hashmap_size=1 << 21, features=1, width=64),
        _proposal(levels=8, max_res=2048, hashmap_size=1 << 21, features=1, width=64),
    ),
    samples=(64, 64, 32),
    multisamples=6,
    footprint="cone",
    dilation=0.5,
)

_BEST = in_half_precision(_PAPER)._replace(footprint="differential")

KIND = FieldKind(
    radiance_config=RadianceFieldConfig,
    init_radiance=init_radiance,
    radiance=radiance,
    density_config=DensityFieldConfig,
    init_density=init_density,
    density=density,
    sizes={"tiny": _TINY, "small": _SMALL, "paper": _PAPER, "best": _BEST},
    hash_decay=0.1,
)
