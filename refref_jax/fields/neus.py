"""NeuS and UNISURF field kinds: a surface where a signed value is 0, in a ball, and a field around.

Inside a ball around what the cameras look at, a network has a signed value `f`, negative inside the
surface, and a colour. Beyond the ball, a field of half the size of Zip-NeRF's has density and
colour, as walls have no place in a ball; NeuS has a second network for it, too. In front of the
ball, up to the point of a ray that is nearest to its centre, there is nothing, as in NeuS: as long
as the surface hides what is behind it, such a field would learn a picture for every camera.

How `f` stops light is the only difference between the two kinds. Both laws give the optical depth
`D` of an interval, `alpha = 1 - exp(-D)`, with `f` in units of the ball's radius:

- NeuS: `D = max(0, log sigma(s f_prev) - log sigma(s f_next))`. `sigma` is the logistic function,
  `s` the sharpness, which is learned, and `f_prev`, `f_next` are `f` at the ends of the interval,
  extrapolated from its middle along the slope of `f`. Depths of adjacent intervals add up to that
  of both if `f` is linear, and the weight of an interval is largest where `f = 0`. This is the
  published `alpha`, without the 1e-5 by which numerator and denominator are padded there.
- UNISURF: `D = softplus(-10 f)`, as the occupancy `alpha = sigma(-10 f)` does not depend on length.

The initial `f` is exactly that of a ball (the published geometric initialisation approximates one):
the network adds to it, and its last layer begins with zeros. Slope and curvature of `f` are finite
differences over a cell of the finest grid (`hash_grid.slope`).

This is the method on the fields of this library: grids, proposals, sampling, colour loss and
schedule are those of Zip-NeRF's preset. The signed value has no cone: it is that of the mean of the
multisamples.

Sources: Wang et al., NeuS (2021), and its code, `Totoro97/NeuS` at commit 6e0a230, for the opacity;
Oechsle et al., UNISURF (2021), for the occupancy; `autonomousvision/sdfstudio` at commit 370902a,
`neus-facto`, for proposals, the size `paper`, and the schedule of the curvature. The other sizes
are ours.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.choices import Position
from refref_jax.fields import zipnerf
from refref_jax.fields.base import (
    FieldKind,
    FieldSize,
    Params,
    Surface,
    dense,
    evaluate,
    in_half_precision,
    shape_of,
)
from refref_jax.fields.hash_grid import (
    TETRAHEDRON,
    GridDensityConfig,
    GridRadianceConfig,
    HashGrid,
    HashGridConfig,
    directional_network,
    laplacian,
    slope,
)
from refref_jax.sampling.polylines import Gaussians

# Bounds of `s f`: sums of as many depths as there are samples are finite, and so are gradients.
_LARGEST = 1e9

# Factor on the network's share of the signed value. Adam changes parameters by about the learning
# rate, however small the gradient: without the factor, a common offset inflates the surface to the
# ball before there are colours. (NeuS has a learning rate of 5e-4 instead, proposals 1e-2.)
PACE = 0.1

# Bounds of the sharpness, as published.
_SHARPNESS = (1e-6, 1e6)

# Scene radii per edge of the unit cube, in bounded and spherical scenes.
_RADII_PER_EDGE = 2.0


@dataclasses.dataclass(frozen=True)
class SurfaceConfig(GridRadianceConfig):
    """Shape of a field with a surface; see also `GridRadianceConfig`, whose grid is in the ball.

    Attributes:
      around: hash grid of the field around the ball; its networks have the widths of the others.
      ball_centre: centre of the ball, in edges of the unit cube, from its corner.
      ball_radius: radius of the ball, in edges of the unit cube.
      start: radius of the initial surface, in radii of the ball.
      sharpness: initial sharpness `s`, or steepness of an occupancy, per radius of the ball.
      head_on: share of the slope's own cosine at the begin and at the end of training. The rest is
        a cosine that also closes a surface that is seen from the side or from behind.
    """

    around: HashGridConfig = dataclasses.field(kw_only=True)
    ball_centre: Position = dataclasses.field(default=(0.5, 0.5, 0.5), kw_only=True)
    ball_radius: float = dataclasses.field(default=0.25, kw_only=True)
    start: float = dataclasses.field(default=0.5, kw_only=True)
    sharpness: float = dataclasses.field(default=20.0, kw_only=True)
    head_on: tuple[float, float] = dataclasses.field(default=(1.0, 1.0), kw_only=True)

    def __post_init__(self) -> None:
        """Validates the numbers."""
        super().__post_init__()
        if not 0.0 < self.ball_radius <= 0.5 or not 0.0 < self.start < 1.0:
            raise ValueError(
                f"A surface with ball_radius={self.ball_radius} and start={self.start} is invalid. "
                "Give a radius of at most half an edge of the cube, and a share of it."
            )
        if not _SHARPNESS[0] <= self.sharpness <= _SHARPNESS[1]:
            raise ValueError(
                f"The sharpness is {self.sharpness}. Give {_SHARPNESS[0]:g} to {_SHARPNESS[1]:g}."
            )
        if not all(0.0 <= share <= 1.0 for share in self.head_on):
            raise ValueError(f"head_on is {self.head_on}. Give two shares from 0 to 1.")


@dataclasses.dataclass(frozen=True)
class NeusConfig(SurfaceConfig):
    """Shape of a field with a surface, by NeuS; see `SurfaceConfig`."""

    kind: Literal["neus"] = dataclasses.field(default="neus", kw_only=True)


@dataclasses.dataclass(frozen=True)
class UnisurfConfig(SurfaceConfig):
    """Shape of a field with a surface, by UNISURF; see `SurfaceConfig`."""

    sharpness: float = dataclasses.field(default=10.0, kw_only=True)
    kind: Literal["unisurf"] = dataclasses.field(default="unisurf", kw_only=True)


@dataclasses.dataclass(frozen=True)
class NeusProposalConfig(GridDensityConfig):
    """Shape of a density field, which is that of Zip-NeRF; see `GridDensityConfig`."""

    kind: Literal["neus"] = dataclasses.field(default="neus", kw_only=True)


@dataclasses.dataclass(frozen=True)
class UnisurfProposalConfig(GridDensityConfig):
    """Shape of a density field, which is that of Zip-NeRF; see `GridDensityConfig`."""

    kind: Literal["unisurf"] = dataclasses.field(default="unisurf", kw_only=True)


class NeusParams(NamedTuple):
    """Parameters of a field with a surface.

    Attributes:
      surface: parameters of signed value and colour in the ball.
      around: parameters of the field around it.
      log_sharpness: natural logarithm of the sharpness; `None` of an occupancy, which has a fixed
        one.
      index_change: change of the index of refraction of a surface that bends light
        (`fields.tnsr`), if it is learned.
    """

    surface: Params
    around: Params
    log_sharpness: Float[Array, ""] | None
    index_change: Float[Array, ""] | None = None


class Visible(NamedTuple):
    """What is known of a point whose colour is wanted.

    Attributes:
      features: features of the point, without activation.
      position: the point in the ball, whose radius is 1.
      normal: unit normal, outwards.
      direction: unit direction of travel, towards the surface.
    """

    features: Float[Array, " features"]
    position: Float[Array, "3"]
    normal: Float[Array, "3"]
    direction: Float[Array, "3"]


Colour = Callable[[Visible, Any], Float[Array, "3"]]
"""Function of a point and the shape of the field, in a module, that returns a colour in `[0, 1]`.
"""


def view_dependent(point: Visible, config: SurfaceConfig) -> Float[Array, "3"]:
    """Returns the colour of a point by NeuS: a network of its features, normal and direction."""
    seen = jnp.concatenate([point.features, point.normal])
    return jax.nn.sigmoid(directional_network(seen, point.direction, config, outputs=3))


def init_radiance(
    key: Array, config: SurfaceConfig, *, colour: Colour = view_dependent
) -> NeusParams:
    """Returns initial parameters: those of a ball.

    Args:
      key: key of the random numbers.
      config: shape of the field.
      colour: network of the colour.
    """
    surface_key, around_key = jax.random.split(key)
    nowhere = jnp.zeros(3, jnp.float32)
    learned = None if isinstance(config, UnisurfConfig) else jnp.log(jnp.float32(config.sharpness))
    return NeusParams(
        _Surface(config, colour).init(surface_key, nowhere, nowhere),
        zipnerf.init_radiance(around_key, around(config)),
        learned,
    )


def radiance(
    params: NeusParams,
    config: SurfaceConfig,
    gaussians: Gaussians,
    direction: Float[Array, "3"],
    *,
    colour: Colour = view_dependent,
) -> Surface:
    """Returns signed value, density and colour of one interval of a path.

    Args:
      params: parameters, from `init_radiance`.
      config: shape of the field, as in `init_radiance`.
      gaussians: multisamples in the unit cube, as fractions of its edge.
      direction: unit direction of travel at the interval, world frame.
      colour: network of the colour, as in `init_radiance`.
    """
    middle = jnp.mean(gaussians.positions, axis=0)
    centre = jnp.asarray(config.ball_centre, middle.dtype)
    position = (middle - centre) / config.ball_radius
    within = numerics.length(position) < 1.0
    signed, steepest, curvature, rgb = evaluate(
        _Surface(config, colour), params.surface, jnp.clip(position, -1.0, 1.0), direction
    )
    outer = zipnerf.radiance(params.around, around(config), gaussians, direction)
    behind = numerics.dot(position, direction) > 0.0
    density = jnp.where(behind, outer.density, 0.0)
    rgb = jnp.where(within, zipnerf.pad_colour(rgb), outer.rgb)
    return Surface(signed, steepest, curvature, within, density, rgb)


def neus_depth(
    params: NeusParams,
    config: SurfaceConfig,
    seen: Surface,
    direction: Float[Array, "3"],
    length: Float[Array, ""],
    progress: Float[Array, ""],
) -> Float[Array, ""]:
    """Returns the optical depth of an interval; see `FieldKind.depth`."""
    assert params.log_sharpness is not None
    sharpness = jnp.exp(jnp.clip(params.log_sharpness, *map(math.log, _SHARPNESS)))
    first, last = config.head_on
    change = falling(numerics.dot(seen.slope, direction), first + (last - first) * progress)
    step = 0.5 * change * length / (_RADII_PER_EDGE * config.ball_radius)
    depth = logistic_depth(seen.signed + step, seen.signed - step, sharpness)
    return jnp.where(seen.within, depth, seen.density * length)


def falling(cosine: Float[Array, ""], head_on: Float[Array, ""]) -> Float[Array, ""]:
    """Returns how fast the signed value is taken to fall along a ray, at least 0.

    Args:
      cosine: slope of the signed value along the ray.
      head_on: share of this cosine. At 1, a signed value that grows along the ray stops no light.

    Source: Wang et al., NeuS, code (cosine annealing).
    """
    spread = jax.nn.relu(0.5 - 0.5 * cosine)
    return spread * (1.0 - head_on) + jax.nn.relu(-cosine) * head_on


def logistic_depth(
    before: Float[Array, ""], after: Float[Array, ""], sharpness: Float[Array, ""]
) -> Float[Array, ""]:
    """Returns the optical depth between two signed values on a ray: that of NeuS.

    Value and gradient are finite for finite arguments whose product with the sharpness is, too.

    Args:
      before: signed value where light leaves the interval, towards the camera.
      after: signed value at the other end.
      sharpness: sharpness `s`, positive, in the inverse unit of the signed values.
    """
    reach = [jnp.clip(sharpness * f, -_LARGEST, _LARGEST) for f in (before, after)]
    return jax.nn.relu(jax.nn.log_sigmoid(reach[0]) - jax.nn.log_sigmoid(reach[1]))


def unisurf_depth(
    params: NeusParams,
    config: SurfaceConfig,
    seen: Surface,
    direction: Float[Array, "3"],
    length: Float[Array, ""],
    progress: Float[Array, ""],
) -> Float[Array, ""]:
    """Returns the optical depth of an interval; see `FieldKind.depth`.

    Intervals without length, as at the bends of a path, stop nothing.
    """
    del params, direction, progress
    occupied = jax.nn.softplus(-config.sharpness * seen.signed)
    within = jnp.where(length > 0.0, occupied, 0.0)
    return jnp.where(seen.within, within, seen.density * length)


def around(config: SurfaceConfig) -> zipnerf.RadianceFieldConfig:
    """Returns the shape of the field around the ball."""
    return zipnerf.RadianceFieldConfig(
        config.around,
        config.density_width,
        config.bottleneck,
        config.colour_width,
        config.colour_depth,
        config.colour_network,
        precision=config.precision,
    )


def _signed_values(
    points: Float[Array, "n 3"], config: SurfaceConfig
) -> tuple[Float[Array, " n"], Float[Array, "n width"]]:
    """Returns signed values at points of the unit ball, and the hidden layer, in a module."""
    layer = dense(config.precision)
    every = nn.vmap(HashGrid, variable_axes={"params": None}, split_rngs={"params": False})
    cells, scales = 0.5 * points + 0.5, jnp.zeros_like(points[:, 0])
    features = every(config.grid, config.precision, name="grid")(cells, scales)
    hidden = layer(config.density_width)(jnp.concatenate([features, points], axis=-1))
    hidden = nn.softplus(hidden)
    ball = numerics.length(points) - config.start
    # Zero initial weights, so that the field starts as the ball alone.
    change = layer(1, kernel_init=nn.initializers.zeros)(hidden)[:, 0]
    return ball + PACE * change, hidden


class SignedValue(nn.Module):
    """Signed values at points of the unit ball, by `NeusParams.surface`.

    Attributes:
      config: shape of the field.
    """

    config: SurfaceConfig

    @nn.compact
    def __call__(self, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Returns the values; beyond the cube around the ball, those of its nearest points."""
        return _signed_values(jnp.clip(points, -1.0, 1.0), self.config)[0]


class _Surface(nn.Module):
    """Signed value, its slope and curvature, and colour, at a point of the unit ball."""

    config: SurfaceConfig
    colour: Colour

    @nn.compact
    def __call__(
        self, position: Float[Array, "3"], direction: Float[Array, "3"]
    ) -> tuple[Float[Array, ""], Float[Array, "3"], Float[Array, ""], Float[Array, "3"]]:
        config = self.config
        layer = dense(config.precision)
        step = 2.0 / config.grid.max_res
        offsets = jnp.asarray([(0.0, 0.0, 0.0), *TETRAHEDRON], position.dtype)
        signed, hidden = _signed_values(position[None] + step * offsets, config)
        steepest = slope(signed[1:], step=step)
        features = layer(config.bottleneck)(hidden[0])
        normal = numerics.normalize(steepest)
        rgb = self.colour(Visible(features, position, normal, direction), config)
        return signed[0], steepest, laplacian(signed[0], signed[1:], step=step), rgb


def _size(
    size: FieldSize, grid: HashGridConfig, *, width: int, head_on: tuple[float, float]
) -> FieldSize:
    """Returns a size of Zip-NeRF's fields with a surface.

    Args:
      size: size of Zip-NeRF's fields.
      grid: hash grid in the ball.
      width: width of the hidden layers.
      head_on: shares of the slope's own cosine, as in `SurfaceConfig`.
    """
    plain = size.field
    assert isinstance(plain, GridRadianceConfig)
    half = dataclasses.replace(plain.grid, hashmap_size=plain.grid.hashmap_size // 2)
    shape = shape_of(plain) | {"grid": grid, "density_width": width}
    field = NeusConfig(**shape, around=half, head_on=head_on)
    proposals = tuple(NeusProposalConfig(**shape_of(each)) for each in size.proposals)
    # Fewer samples before walls were not tried.
    return size._replace(field=field, proposals=proposals, background_samples=None)


def _of_occupancy(size: FieldSize) -> FieldSize:
    """Returns the same fields with UNISURF's occupancy."""
    shape = shape_of(size.field) | {"sharpness": 10.0}
    proposals = tuple(UnisurfProposalConfig(**shape_of(each)) for each in size.proposals)
    return size._replace(field=UnisurfConfig(**shape), proposals=proposals)


def _proposal(max_res: int) -> NeusProposalConfig:
    """Returns the proposal field of `neus-facto` with a finest resolution."""
    grid = HashGridConfig(5, base_res=16, max_res=max_res, hashmap_size=1 << 17, features=2)
    return NeusProposalConfig(grid, width=16)


_TINY = _size(
    zipnerf.KIND.sizes["tiny"],
    HashGridConfig(levels=6, base_res=8, max_res=128, hashmap_size=1 << 15, features=4),
    width=32,
    head_on=(1.0, 1.0),
)

_SMALL = _size(
    zipnerf.KIND.sizes["small"],
    HashGridConfig(levels=8, base_res=8, max_res=256, hashmap_size=1 << 17, features=4),
    width=64,
    head_on=(1.0, 1.0),
)

_PAPER = _size(
    zipnerf.KIND.sizes["paper"],
    HashGridConfig(levels=16, base_res=16, max_res=2048, hashmap_size=1 << 19, features=2),
    width=256,
    head_on=(0.0, 0.4),
)._replace(
    proposals=(_proposal(64), _proposal(256)),
    samples=(256, 96, 48),
    multisamples=1,
    dilation=0.0,
)

_SIZES = {"tiny": _TINY, "small": _SMALL, "paper": _PAPER, "best": in_half_precision(_PAPER)}

KIND = FieldKind(
    radiance_config=NeusConfig,
    init_radiance=init_radiance,
    radiance=radiance,
    density_config=NeusProposalConfig,
    init_density=zipnerf.init_density,
    density=zipnerf.density,
    sizes=_SIZES,
    hash_decay=zipnerf.KIND.hash_decay,
    depth=neus_depth,
    eikonal=0.1,
    curvature=0.0,
)

UNISURF = KIND._replace(
    radiance_config=UnisurfConfig,
    density_config=UnisurfProposalConfig,
    sizes={name: _of_occupancy(size) for name, size in _SIZES.items()},
    depth=unisurf_depth,
    eikonal=0.0,
)
