"""Nerfacto fields, for the paper's ablation "without Zip-NeRF".

The hash grids are those of the Zip-NeRF fields, but queried at points: levels are not down-weighted
for wide pixels, so there is no anti-aliasing, and an interval has one sample on its path. Density
is an exponential of the network output, and colour a sigmoid.

Published Nerfacto also learns appearance embeddings and camera corrections, which concern
photographs rather than the field; both are omitted. Sampling (with the first proposal level uniform
in warped distance) and the proposal loss are those that this library uses for all field kinds.
Networks have biases, as in the PyTorch version.

Source: Tancik et al., Nerfstudio (2023), section 4, and its code, `nerfstudio/models/nerfacto.py`,
`fields/nerfacto_field.py` and `fields/density_fields.py` at commit 50e0e3c, for the size `paper`;
the paper's own version of it (`YueYin27/nerfstudio_for_engn8501`) has the same numbers. The
untrained density is near 1 there and here; later versions of Nerfacto start at 0.01.
"""

import dataclasses
from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
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


@dataclasses.dataclass(frozen=True)
class NerfactoConfig(GridRadianceConfig):
    """Shape of a radiance field; see `GridRadianceConfig`."""

    kind: Literal["nerfacto"] = dataclasses.field(default="nerfacto", kw_only=True)


@dataclasses.dataclass(frozen=True)
class NerfactoProposalConfig(GridDensityConfig):
    """Shape of a density field; see `GridDensityConfig`."""

    kind: Literal["nerfacto"] = dataclasses.field(default="nerfacto", kw_only=True)


def init_radiance(key: Array, config: NerfactoConfig) -> Params:
    """Returns initial parameters of a radiance field."""
    return _RadianceField(config).init(key, nowhere(), jnp.zeros(3, jnp.float32))


def radiance(
    params: Params, config: NerfactoConfig, gaussians: Gaussians, direction: Float[Array, "3"]
) -> Radiance:
    """Returns density and colour of one interval of a path.

    Args:
      params: parameters, from `init_radiance`.
      config: shape of the field, as in `init_radiance`.
      gaussians: points in the unit cube; their scales are ignored.
      direction: unit direction of travel at the interval, world frame.
    """
    return evaluate(_RadianceField(config), params, gaussians, direction)


def init_density(key: Array, config: NerfactoProposalConfig) -> Params:
    """Returns initial parameters of a density field."""
    return _DensityField(config).init(key, nowhere())


def density(
    params: Params, config: NerfactoProposalConfig, gaussians: Gaussians
) -> Float[Array, ""]:
    """Returns the density of one interval of a path, per scene radius.

    Args:
      params: parameters, from `init_density`.
      config: shape of the field, as in `init_density`.
      gaussians: points in the unit cube; their scales are ignored.
    """
    return evaluate(_DensityField(config), params, gaussians)


def _points(gaussians: Gaussians) -> Gaussians:
    """Returns Gaussians of scale 0, for which no level is down-weighted."""
    return gaussians._replace(scales=jnp.zeros_like(gaussians.scales))


class _DensityField(nn.Module):
    config: NerfactoProposalConfig

    @nn.compact
    def __call__(self, gaussians: Gaussians) -> Float[Array, ""]:
        config = self.config
        raw = grid_network(
            _points(gaussians),
            config.grid,
            width=config.width,
            outputs=1,
            precision=config.precision,
        )
        return numerics.truncated_exponential(raw[0])


class _RadianceField(nn.Module):
    config: NerfactoConfig

    @nn.compact
    def __call__(self, gaussians: Gaussians, direction: Float[Array, "3"]) -> Radiance:
        config = self.config
        density, rgb = density_and_colour(_points(gaussians), direction, config)
        return Radiance(numerics.truncated_exponential(density), rgb)


def _proposal(*, levels: int, max_res: int, hashmap_size: int) -> NerfactoProposalConfig:
    grid = HashGridConfig(
        levels, base_res=16, max_res=max_res, hashmap_size=hashmap_size, features=2
    )
    return NerfactoProposalConfig(grid, width=16)


_TINY = FieldSize(
    field=NerfactoConfig(
        HashGridConfig(levels=8, base_res=16, max_res=512, hashmap_size=1 << 17, features=2),
        density_width=32,
        bottleneck=15,
        colour_width=32,
        colour_depth=2,
    ),
    proposals=tuple(
        _proposal(levels=4, max_res=max_res, hashmap_size=1 << 15) for max_res in (32, 64)
    ),
    samples=(48, 24, 16),
    multisamples=1,
    footprint="cone",
    dilation=0.0,
)

_PAPER = FieldSize(
    field=NerfactoConfig(
        HashGridConfig(levels=16, base_res=16, max_res=2048, hashmap_size=1 << 19, features=2),
        density_width=64,
        bottleneck=15,
        colour_width=64,
        colour_depth=2,
    ),
    proposals=tuple(
        _proposal(levels=5, max_res=max_res, hashmap_size=1 << 17) for max_res in (128, 256)
    ),
    samples=(256, 96, 48),
    multisamples=1,
    footprint="cone",
    dilation=0.0,
)

_SMALL = _PAPER._replace(samples=(96, 48, 32))

KIND = FieldKind(
    radiance_config=NerfactoConfig,
    init_radiance=init_radiance,
    radiance=radiance,
    density_config=NerfactoProposalConfig,
    init_density=init_density,
    density=density,
    sizes={"tiny": _TINY, "small": _SMALL, "paper": _PAPER, "best": in_half_precision(_PAPER)},
    hash_decay=0.0,
)
