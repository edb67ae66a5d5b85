"""MS-NeRF field kind: several sub-spaces, each with density and features, blended along a path.

Each of the `K` sub-spaces has a density `sigma_i^k` and features `f_i^k` in interval `i`. It is
integrated along the path by itself, by the volume rendering equation: `F^k = sum_i w_i^k f_i^k`.
One small network, shared by the sub-spaces, decodes `F^k` to a colour `c^k`, and another to a gate
`g^k`; with the shares `a = softmax(g)`, the colour of the path is `sum_k a^k c^k`. A virtual image
behind a mirror or a glass surface can so have a sub-space of its own. Distances and losses see the
weights `w_i = sum_k a^k w_i^k`.

This is the method on the fields of this library: grids, networks, proposals, sampling and losses
are those of Zip-NeRF (`fields/zipnerf.py`), in place of Mip-NeRF 360's. Colours are linear, as
those of all field kinds; the published decoder returns sRGB. The transmittance of a sub-space
accumulates along the path; in the published code it accumulates over the sub-spaces.

Source: Yin et al., Multi-Space Neural Radiance Fields (2023), and its code, `ZX-Yin/ms-nerf` at
commit 253addc: `mip360/internal/models.py` and `mip360/configs/ms-nerf/ms360.gin`, for the networks
and the size `paper`. The other sizes are ours.
"""

import dataclasses
from typing import Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax.fields import zipnerf
from refref_jax.fields.base import (
    Blend,
    FieldKind,
    FieldSize,
    Params,
    SubSpaces,
    dense,
    evaluate,
    shape_of,
)
from refref_jax.fields.hash_grid import (
    GridDensityConfig,
    GridRadianceConfig,
    directional_network,
    grid_network,
    nowhere,
)
from refref_jax.sampling.polylines import Gaussians


@dataclasses.dataclass(frozen=True)
class MsnerfConfig(GridRadianceConfig):
    """Shape of a radiance field with sub-spaces; see also `GridRadianceConfig`.

    Attributes:
      sub_spaces: number of sub-spaces.
      channels: number of features of each sub-space.
      decoder_width: width of the hidden layer of the decoder, and of that of the gate.
    """

    sub_spaces: int = dataclasses.field(kw_only=True)
    channels: int = dataclasses.field(kw_only=True)
    decoder_width: int = dataclasses.field(kw_only=True)
    kind: Literal["msnerf"] = dataclasses.field(default="msnerf", kw_only=True)

    def __post_init__(self) -> None:
        """Validates the numbers."""
        super().__post_init__()
        if min(self.sub_spaces, self.channels, self.decoder_width) < 1:
            raise ValueError(
                f"A field with sub_spaces={self.sub_spaces}, channels={self.channels} and "
                f"decoder_width={self.decoder_width} is invalid. Give at least 1 of each."
            )


@dataclasses.dataclass(frozen=True)
class MsnerfProposalConfig(GridDensityConfig):
    """Shape of a density field, which is that of Zip-NeRF; see `GridDensityConfig`."""

    kind: Literal["msnerf"] = dataclasses.field(default="msnerf", kw_only=True)


class MsnerfParams(NamedTuple):
    """Parameters of a radiance field with sub-spaces.

    Attributes:
      sub_spaces: parameters of densities and features.
      decoder: parameters of decoder and gate.
    """

    sub_spaces: Params
    decoder: Params


def init_radiance(key: Array, config: MsnerfConfig) -> MsnerfParams:
    """Returns initial parameters; the gate begins with nearly equal shares."""
    field_key, decoder_key = jax.random.split(key)
    features = jnp.zeros((config.sub_spaces, config.channels), jnp.float32)
    return MsnerfParams(
        _SubSpaces(config).init(field_key, nowhere(), jnp.zeros(3, jnp.float32)),
        _Decoder(config).init(decoder_key, features),
    )


def radiance(
    params: MsnerfParams,
    config: MsnerfConfig,
    gaussians: Gaussians,
    direction: Float[Array, "3"],
) -> SubSpaces:
    """Returns densities and features of one interval of a path.

    Args:
      params: parameters, from `init_radiance`.
      config: shape of the field, as in `init_radiance`.
      gaussians: multisamples in the unit cube, as fractions of its edge.
      direction: unit direction of travel at the interval, world frame.
    """
    return evaluate(_SubSpaces(config), params.sub_spaces, gaussians, direction)


def blend(
    params: MsnerfParams, config: MsnerfConfig, features: Float[Array, "sub_spaces channels"]
) -> Blend:
    """Returns colours and shares of the sub-spaces along a path.

    Args:
      params: parameters, from `init_radiance`.
      config: shape of the field, as in `init_radiance`.
      features: features of each sub-space, integrated along the path.
    """
    return evaluate(_Decoder(config), params.decoder, features)


class _SubSpaces(nn.Module):
    config: MsnerfConfig

    @nn.compact
    def __call__(self, gaussians: Gaussians, direction: Float[Array, "3"]) -> SubSpaces:
        config = self.config
        count = config.sub_spaces
        raw = grid_network(
            gaussians,
            config.grid,
            width=config.density_width,
            outputs=count + config.bottleneck,
            precision=config.precision,
        )
        outputs = count * config.channels
        features = directional_network(raw[count:], direction, config, outputs=outputs)
        density = zipnerf.activate_density(raw[:count])
        return SubSpaces(density, nn.relu(features).reshape(count, config.channels))


class _Decoder(nn.Module):
    config: MsnerfConfig

    @nn.compact
    def __call__(self, features: Float[Array, "sub_spaces channels"]) -> Blend:
        layer, width = dense(self.config.precision), self.config.decoder_width
        # Flax numbers layers in order of creation, and checkpoints contain these names.
        hidden = nn.relu(layer(width)(features))
        rgb = jax.nn.sigmoid(layer(3)(hidden))
        hidden = nn.relu(layer(width)(features))
        gates = layer(1)(hidden)[:, 0]
        return Blend(
            zipnerf.pad_colour(rgb, brightest=self.config.brightest), jax.nn.softmax(gates)
        )


def _size(name: str, *, sub_spaces: int, channels: int, decoder_width: int) -> FieldSize:
    """Returns the size of Zip-NeRF's fields of that name, with sub-spaces."""
    size = zipnerf.KIND.sizes[name]
    field = MsnerfConfig(
        **shape_of(size.field),
        sub_spaces=sub_spaces,
        channels=channels,
        decoder_width=decoder_width,
    )
    proposals = tuple(MsnerfProposalConfig(**shape_of(each)) for each in size.proposals)
    # Fewer samples before walls were not tried.
    return size._replace(field=field, proposals=proposals, background_samples=None)


KIND = FieldKind(
    radiance_config=MsnerfConfig,
    init_radiance=init_radiance,
    radiance=radiance,
    density_config=MsnerfProposalConfig,
    init_density=zipnerf.init_density,
    density=zipnerf.density,
    sizes={
        "tiny": _size("tiny", sub_spaces=6, channels=8, decoder_width=16),
        "small": _size("small", sub_spaces=6, channels=24, decoder_width=24),
        "paper": _size("paper", sub_spaces=8, channels=32, decoder_width=64),
        "best": _size("best", sub_spaces=8, channels=32, decoder_width=64),
    },
    hash_decay=zipnerf.KIND.hash_decay,
    blend=blend,
)
