"""TNSR field kind: a surface that bends light, learned by the colours that are seen through it.

The fields are those of NeuS (`fields.neus`): a signed value in a ball, and a field around. In the
first part of the training the surface stops light, as in NeuS. Then it bends light: paths are
traced through the level set (`geometry.surfaces.LevelSet`), the ball has no density, and the
colour is that of the field around. Gradients of the colours move the surface through the points of
the path and its normals, and the index of refraction, if that is learned.

What is published otherwise: normals have no gradient, the gradient of the second point counts the
origin of its ray twice, the path leaves at the last crossing of the line, total reflection is
refraction at grazing incidence, the bent rays are rendered by NeuS again, beyond an offset, and
each stage is a training of its own. `docs/decisions/046-paths-through-learned-surfaces.md` has the
reasons.

Source: Deng et al., Differentiable Neural Surface Refinement for Modeling Transparent Objects
(2024), and its code, `rios/TNSR` at commit e603b7b.
"""

import dataclasses
import math
from typing import Literal

import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.choices import IndexFrom, Position
from refref_jax.fields import neus, zipnerf
from refref_jax.fields.base import FieldSize, Params, Radiance, evaluate, shape_of
from refref_jax.fields.hash_grid import GridDensityConfig
from refref_jax.fields.neus import NeusConfig, NeusParams, SignedValue, SurfaceConfig
from refref_jax.geometry.surfaces import LevelSet
from refref_jax.sampling.polylines import Gaussians

INDICES = (1.01, 3.0)
"""Smallest and largest index of refraction of a surface that bends light."""


@dataclasses.dataclass(frozen=True)
class TnsrConfig(SurfaceConfig):
    """Shape of a field with a surface that bends light, by TNSR; see `SurfaceConfig`.

    Attributes:
      index: index of refraction inside the surface, relative to that outside; where it begins, if
        it is learned.
      index_from: whether the index is `given` or `learned`.
      straight: share of the training in which rays are straight, and the surface is that of NeuS.
    """

    index: float = dataclasses.field(default=1.5, kw_only=True)
    index_from: IndexFrom = dataclasses.field(default="given", kw_only=True)
    straight: float = dataclasses.field(default=0.5, kw_only=True)
    kind: Literal["tnsr"] = dataclasses.field(default="tnsr", kw_only=True)

    def __post_init__(self) -> None:
        """Validates the numbers."""
        super().__post_init__()
        least, most = INDICES
        if not least <= self.index <= most:
            raise ValueError(
                f"The index of a surface is {self.index}. Give surface_index a number from {least} "
                f"to {most}, relative to the medium around it."
            )
        if not 0.0 <= self.straight < 1.0:
            raise ValueError(
                f"The share of steps with straight rays is {self.straight}. Give straight_share 0 "
                "or more, below 1."
            )


@dataclasses.dataclass(frozen=True)
class TnsrProposalConfig(GridDensityConfig):
    """Shape of a density field, which is that of Zip-NeRF; see `GridDensityConfig`."""

    kind: Literal["tnsr"] = dataclasses.field(default="tnsr", kw_only=True)


def init_radiance(key: Array, config: TnsrConfig) -> NeusParams:
    """Returns initial parameters: those of a ball, and of the index if that is learned."""
    params = neus.init_radiance(key, opaque(config))
    if config.index_from == "given":
        return params
    return params._replace(index_change=jnp.zeros((), jnp.float32))


def radiance(
    params: NeusParams,
    config: SurfaceConfig,
    gaussians: Gaussians,
    direction: Float[Array, "3"],
) -> Radiance:
    """Returns density and colour of the field around the ball, in which there is no density.

    Arguments as in `FieldKind`. The surface is not visible by itself: it bends the path.
    """
    position = jnp.mean(gaussians.positions, axis=0) - jnp.asarray(config.ball_centre)
    outer = zipnerf.radiance(params.around, neus.around(config), gaussians, direction)
    beyond = numerics.length(position) >= config.ball_radius
    behind = numerics.dot(position, direction) > 0.0
    return outer._replace(density=jnp.where(beyond & behind, outer.density, 0.0))


def opaque(config: SurfaceConfig) -> SurfaceConfig:
    """Returns the shape of the field whose surface stops light, with the same parameters."""
    if not isinstance(config, TnsrConfig):
        return config
    names = {each.name for each in dataclasses.fields(NeusConfig)} - {"kind"}
    return NeusConfig(**{name: getattr(config, name) for name in names})


def index_of(params: NeusParams, config: TnsrConfig) -> Float[Array, ""]:
    """Returns the index of refraction inside the surface, relative to that outside.

    A learned one changes by at most `neus.PACE` per unit of its parameter, and approaches its
    bounds smoothly: where it were cut off, it would never return.
    """
    index = jnp.asarray(config.index, jnp.float32)
    if params.index_change is None:
        return index
    least, most = INDICES
    share = min(max((config.index - least) / (most - least), 1e-3), 1.0 - 1e-3)
    pace = 4.0 * neus.PACE / (most - least)  # a sigmoid has at most a slope of 1/4
    moved = math.log(share / (1.0 - share)) + pace * params.index_change
    return least + (most - least) * jax.nn.sigmoid(moved)


def level_set(
    params: NeusParams, config: SurfaceConfig, *, centre: Position, radius: float
) -> LevelSet:
    """Returns the surface for light that is bent by it.

    Its slope is a central difference over two cells of the finest grid: the error is a sixth of the
    squared cell times the third derivatives, not the cell times the second ones, as that of the
    four values of NeuS. Refraction needs the direction of the slope, NeuS hardly more than its
    length.

    Args:
      params: parameters of the field.
      config: shape of the field.
      centre: centre of the ball, world units.
      radius: radius of the ball, world units.
    """
    cell = 2.0 * radius / config.grid.max_res
    return LevelSet(
        Partial(_Values(config, centre, radius), params.surface),
        *(jnp.asarray(x, jnp.float32) for x in (cell, centre, radius)),
    )


@dataclasses.dataclass(frozen=True)
class _Values:
    """Signed values as a function that compares equal if its constants do, as `jit` needs.

    Attributes:
      config: shape of the field.
      centre: centre of the ball, world units.
      radius: radius of the ball, world units.
    """

    config: SurfaceConfig
    centre: Position
    radius: float

    def __call__(self, params: Params, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Returns signed values at points, all in world units."""
        within = (points - jnp.asarray(self.centre, points.dtype)[None]) / self.radius
        return self.radius * evaluate(SignedValue(self.config), params, within)


def _bending(size: FieldSize) -> FieldSize:
    """Returns the same fields with a surface that bends light."""
    proposals = tuple(TnsrProposalConfig(**shape_of(each)) for each in size.proposals)
    field = TnsrConfig(**shape_of(size.field))
    return size._replace(field=field, proposals=proposals, footprint="cone")


KIND = neus.KIND._replace(
    radiance_config=TnsrConfig,
    init_radiance=init_radiance,
    radiance=radiance,
    density_config=TnsrProposalConfig,
    sizes={name: _bending(size) for name, size in neus.KIND.sizes.items()},
    depth=None,
)
