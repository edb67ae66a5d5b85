"""Ray deformation field kinds: a network moves and turns the samples of straight rays.

A small network maps a point of a straight ray and the ray's direction to an offset of the point and
of the direction; density and colour are those of Zip-NeRF's field (`fields/zipnerf.py`) at the
moved point, seen along the turned direction. Point and direction fix the ray, so any light path
that depends on the ray alone is in reach. Lengths and distances are those of the straight ray.

`raydef` moves every sample. `raydef_polyline`, which is ours, evaluates the network at a few knots
of each ray, and samples the polyline through the moved knots: light paths are piecewise linear by
construction, and the network is evaluated a fifth as often.

There is no code of the method, and only its abstract was at hand: "position and direction offsets",
and a regularisation towards "piece-wise linear light paths". Networks, encodings, their window, the
losses (`training/objective.py`) and all sizes are our reading.

Source: Deng et al., Ray Deformation Networks for Novel View Synthesis of Refractive Objects (2024),
abstract; Park et al., Nerfies (2021), section 3.4, for the window, and its code for the network
(6 layers of 128, the last one begins near 0).
"""

import dataclasses
import math
from typing import Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax.fields import zipnerf
from refref_jax.fields.base import (
    FieldKind,
    FieldSize,
    Offset,
    Params,
    Radiance,
    dense,
    evaluate,
    in_half_precision,
    shape_of,
)
from refref_jax.fields.hash_grid import (
    GridDensityConfig,
    GridRadianceConfig,
    spherical_harmonics,
)
from refref_jax.sampling.polylines import Gaussians

# Range of the initial weights of the last layer: the first light paths are nearly straight.
_INITIAL_RANGE = 1e-4

# Factor on the network's outputs. Adam changes parameters by about the learning rate, which is that
# of the hash grid: without the factor, the knots of polylines run away in 200 steps.
_PACE = 0.1

# Share of the training after which all octaves of the position are seen.
_OPENED = 0.2

# Layer of the network after which its inputs are appended, if it has more.
_SKIP = 4


@dataclasses.dataclass(frozen=True)
class DeformationConfig(GridRadianceConfig):
    """Shape of a radiance field behind a deformation; see also `GridRadianceConfig`.

    Attributes:
      octaves: number of octaves of the encoded position.
      deformation_width: width of the hidden layers of the deformation.
      deformation_depth: number of its hidden layers.
    """

    octaves: int = dataclasses.field(kw_only=True)
    deformation_width: int = dataclasses.field(kw_only=True)
    deformation_depth: int = dataclasses.field(kw_only=True)

    def __post_init__(self) -> None:
        """Validates the numbers."""
        super().__post_init__()
        if min(self.octaves, self.deformation_width, self.deformation_depth) < 1:
            raise ValueError(
                f"A deformation with octaves={self.octaves}, "
                f"deformation_width={self.deformation_width} and "
                f"deformation_depth={self.deformation_depth} is invalid. Give at least 1 of each."
            )


@dataclasses.dataclass(frozen=True)
class RaydefConfig(DeformationConfig):
    """Shape of a radiance field that moves every sample; see `DeformationConfig`."""

    kind: Literal["raydef"] = dataclasses.field(default="raydef", kw_only=True)


@dataclasses.dataclass(frozen=True)
class RaydefPolylineConfig(DeformationConfig):
    """Shape of a radiance field whose rays are bent to polylines; see also `DeformationConfig`.

    Attributes:
      knots: number of knots of a ray, whose offsets make the polyline.
    """

    knots: int = dataclasses.field(kw_only=True)
    kind: Literal["raydef_polyline"] = dataclasses.field(default="raydef_polyline", kw_only=True)

    def __post_init__(self) -> None:
        """Validates the numbers."""
        super().__post_init__()
        if self.knots < 2:
            raise ValueError(f"knots is {self.knots}, but a ray needs 2 to bend. Give 2 or more.")


@dataclasses.dataclass(frozen=True)
class RaydefProposalConfig(GridDensityConfig):
    """Shape of a density field, which is that of Zip-NeRF; see `GridDensityConfig`."""

    kind: Literal["raydef"] = dataclasses.field(default="raydef", kw_only=True)


@dataclasses.dataclass(frozen=True)
class RaydefPolylineProposalConfig(GridDensityConfig):
    """Shape of a density field, which is that of Zip-NeRF; see `GridDensityConfig`."""

    kind: Literal["raydef_polyline"] = dataclasses.field(default="raydef_polyline", kw_only=True)


class RaydefParams(NamedTuple):
    """Parameters of a radiance field behind a deformation.

    Attributes:
      field: parameters of the radiance field.
      deformation: parameters of the deformation.
    """

    field: Params
    deformation: Params


def init_radiance(key: Array, config: DeformationConfig) -> RaydefParams:
    """Returns initial parameters, of nearly straight rays."""
    field_key, deformation_key = jax.random.split(key)
    nowhere = jnp.zeros(3, jnp.float32)
    return RaydefParams(
        zipnerf.init_radiance(field_key, _plain(config)),
        _Deformation(config).init(deformation_key, nowhere, nowhere, jnp.float32(1.0)),
    )


def radiance(
    params: RaydefParams,
    config: DeformationConfig,
    gaussians: Gaussians,
    direction: Float[Array, "3"],
) -> Radiance:
    """Returns density and colour where an interval has been moved to.

    Args:
      params: parameters, from `init_radiance`.
      config: shape of the field, as in `init_radiance`.
      gaussians: moved multisamples in the unit cube, as fractions of its edge.
      direction: turned unit direction of travel at the interval, world frame.
    """
    return zipnerf.radiance(params.field, _plain(config), gaussians, direction)


def deform(
    params: RaydefParams,
    config: DeformationConfig,
    position: Float[Array, "3"],
    direction: Float[Array, "3"],
    progress: Float[Array, ""],
) -> Offset:
    """Returns the offset of a point of a straight ray, and of the ray's direction there.

    Args:
      params: parameters, from `init_radiance`.
      config: shape of the field, as in `init_radiance`.
      position: the point, in the unit cube, as fractions of its edge.
      direction: unit direction of the ray.
      progress: progress of the training, 0 to 1, in whose first fifth details of the position
        appear, from coarse to fine.
    """
    return evaluate(_Deformation(config), params.deformation, position, direction, progress)


def windowed(
    position: Float[Array, "3"], octaves: int, progress: Float[Array, ""]
) -> Float[Array, " features"]:
    """Returns sine and cosine of a position in `[-1, 1]^3`, octave by octave, faded in one by one.

    Octave `k` has the factor `(1 - cos(pi clip(a - k, 0, 1))) / 2`, where `a` grows from 0 to the
    number of octaves.

    Args:
      position: the position.
      octaves: number of octaves; the first has the period 2.
      progress: progress of the training, 0 to 1.

    Source: Park et al., Nerfies (2021), Eq 8 and 9.
    """
    each = jnp.arange(octaves, dtype=position.dtype)
    opened = octaves * progress / _OPENED
    window = 0.5 - 0.5 * jnp.cos(math.pi * jnp.clip(opened - each, 0.0, 1.0))
    angles = math.pi * (2.0**each)[:, None] * position[None]
    waves = jnp.stack([jnp.sin(angles), jnp.cos(angles)])
    return (window[None, :, None] * waves).reshape(-1)


class _Deformation(nn.Module):
    config: DeformationConfig

    @nn.compact
    def __call__(
        self,
        position: Float[Array, "3"],
        direction: Float[Array, "3"],
        progress: Float[Array, ""],
    ) -> Offset:
        config = self.config
        # Places are not rounded to bfloat16, whatever the precision of the field.
        layer, width = dense("float32"), config.deformation_width
        centred = 2.0 * position - 1.0
        waves = windowed(centred, config.octaves, progress)
        inputs = hidden = jnp.concatenate([centred, waves, spherical_harmonics(direction)])
        for i in range(config.deformation_depth):
            if i == _SKIP:
                hidden = jnp.concatenate([hidden, inputs])
            hidden = nn.relu(layer(width, kernel_init=nn.initializers.xavier_uniform())(hidden))
        small = nn.initializers.uniform(_INITIAL_RANGE)
        offsets = _PACE * layer(6, kernel_init=small)(hidden)
        return Offset(offsets[:3], offsets[3:])


def _plain(config: DeformationConfig) -> zipnerf.RadianceFieldConfig:
    """Returns the shape of the field without its deformation."""
    names = {each.name for each in dataclasses.fields(zipnerf.RadianceFieldConfig)}
    shape = {name: value for name, value in shape_of(config).items() if name in names}
    return zipnerf.RadianceFieldConfig(**shape)


def _size(name: str, *, width: int, depth: int) -> FieldSize:
    """Returns the size of Zip-NeRF's fields of that name, behind a deformation."""
    size = zipnerf.KIND.sizes[name]
    field = RaydefConfig(
        **shape_of(size.field), octaves=6, deformation_width=width, deformation_depth=depth
    )
    proposals = tuple(RaydefProposalConfig(**shape_of(each)) for each in size.proposals)
    # Fewer samples before walls were not tried.
    return size._replace(field=field, proposals=proposals, background_samples=None)


def _bent(size: FieldSize, knots: int) -> FieldSize:
    """Returns the same fields behind polylines."""
    field = RaydefPolylineConfig(**shape_of(size.field), knots=knots)
    proposals = tuple(RaydefPolylineProposalConfig(**shape_of(each)) for each in size.proposals)
    return size._replace(field=field, proposals=proposals)


_PAPER = _size("paper", width=128, depth=6)

_SIZES = {
    "tiny": _size("tiny", width=32, depth=2),
    "small": _size("small", width=64, depth=3),
    "paper": _PAPER,
    "best": in_half_precision(_PAPER)._replace(footprint=zipnerf.KIND.sizes["best"].footprint),
}

_KNOTS = {"tiny": 10, "small": 10, "paper": 16, "best": 16}

KIND = FieldKind(
    radiance_config=RaydefConfig,
    init_radiance=init_radiance,
    radiance=radiance,
    density_config=RaydefProposalConfig,
    init_density=zipnerf.init_density,
    density=zipnerf.density,
    sizes=_SIZES,
    hash_decay=zipnerf.KIND.hash_decay,
    deform=deform,
    deformation=(3e-3, 1e-3, 1e-4),
)

POLYLINE = KIND._replace(
    radiance_config=RaydefPolylineConfig,
    density_config=RaydefPolylineProposalConfig,
    sizes={name: _bent(size, _KNOTS[name]) for name, size in _SIZES.items()},
)
