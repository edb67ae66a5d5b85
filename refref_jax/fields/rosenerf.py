"""RoseNeRF field kind: a second straight ray for every ray, and one colour of what both meet.

A network maps a ray to a second one, which may begin elsewhere and go elsewhere: what is seen
through a refracting object lies along another line than the pixel's. Both rays are sampled at the
same distances. A hidden layer sees the features at each sample; those of the two rays are added,
and a decoder turns the sum into density and colour, seen along the direction of the pixel's ray.
Weights, lengths and distances are those of the pixel's ray. During the first fortieth of the
training the second ray is the first.

This is the method on the fields of this library, from its description: the licence of its code
excludes commercial use. Grids, proposals, sampling, colour loss and schedule are those of
Zip-NeRF's preset. There a ray is its crossings of two parallel planes, which suits cameras that all
look one way and is singular for rays along the planes; here it is its point nearest to the middle
of the scene, and its direction. There the network also sees the normal that is expected along the
ray, has no activation, and an inverse network keeps it near the identity; here it sees the ray
alone, has rectifiers, and a loss on the size of its offsets.

Source: Liang et al., Refracting Once is Enough: Neural Radiance Fields for Novel-View Synthesis of
Real Refractive Objects (2024).
"""

import dataclasses
from typing import Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
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
    MultisampledGrid,
    colour,
    nowhere,
    spherical_harmonics,
)
from refref_jax.sampling.polylines import Gaussians

# Range of the initial weights of the last layer: the first second rays are nearly the first rays.
_INITIAL_RANGE = 1e-4

# Factor on the network's outputs, as in `fields.raydef`.
_PACE = 0.1

# Share of the training in which the second ray is the first: 5000 of 200,000 steps.
_WARM_UP = 0.025


@dataclasses.dataclass(frozen=True)
class RosenerfConfig(GridRadianceConfig):
    """Shape of a radiance field of two rays; see also `GridRadianceConfig`.

    Attributes:
      ray_width: width of the hidden layers of the network from ray to second ray.
      ray_depth: number of its hidden layers.
    """

    ray_width: int = dataclasses.field(kw_only=True)
    ray_depth: int = dataclasses.field(kw_only=True)
    kind: Literal["rosenerf"] = dataclasses.field(default="rosenerf", kw_only=True)

    def __post_init__(self) -> None:
        """Validates the numbers."""
        super().__post_init__()
        if min(self.ray_width, self.ray_depth) < 1:
            raise ValueError(
                f"A network of rays with ray_width={self.ray_width} and "
                f"ray_depth={self.ray_depth} is invalid. Give at least 1 of each."
            )


@dataclasses.dataclass(frozen=True)
class RosenerfProposalConfig(GridDensityConfig):
    """Shape of a density field, which is that of Zip-NeRF; see `GridDensityConfig`."""

    kind: Literal["rosenerf"] = dataclasses.field(default="rosenerf", kw_only=True)


class RosenerfParams(NamedTuple):
    """Parameters of a radiance field of two rays.

    Attributes:
      field: parameters of features and decoder.
      rays: parameters of the network from ray to second ray.
    """

    field: Params
    rays: Params


def init_radiance(key: Array, config: RosenerfConfig) -> RosenerfParams:
    """Returns initial parameters, whose second rays are nearly the first ones."""
    field_key, rays_key = jax.random.split(key)
    still = jnp.zeros(3, jnp.float32)
    one = nowhere()
    both = Gaussians(*(jnp.concatenate([x, x]) for x in one))
    return RosenerfParams(
        _TwoRays(config).init(field_key, both, still),
        _SecondRay(config).init(rays_key, still, still),
    )


def radiance(
    params: RosenerfParams,
    config: RosenerfConfig,
    gaussians: Gaussians,
    direction: Float[Array, "3"],
) -> Radiance:
    """Returns density and colour of one interval.

    Args:
      params: parameters, from `init_radiance`.
      config: shape of the field, as in `init_radiance`.
      gaussians: multisamples in the unit cube, as fractions of its edge: those of the ray, then as
        many of the second ray.
      direction: unit direction of the ray, world frame.
    """
    return evaluate(_TwoRays(config), params.field, gaussians, direction)


def second_ray(
    params: RosenerfParams,
    config: RosenerfConfig,
    position: Float[Array, "3"],
    direction: Float[Array, "3"],
    progress: Float[Array, ""],
) -> Offset:
    """Returns the offset from a point of a ray to that of the second ray; see `FieldKind.deform`.

    All points of a ray have the same second ray, and keep their distances along it. (In an
    unbounded scene that holds within the scene radius, where space is not contracted.) Positions
    are offset in half edges of the unit cube: a scene radius, or two in an unbounded scene.

    Args:
      params: parameters, from `init_radiance`.
      config: shape of the field, as in `init_radiance`.
      position: the point, in the unit cube, as fractions of its edge.
      direction: unit direction of the ray.
      progress: progress of the training, 0 to 1.
    """
    centred = 2.0 * position - 1.0
    along = numerics.dot(centred, direction)
    nearest = centred - along * direction
    moved = evaluate(_SecondRay(config), params.rays, nearest, direction)
    moved = jnp.where(progress < _WARM_UP, 0.0, moved)
    turned = numerics.normalize(direction + moved[3:])
    return Offset(moved[:3] + along * (turned - direction), turned - direction)


class _SecondRay(nn.Module):
    """Offsets of a ray's point nearest to the middle, in half edges, and of its direction."""

    config: RosenerfConfig

    @nn.compact
    def __call__(
        self, nearest: Float[Array, "3"], direction: Float[Array, "3"]
    ) -> Float[Array, "6"]:
        # Places are not rounded to bfloat16, whatever the precision of the field.
        layer = dense("float32")
        hidden = jnp.concatenate([nearest, spherical_harmonics(direction)])
        for _ in range(self.config.ray_depth):
            initial = nn.initializers.xavier_uniform()
            hidden = nn.relu(layer(self.config.ray_width, kernel_init=initial)(hidden))
        return _PACE * layer(6, kernel_init=nn.initializers.uniform(_INITIAL_RANGE))(hidden)


class _TwoRays(nn.Module):
    """Density and colour of the sum of two rays' features."""

    config: RosenerfConfig

    @nn.compact
    def __call__(self, gaussians: Gaussians, direction: Float[Array, "3"]) -> Radiance:
        config = self.config
        layer = dense(config.precision)
        grid, first = MultisampledGrid(config.grid, config.precision), layer(config.density_width)
        rays = zip(*(jnp.split(x, 2) for x in gaussians), strict=True)
        features = [nn.relu(first(grid(Gaussians(*ray)))) for ray in rays]
        hidden = nn.relu(layer(config.density_width)(features[0] + features[1]))
        raw = layer(1 + config.bottleneck)(hidden)
        rgb = colour(raw[1:], direction, config)
        return Radiance(
            zipnerf.activate_density(raw[0]), zipnerf.pad_colour(rgb, brightest=config.brightest)
        )


def _size(name: str, *, width: int, depth: int) -> FieldSize:
    """Returns the size of Zip-NeRF's fields of that name, with two rays."""
    size = zipnerf.KIND.sizes[name]
    field = RosenerfConfig(**shape_of(size.field), ray_width=width, ray_depth=depth)
    proposals = tuple(RosenerfProposalConfig(**shape_of(each)) for each in size.proposals)
    # Fewer samples before walls were not tried.
    return size._replace(field=field, proposals=proposals, background_samples=None)


_PAPER = _size("paper", width=128, depth=3)

KIND = FieldKind(
    radiance_config=RosenerfConfig,
    init_radiance=init_radiance,
    radiance=radiance,
    density_config=RosenerfProposalConfig,
    init_density=zipnerf.init_density,
    density=zipnerf.density,
    sizes={
        "tiny": _size("tiny", width=32, depth=2),
        "small": _size("small", width=64, depth=3),
        "paper": _PAPER,
        "best": in_half_precision(_PAPER)._replace(footprint=zipnerf.KIND.sizes["best"].footprint),
    },
    hash_decay=zipnerf.KIND.hash_decay,
    deform=second_ray,
    deformation=(0.0, 0.0, 1e-4),
)
