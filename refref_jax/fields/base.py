"""Interface of field kinds: their configurations, functions and arithmetic precision.

A radiance field has two functions, `init_radiance` and `radiance`, and a third, `blend`, if it has
sub-spaces, `depth`, if it has a surface, or `deform`, if it bends straight rays; a proposal field
has `init_density` and `density`. All are pure functions, most of them over Gaussians in the unit
cube. A field kind is a `FieldKind` in a module, and one line in `registry`, through which all other
modules query fields.

The precision is float32, or mixed with bfloat16: tables are then read and matrices multiplied in
bfloat16, and hidden layers of fields on a hash grid return it, while parameters, sums and outputs
stay in float32. bfloat16 has only 8 significant bits, so small gradients would be lost in a sum of
many.

Source: Micikevicius et al., Mixed Precision Training (2018), for the float32 master weights.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, get_args

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from refref_jax import numerics
from refref_jax.choices import Footprint, Precision
from refref_jax.sampling.polylines import Gaussians

Params = Any
"""Pytree of arrays, from `init_radiance` or `init_density`."""


def check_precision(precision: str) -> None:
    """Checks the name of a precision.

    Raises:
      ValueError: if the name is not one of `Precision`.
    """
    choices = get_args(Precision)
    if precision not in choices:
        raise ValueError(
            f"The precision must be one of {', '.join(choices)}, not {precision!r}. Choose one."
        )


def dense(precision: Precision) -> Callable[..., nn.Dense]:
    """Returns flax's dense layer, `x @ kernel + bias`, with factors in a given precision."""
    if precision == "float32":
        return nn.Dense
    return functools.partial(nn.Dense, dtype=jnp.float32, dot_general=_product)


def hidden_layer(precision: Precision) -> Callable[..., Callable[[Array], Array]]:
    """Returns a dense layer with ReLU, as a function of the width and of flax's options.

    In bfloat16, its product and its result are rounded, and the bias is added in between: the next
    layer would round the result anyway. Both are kept for the backward pass, where they are most of
    what a step reads and writes. A sum in bfloat16 would lose small gradients of the bias.
    """

    def layer(width: int, **options: Any) -> Callable[[Array], Array]:
        if precision == "float32":
            exact = nn.Dense(width, **options)
            return lambda values: nn.relu(exact(values))
        rounded = nn.Dense(width, dtype=jnp.float32, dot_general=_rounded_product, **options)
        return lambda values: nn.relu(rounded(values)).astype(jnp.bfloat16)

    return layer


def dot_general(precision: Precision) -> Callable[..., Array]:
    """Returns `jax.lax.dot_general`, or one that rounds its factors to bfloat16."""
    return jax.lax.dot_general if precision == "float32" else _product


def hidden_dot_general(precision: Precision) -> Callable[..., Array]:
    """Returns `jax.lax.dot_general`, or one that rounds its factors and results to bfloat16."""
    return jax.lax.dot_general if precision == "float32" else _rounded_product


def between_layers(precision: Precision) -> DTypeLike:
    """Returns the type of what one layer passes to the next."""
    return jnp.float32 if precision == "float32" else jnp.bfloat16


def _product(left: Array, right: Array, axes: Any, precision: None = None) -> Array:
    """Returns the matrix product of factors rounded to bfloat16, in single precision."""
    factors = left.astype(jnp.bfloat16), right.astype(jnp.bfloat16)
    return jax.lax.dot_general(
        *factors, axes, precision=precision, preferred_element_type=jnp.float32
    )


def _rounded_product(left: Array, right: Array, axes: Any, precision: None = None) -> Array:
    """Returns this product rounded to bfloat16, in single precision."""
    factors = left.astype(jnp.bfloat16), right.astype(jnp.bfloat16)
    return jax.lax.dot_general(*factors, axes, precision=precision).astype(jnp.float32)


@dataclasses.dataclass(frozen=True)
class FieldConfig:
    """Shape of a field of any type.

    Field kinds derive from `RadianceConfig` and `DensityConfig`, with the name of the kind as the
    default and only value of `kind`. The registry and the files of a run identify it by this name.

    Attributes:
      precision: precision of tables and matrix products.
      kind: name of the field kind.
    """

    precision: Precision = dataclasses.field(default="float32", kw_only=True)
    kind: str = dataclasses.field(default="", kw_only=True)

    def __post_init__(self) -> None:
        """Validates the precision."""
        check_precision(self.precision)


@dataclasses.dataclass(frozen=True)
class RadianceConfig(FieldConfig):
    """Shape of a radiance field of any type."""


@dataclasses.dataclass(frozen=True)
class DensityConfig(FieldConfig):
    """Shape of a proposal's density field of any type."""


class Radiance(NamedTuple):
    """Output of a radiance field.

    Attributes:
      density: density per scene radius, non-negative.
      rgb: linear radiance towards the camera, in `[-0.001, brightest + 0.001]`, where white is 1.
    """

    density: Float[Array, ""]
    rgb: Float[Array, "3"]


class SubSpaces(NamedTuple):
    """Output of a radiance field that consists of several, which overlap.

    Each sub-space is integrated along the path by itself. What becomes of the features is decided
    after that, for the whole path, by `FieldKind.blend`: a point alone has no colour.

    Attributes:
      density: density of each sub-space per scene radius, non-negative.
      features: features of each sub-space towards the camera.
    """

    density: Float[Array, " sub_spaces"]
    features: Float[Array, "sub_spaces channels"]


class Surface(NamedTuple):
    """Output of a radiance field with a surface: where its signed value is 0, inside a ball.

    Beyond the ball, the field has a density. How much light an interval stops is decided by
    `FieldKind.depth`, which knows its length. The unit of length is the radius of the ball.

    Attributes:
      signed: signed value, negative inside the surface, and near it about the distance to it.
      slope: gradient of the signed value by position.
      curvature: Laplacian of the signed value.
      within: whether the middle of the interval is in the ball.
      density: density per scene radius, non-negative, meaningless in the ball.
      rgb: linear radiance towards the camera, in `[-0.001, 1.001]`.
    """

    signed: Float[Array, ""]
    slope: Float[Array, "3"]
    curvature: Float[Array, ""]
    within: Bool[Array, ""]
    density: Float[Array, ""]
    rgb: Float[Array, "3"]


class SurfaceSums(NamedTuple):
    """Sums over the samples of a path that are in the ball of a field's surface.

    Attributes:
      eikonal: sum of `(|slope| - 1)^2`.
      curvature: sum of the absolute curvatures.
      samples: number of the samples.
      share: share of the path's light that comes from them.
    """

    eikonal: Float[Array, "*paths"]
    curvature: Float[Array, "*paths"]
    samples: Float[Array, "*paths"]
    share: Float[Array, "*paths"]


class Offset(NamedTuple):
    """Output of a deformation at a point of a straight ray.

    Attributes:
      position: offset of the point, in scene radii.
      direction: offset of the unit direction, before it is normalised.
    """

    position: Float[Array, "*points 3"]
    direction: Float[Array, "*points 3"]


Seen = Radiance | SubSpaces | Surface
"""Output of a radiance field for one interval."""


class Blend(NamedTuple):
    """Colours of the sub-spaces along one path, and their shares.

    Attributes:
      rgb: linear radiance of each sub-space towards the camera.
      shares: weight of each sub-space in the colour of the path; they sum to 1.
    """

    rgb: Float[Array, "sub_spaces 3"]
    shares: Float[Array, " sub_spaces"]


class FieldSize(NamedTuple):
    """Fields of one size, and the numbers of samples along a path.

    Attributes:
      field: shape of the radiance field.
      proposals: shape of each proposal level's density field, coarse to fine.
      samples: number of intervals of each proposal level, then of the radiance field.
      multisamples: number of multisamples per interval.
      footprint: pixel footprint along a path, see `ModelConfig`.
      dilation: widening of a proposal before it is sampled, see `ModelConfig`.
      background_samples: number of samples, as `samples`, for paths with nothing in front of the
        wall that they end on; `None` if fewer were not tried.
    """

    field: RadianceConfig
    proposals: tuple[DensityConfig, ...]
    samples: tuple[int, ...]
    multisamples: int
    footprint: Footprint
    dilation: float
    background_samples: tuple[int, ...] | None = None


class FieldKind(NamedTuple):
    """A field kind.

    Attributes:
      radiance_config: configuration class of the radiance field.
      init_radiance: function of key and shape that returns initial radiance field parameters.
      radiance: function of parameters, shape, Gaussians in the unit cube (fractions of its edge)
        and unit direction of travel (world frame) that returns density and colour of one interval,
        or density and features of its sub-spaces, or the signed value of its surface.
      density_config: configuration class of the proposal fields.
      init_density: function of key and shape that returns initial proposal field parameters.
      density: function of parameters, shape and Gaussians that returns the density of one interval.
      sizes: field sizes by preset name.
      hash_decay: weight of the hash decay loss.
      blend: function of parameters, shape and the features of each sub-space, integrated along the
        path, that returns their colours and shares; `None` if the field has a colour at each point.
      depth: function of parameters, shape, what `radiance` returned for an interval, direction of
        travel, length of the interval in scene radii and progress of the training, 0 to 1, that
        returns the interval's optical depth; `None` if that is density times length.
      eikonal: weight of the eikonal loss of a surface; `None` if there is none.
      curvature: weight of the curvature loss of a surface.
      deform: function of parameters, shape, a point of a straight ray in the unit cube, the ray's
        unit direction and progress of the training, 0 to 1, that returns the offset of both; `None`
        if light paths are those that are traced.
      deformation: weights of the losses of a deformation: bends, turns and size.
    """

    radiance_config: type[RadianceConfig]
    init_radiance: Callable[[Array, Any], Params]
    radiance: Callable[[Params, Any, Gaussians, Float[Array, "3"]], Seen]
    density_config: type[DensityConfig]
    init_density: Callable[[Array, Any], Params]
    density: Callable[[Params, Any, Gaussians], Float[Array, ""]]
    sizes: Mapping[str, FieldSize]
    hash_decay: float
    blend: Callable[[Params, Any, Float[Array, "sub_spaces channels"]], Blend] | None = None
    depth: Callable[[Params, Any, Surface, Array, Array, Array], Float[Array, ""]] | None = None
    eikonal: float | None = None
    curvature: float | None = None
    deform: Callable[[Params, Any, Array, Array, Array], Offset] | None = None
    deformation: tuple[float, float, float] | None = None


def sums(seen: Surface, weights: Float[Array, " samples"]) -> SurfaceSums:
    """Returns the sums over the samples of a path, whose values `seen` stacks."""
    stretch = jnp.square(numerics.length(seen.slope) - 1.0)
    values = stretch, jnp.abs(seen.curvature), jnp.ones_like(weights), weights
    return SurfaceSums(*(jnp.sum(jnp.where(seen.within, each, 0.0)) for each in values))


def evaluate(module: nn.Module, params: Params, *inputs: Any) -> Any:
    """Returns the output of a Flax module alone; its `apply` may return variables as well."""
    return module.apply(params, *inputs)


def shape_of(config: FieldConfig) -> dict[str, Any]:
    """Returns the values of a configuration without its kind, for a field of another kind."""
    names = [each.name for each in dataclasses.fields(config) if each.name != "kind"]
    return {name: getattr(config, name) for name in names}


def in_half_precision(size: FieldSize) -> FieldSize:
    """Returns the same fields with bfloat16 arithmetic."""
    return size._replace(
        field=dataclasses.replace(size.field, precision="bfloat16"),
        proposals=tuple(dataclasses.replace(each, precision="bfloat16") for each in size.proposals),
    )
