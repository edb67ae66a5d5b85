"""Occupancy field, and volume rendering of its silhouettes.

An occupancy field: a body as the output of a small network, in the manner of UNISURF.

Letters: positions `x` lie in the unit cube; `f(x)` is the network's output, negative inside the
body and, held to a slope of 1 while it is trained, about the distance to the surface, in edges of
the cube. The occupancy is `o(x) = 1 / (1 + exp(f(x) / b))` with the softness `b` of a step of the
training. UNISURF learns the logit of `o` itself; here it is `-f / b`, so that `o` hardens on a
schedule, and one field serves all softnesses. The surface is where `o = 1/2`, that is `f = 0`.

Plain functions over positions; the linen module stays inside.

Source: Oechsle, Peng and Geiger, UNISURF: Unifying Neural Implicit Surfaces and Radiance Fields for
Multi-View Reconstruction (2021), section 3; Mueller et al., Instant NGP (2022), for the grid.

What a ray sees of an occupancy field: the share of it that a body stops.

Along a ray the samples `x_i`, ordered from the camera, have the occupancies `o_i`. The first
occupied one stops the light, so each has the weight `w_i = o_i prod_{j<i} (1 - o_j)`, and the
silhouette is the sum `S = sum_i w_i = 1 - prod_i (1 - o_i)`. Where `o = sigmoid(l)` the odds
`S / (1 - S)` of two samples together are `e^l + e^m + e^(l+m)`, so that the logit of `S` is found
without leaving logarithms: neither an empty ray nor a full one underflows.

Unlike that of a density, `S` grows with the number of samples near the surface: where a ray passes
by at the distance `d` it is met by `n` samples of the odds `exp(-d / b)`, so outlines lie up to
`b log n` outside of `f = 0`. Hence few samples, at the place that decides, and a softness `b` that
ends far below a pixel. UNISURF likewise narrows its interval around the surface as it trains.

Source: Oechsle, Peng and Geiger, UNISURF (2021), Eq 3 to 8.
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
from refref_jax.fields.base import evaluate
from refref_jax.fields.hash_grid import HashGrid, HashGridConfig

Params = Any
"""A pytree of arrays, as `init` makes it."""

# Every vertex of the finest level has an entry of its own.
_GRID = HashGridConfig(levels=4, coarsest=8, finest=64, entries=1 << 19, features=2)

# Corners of a regular tetrahedron, whose outer products sum to 4 times the identity.
_TETRAHEDRON = ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))


@dataclasses.dataclass(frozen=True)
class OccupancyFieldConfig:
    """Shape of an occupancy field.

    Attributes:
      grid: the hash grid; its finest cells bound the detail of the surface.
      width: units of the hidden layer.
      start: radius of the ball that an untrained field is, in edges of the cube.
    """

    grid: HashGridConfig = _GRID
    width: int = 32
    start: float = 0.4

    def __post_init__(self) -> None:
        """Checks the ball."""
        if not 0.0 < self.start <= 0.5:
            raise ValueError(
                f"The field starts as a ball of radius {self.start} in a cube of edge 1. Choose a "
                "radius above 0, at most 0.5."
            )


def init(key: Array, config: OccupancyFieldConfig) -> Params:
    """Returns new parameters: a ball in the middle of the cube, but for noise."""
    return _OccupancyField(config).init(key, jnp.zeros(3))


def signed(
    params: Params, config: OccupancyFieldConfig, position: Float[Array, "3"]
) -> Float[Array, ""]:
    """Returns `f` at a point: negative inside, in edges of the cube.

    Args:
      params: from `init`.
      config: the same as there.
      position: in the unit cube; beyond it the grid's outer cells go on as they end.
    """
    return evaluate(_OccupancyField(config), params, position)


def slope(
    params: Params, config: OccupancyFieldConfig, position: Float[Array, "3"], *, step: float
) -> Float[Array, "3"]:
    """Returns the gradient of `f`, outward, by differences between corners of a tetrahedron.

    Differences see past the edges of the grid's cells, where the derivative jumps, and can be
    derived once more by the parameters at the cost of four values. The error is about the step
    times the second derivative.

    Args:
      params: from `init`.
      config: the same as there.
      position: in the unit cube.
      step: of each coordinate, in edges of the cube; about a cell of the finest level.
    """
    corners = jnp.asarray(_TETRAHEDRON)
    values = jax.vmap(functools.partial(signed, params, config))(position[None] + step * corners)
    return values @ corners / (4.0 * step)


class _OccupancyField(nn.Module):
    config: OccupancyFieldConfig

    @nn.compact
    def __call__(self, position: Float[Array, "3"]) -> Float[Array, ""]:
        config = self.config
        ball = numerics.length(position - 0.5) - config.start
        features = HashGrid(config.grid, name="grid")(position, jnp.zeros_like(ball))
        hidden = nn.softplus(nn.Dense(config.width)(jnp.concatenate([features, position - 0.5])))
        # From zero, so that the ball is all there is at first.
        return ball + nn.Dense(1, kernel_init=nn.initializers.zeros)(hidden)[0]


Signed = Callable[[Float[Array, "3"]], Float[Array, ""]]
"""A field as a function of the position alone, see `occupancy_field`."""

# Where the deepest place is looked for again, in spacings; how much finer that is; how often.
_NEARBY = (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0)
_FINER = 4.0
_ROUNDS = 2


class Chord(NamedTuple):
    """The part of a ray that may meet the body; or many, along a leading axis.

    Attributes:
      origins: of the rays, in edges of the cube, from its corner.
      directions: unit vectors.
      starts: where the ray enters the box that holds the body, in edges of the cube.
      ends: where it leaves it, not before.
    """

    origins: Float[Array, "*rays 3"]
    directions: Float[Array, "*rays 3"]
    starts: Float[Array, "*rays"]
    ends: Float[Array, "*rays"]


class Scan(NamedTuple):
    """A field along a chord, looked at coarsely.

    Attributes:
      deepest: distance along the ray of the least value.
      spacing: within which of it the place is known.
      surface: distance of the first crossing into the body, linear between samples; the deepest
        place where there is none.
      meets: 1 where there is such a crossing, else 0.
    """

    deepest: Float[Array, ""]
    spacing: Float[Array, ""]
    surface: Float[Array, ""]
    meets: Float[Array, ""]


def at(chord: Chord, distance: Float[Array, ""]) -> Float[Array, "3"]:
    """Returns the point of one chord at a distance along its ray."""
    return chord.origins + distance * chord.directions


def scan(signed: Signed, chord: Chord, shift: Float[Array, ""], *, samples: int) -> Scan:
    """Looks at a field along one chord, without gradient: at even steps, then about the deepest.

    A ray that cuts off an edge is inside for less than a step, hence the second look.

    Args:
      signed: the field.
      chord: one.
      shift: of all samples, in steps, in `[0, 1)`.
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

    `sigmoid` of it is the sum of `weights`; value and gradient are finite for all finite logits
    whose sum is.
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
    """Returns the logit of a chord's silhouette from samples about the field's deepest place.

    Args:
      signed: the field; gradients flow into it.
      chord: one.
      scanned: from `scan`.
      shifts: of each sample within its share of the interval, in `[0, 1)`.
      softness: `b`, in edges of the cube.
    """
    samples = shifts.shape[0]
    # A step of the scan to either side holds the deepest place itself.
    across = (jnp.arange(samples, dtype=shifts.dtype) + shifts) * (2.0 / samples) - 1.0
    distances = jnp.clip(scanned.deepest + across * scanned.spacing, chord.starts, chord.ends)
    values = _along(signed, chord, distances)
    return silhouette_logit(-values / softness)


def _along(
    signed: Signed, chord: Chord, distances: Float[Array, " samples"]
) -> Float[Array, " samples"]:
    return jax.vmap(lambda distance: signed(at(chord, distance)))(distances)
