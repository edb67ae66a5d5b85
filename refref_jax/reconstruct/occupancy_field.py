"""Represents an object as an occupancy field and renders its silhouettes.

Notation: positions `x` lie in the unit cube. `f(x)` is the output of a small network, as in
UNISURF: negative inside the object and, because training keeps its slope near 1, about the distance
to the surface, in edges of the cube. The occupancy is `o(x) = 1 / (1 + exp(f(x) / b))` with the
softness `b` of a training step. UNISURF learns the logit of `o` directly; here it is `-f / b`, so
that `o` hardens on a schedule and one field serves all softnesses. The surface is where `o = 1/2`,
that is `f = 0`. All functions are pure functions of parameters and positions.

Along a ray the samples `x_i`, ordered from the camera, have the occupancies `o_i`. The first
occupied sample stops the light, so each has the weight `w_i = o_i prod_{j<i} (1 - o_j)`, and the
silhouette is the sum `S = sum_i w_i = 1 - prod_i (1 - o_i)`. With `o = sigmoid(l)` the odds `S / (1
- S)` of two samples combine to `e^l + e^m + e^(l+m)`, so the logit of `S` is computed in
logarithms: neither an empty nor a full ray underflows.

Unlike the opacity of a density field, `S` grows with the number of samples near the surface: a ray
that passes at the distance `d` has `n` samples with the odds `exp(-d / b)`, so outlines lie up to
`b log n` outside of `f = 0`. Training therefore uses few samples, around the deepest point, and a
softness `b` that ends far below a pixel. UNISURF likewise narrows its interval around the surface
during training.

Sources: Oechsle, Peng and Geiger, UNISURF: Unifying Neural Implicit Surfaces and Radiance Fields
for Multi-View Reconstruction (2021), section 3, Eq 3 to 8; Mueller et al., Instant NGP (2022), for
the grid.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.fields import hash_grid
from refref_jax.fields.base import evaluate
from refref_jax.fields.hash_grid import HashGrid, HashGridConfig

Params = Any
"""A pytree of arrays, as returned by `init`."""

# The finest level is a dense grid: every vertex has an entry of its own.
_GRID = HashGridConfig(levels=4, base_res=8, max_res=64, hashmap_size=1 << 19, features=2)


@dataclasses.dataclass(frozen=True)
class OccupancyFieldConfig:
    """Shape of an occupancy field.

    Attributes:
      grid: hash grid; its finest cells limit the detail of the surface.
      width: number of units of the hidden layer.
      start: radius of the ball that an untrained field represents, in edges of the cube.
    """

    grid: HashGridConfig = _GRID
    width: int = 32
    start: float = 0.4

    def __post_init__(self) -> None:
        """Validates the radius."""
        if not 0.0 < self.start <= 0.5:
            raise ValueError(
                f"The initial radius is {self.start}, in edges of the cube. Choose a radius above "
                "0 and at most 0.5."
            )


def init(key: Array, config: OccupancyFieldConfig) -> Params:
    """Returns initial parameters, which represent a ball in the middle of the cube plus noise."""
    return _OccupancyField(config).init(key, jnp.zeros(3))


def signed(
    params: Params, config: OccupancyFieldConfig, position: Float[Array, "3"]
) -> Float[Array, ""]:
    """Returns `f` at a point: negative inside, in edges of the cube.

    Args:
      params: parameters of the field, from `init`.
      config: configuration passed to `init`.
      position: point of the unit cube; outside of it the outermost cells are extrapolated.
    """
    return evaluate(_OccupancyField(config), params, position)


def slope(
    params: Params, config: OccupancyFieldConfig, position: Float[Array, "3"], *, step: float
) -> Float[Array, "3"]:
    """Returns the gradient of `f`, outward, by finite differences (`hash_grid.slope`).

    Args:
      params: parameters of the field, from `init`.
      config: configuration passed to `init`.
      position: point of the unit cube.
      step: offset of each coordinate, in edges of the cube; about a cell of the finest level.
    """
    corners = jnp.asarray(hash_grid.TETRAHEDRON)
    values = jax.vmap(functools.partial(signed, params, config))(position[None] + step * corners)
    return hash_grid.slope(values, step=step)


class _OccupancyField(nn.Module):
    config: OccupancyFieldConfig

    @nn.compact
    def __call__(self, position: Float[Array, "3"]) -> Float[Array, ""]:
        config = self.config
        ball = numerics.length(position - 0.5) - config.start
        features = HashGrid(config.grid, name="grid")(position, jnp.zeros_like(ball))
        hidden = nn.softplus(nn.Dense(config.width)(jnp.concatenate([features, position - 0.5])))
        # Zero initial weights, so that the field starts as the ball alone.
        return ball + nn.Dense(1, kernel_init=nn.initializers.zeros)(hidden)[0]


Signed = Callable[[Float[Array, "3"]], Float[Array, ""]]
"""A field as a function of position only, see the module."""

# Samples around the deepest one, in spacings; factor by which they refine it; number of repeats.
_NEARBY = (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0)
_FINER = 4.0
_ROUNDS = 2


class Chord(NamedTuple):
    """The part of a ray that may hit the object; or many, along a leading axis.

    Attributes:
      origins: origins of the rays, in edges of the cube, relative to its corner.
      directions: unit vectors.
      starts: distances at which the rays enter the bounding box, in edges of the cube.
      ends: distances at which they leave it, not below the starts.
    """

    origins: Float[Array, "*rays 3"]
    directions: Float[Array, "*rays 3"]
    starts: Float[Array, "*rays"]
    ends: Float[Array, "*rays"]


class Scan(NamedTuple):
    """Result of a coarse scan of a field along a chord.

    Attributes:
      deepest: distance along the ray of the smallest value.
      spacing: accuracy of that distance.
      surface: distance of the first crossing into the object, linear between samples; the deepest
        point if there is none.
      meets: 1 if there is such a crossing, else 0.
    """

    deepest: Float[Array, ""]
    spacing: Float[Array, ""]
    surface: Float[Array, ""]
    meets: Float[Array, ""]


def at(chord: Chord, distance: Float[Array, ""]) -> Float[Array, "3"]:
    """Returns the point of one chord at a distance along its ray."""
    return chord.origins + distance * chord.directions


def scan(signed: Signed, chord: Chord, shift: Float[Array, ""], *, samples: int) -> Scan:
    """Samples a field along one chord, without gradient: evenly, then around the deepest sample.

    A ray that crosses an edge is inside for less than one step, hence the second scan.

    Args:
      signed: field to sample.
      chord: a single chord.
      shift: offset of all samples, in steps, in `[0, 1)`.
      samples: number of steps.
    """
    spacing = (chord.ends - chord.starts) / samples
    distances = chord.starts + (jnp.arange(samples, dtype=shift.dtype) + shift) * spacing
    values = jax.lax.stop_gradient(_along(signed, chord, distances))
    enters = (values[:-1] > 0.0) & (values[1:] <= 0.0)
    crossing = jnp.argmax(enters)
    before, after = values[crossing], values[crossing + 1]
    share = numerics.safe_divide(before, before - after)
    meets = jnp.any(enters)
    deepest = distances[jnp.argmin(values)]
    surface = jnp.where(meets, distances[crossing] + share * spacing, deepest)
    for _ in range(_ROUNDS):
        nearby = jnp.clip(deepest + spacing * jnp.asarray(_NEARBY), chord.starts, chord.ends)
        values = jax.lax.stop_gradient(_along(signed, chord, nearby))
        deepest, spacing = nearby[jnp.argmin(values)], spacing / _FINER
    return Scan(deepest, spacing, surface, meets.astype(values.dtype))


def weights(occupancies: Float[Array, " samples"]) -> Float[Array, " samples"]:
    """Returns the share of light that each sample stops, `o_i prod_{j<i} (1 - o_j)`.

    They sum to the silhouette, at most 1. Gradients are finite for occupancies of 0 and 1 as well.
    """
    passed = jnp.cumprod(1.0 - occupancies)
    return occupancies * jnp.concatenate([jnp.ones_like(passed[:1]), passed[:-1]])


def silhouette_logit(logits: Float[Array, " samples"]) -> Float[Array, ""]:
    """Returns the logit of the silhouette of samples from the logits of their occupancies.

    Its `sigmoid` is the sum of `weights`; value and gradient are finite for all finite logits with
    a finite sum.
    """
    return functools.reduce(_either, jnp.unstack(logits))


def _either(one: Float[Array, ""], other: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.logaddexp(jnp.logaddexp(one, other), one + other)


def cross_entropy(logit: Float[Array, ""], seen: Float[Array, ""]) -> Float[Array, ""]:
    """Returns the binary cross entropy of a logit and a mask's pixel, 1 or 0."""
    return jax.nn.softplus(jnp.where(seen > 0.5, -logit, logit))


def logit_along(
    signed: Signed,
    chord: Chord,
    scanned: Scan,
    shifts: Float[Array, " samples"],
    *,
    softness: Float[Array, ""],
) -> Float[Array, ""]:
    """Returns the logit of a chord's silhouette from samples around the field's deepest point.

    Args:
      signed: field; gradients propagate into it.
      chord: a single chord.
      scanned: result of `scan`.
      shifts: offset of each sample within its stratum, in `[0, 1)`.
      softness: softness `b`, in edges of the cube.
    """
    samples = shifts.shape[0]
    # One step of the scan to either side contains the deepest point.
    across = (jnp.arange(samples, dtype=shifts.dtype) + shifts) * (2.0 / samples) - 1.0
    distances = jnp.clip(scanned.deepest + across * scanned.spacing, chord.starts, chord.ends)
    values = _along(signed, chord, distances)
    return silhouette_logit(-values / softness)


def _along(
    signed: Signed, chord: Chord, distances: Float[Array, " samples"]
) -> Float[Array, " samples"]:
    return jax.vmap(lambda distance: signed(at(chord, distance)))(distances)
