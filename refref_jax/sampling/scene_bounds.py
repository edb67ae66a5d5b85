"""Maps world space to the unit cube of the fields, and distance along a path to `[0, 1]`.

A bounded scene is a scaled cube, and a spherical scene is the ball in this cube. An unbounded scene
is contracted: a ball is unchanged, and the space beyond it is contracted to a shell of the same
thickness. All of them are around the centre of the scene. An `OccupancyGrid` says where in a ball a
field may have a density.

Symbols: `t` is distance in world units, `s` the normalised coordinate in `[0, 1]` in which samplers
work. Equal steps in `s` are short near the camera and grow with distance, so that one interval
covers near and far.

Source: Barron et al., Mip-NeRF 360 (2022), Eq 10, for the contraction; Zip-NeRF (2023), section 2,
for the scale of a contracted Gaussian, and section 4 for the warp of distance, the power
transformation with `lambda = -1.5`, applied to twice the distance.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.choices import ORIGIN, BallOption, Position, Space
from refref_jax.geometry.cameras import Cameras
from refref_jax.geometry.rays import Rays, chord
from refref_jax.sampling.polylines import Gaussians, Polyline

_LAMBDA = -1.5

_WALLS = 7.3
"""Default half edge of the background cube, or radius of the background sphere: the data set's.

Paths end there, on an opaque background, so the value must be exact: a cube that is 3 % too large
costs 2.7 dB.
"""

SHORTEST = 1e-3
"""Minimum length of a path, in units of the scene radius: `s` keeps four digits in float32."""

_ROUNDING = 1e-6
"""Distance from a sphere, in its radius, at which a ray may start on it."""

_NEAR = 0.05
_FAR_UNBOUNDED = 1000.0

# World units per unit of the paper's released code (`--scale-factor 0.1`), whose near plane is
# 0.05, and whose far plane is 15, or 1000 in unbounded scenes. It contracts space beyond one unit.
_PUBLISHED_UNIT = 10.0
_PUBLISHED_NEAR = 0.05 * _PUBLISHED_UNIT
_PUBLISHED_FAR = 15.0 * _PUBLISHED_UNIT
_PUBLISHED_FAR_UNBOUNDED = 1000.0 * _PUBLISHED_UNIT


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Bounds of a scene; see `ModelConfig`."""

    near: float
    far: float
    radius: float
    space: Space
    centre: Position = ORIGIN


def bounds(
    cameras: Cameras, *, space: Space, radius: float | None, centre: Position = ORIGIN
) -> Bounds:
    """Returns the bounds of a scene.

    A bounded scene extends from any camera to the farthest corner of its cube, a spherical scene to
    the far side of its sphere. In an unbounded scene, the cameras and the space between them are
    not contracted.

    Args:
      cameras: cameras of the training images.
      space: geometry of the background: `bounded`, `spherical` or `unbounded`.
      radius: radius instead of the default of `ModelConfig.radius`.
      centre: centre of the background, world units.

    Raises:
      ValueError: if the radius is not positive and finite.
    """
    if radius is not None and not 0.0 < radius < math.inf:
        raise ValueError(
            f"radius is {radius}, but it is a length. Give a positive number of world units."
        )
    farthest = float(np.max(np.linalg.norm(cameras.poses[:, :, 3] - centre, axis=-1)))
    if space == "unbounded":
        return Bounds(_NEAR, _FAR_UNBOUNDED, radius or 1.25 * farthest, space, centre)
    radius = radius or _WALLS
    reach = radius if space == "spherical" else math.sqrt(3.0) * radius
    return Bounds(_NEAR, farthest + reach, radius, space, centre)


def contracted(scene: Bounds, *, radius: float | None) -> Bounds:
    """Returns bounds that ignore the size of the background: space is contracted around its centre.

    Args:
      scene: bounds of the scene.
      radius: radius of an unbounded scene's uncontracted ball, world units; by default, and in
        other scenes, that of the released code.

    Source: the paper's released code, in world units.
    """
    if scene.space == "unbounded":
        ball = radius or _PUBLISHED_UNIT
        return Bounds(_PUBLISHED_NEAR, _PUBLISHED_FAR_UNBOUNDED, ball, "unbounded", scene.centre)
    return Bounds(_PUBLISHED_NEAR, _PUBLISHED_FAR, _PUBLISHED_UNIT, "unbounded", scene.centre)


class Domain(NamedTuple):
    """Scene bounds: the part of space that a field stores.

    Attributes:
      radius: half edge of a bounded scene's cube, or radius of a spherical scene or of an
        unbounded scene's uncontracted ball; world units.
      space: `bounded` by the cube, `spherical` (bounded by the ball), or `unbounded` (contracted
        beyond the ball).
      centre: centre of the cube or ball, world units.
    """

    radius: float
    space: Space
    centre: Position = ORIGIN


def to_unit_cube(domain: Domain, gaussian: Gaussians) -> Gaussians:
    """Maps world-space Gaussians to `[0, 1]^3`; scales become fractions of the cube's edge.

    In bounded and spherical scenes, points outside the cube are moved to its nearest face.
    """
    positions = _from_centre(domain, gaussian.positions) / domain.radius
    scales = gaussian.scales / domain.radius
    if domain.space == "unbounded":
        return Gaussians(0.25 * contract(positions) + 0.5, 0.25 * scales * shrinkage(positions))
    return Gaussians(jnp.clip(0.5 * positions + 0.5, 0.0, 1.0), 0.5 * scales)


def nearest_within(domain: Domain, point: Float[Array, "3"]) -> Float[Array, "3"]:
    """Returns the nearest point in the domain; points inside it are unchanged.

    Around another centre than the origin, the latter holds up to rounding.
    """
    if domain.space == "unbounded":
        return point
    held = _from_centre(domain, point)
    if domain.space == "spherical":
        held = held * (domain.radius / jnp.maximum(numerics.length(held), domain.radius))
    else:
        held = jnp.clip(held, -domain.radius, domain.radius)
    return held + jnp.asarray(domain.centre, held.dtype) if any(domain.centre) else held


def exit_distance(
    domain: Domain, origin: Float[Array, "3"], direction: Float[Array, "3"]
) -> Float[Array, ""]:
    """Returns the distance at which a ray leaves the cube or ball of the scene bounds.

    The result is `inf` in an unbounded scene and for rays that miss the bounds. Do not use its
    gradient: the face through which a ray leaves changes abruptly.

    Source: the slab method for the cube, Kay and Kajiya (1986).
    """
    if domain.space == "unbounded":
        return jnp.full_like(origin[0], jnp.inf)
    origin = _from_centre(domain, origin)
    if domain.space == "spherical":
        middle, half = chord(domain.radius, origin, direction)
        leave = middle + half
        ahead = (half > 0.0) & (leave >= -_ROUNDING * domain.radius)
        return jnp.where(ahead, jnp.maximum(leave, 0.0), jnp.inf)
    inverse = numerics.safe_reciprocal(direction)
    first = (-domain.radius - origin) * inverse
    second = (domain.radius - origin) * inverse
    enter, leave = jnp.max(jnp.minimum(first, second)), jnp.min(jnp.maximum(first, second))
    return jnp.where((enter <= leave) & (leave >= 0.0), leave, jnp.inf)


def _from_centre(domain: Domain, points: Float[Array, "*shape 3"]) -> Float[Array, "*shape 3"]:
    """Returns points relative to the centre; nothing is computed if that is the origin."""
    if not any(domain.centre):
        return points
    return points - jnp.broadcast_to(jnp.asarray(domain.centre, points.dtype), points.shape)


def contract(x: Float[Array, "*shape 3"]) -> Float[Array, "*shape 3"]:
    """Contracts points to the ball of radius 2: `(2 - 1 / |x|) x / |x|` where `|x| > 1`."""
    norm = numerics.length(x)[..., None]
    outside = norm > 1.0
    inverse = 1.0 / jnp.where(outside, norm, 1.0)
    return jnp.where(outside, (2.0 - inverse) * inverse * x, x)


def shrinkage(x: Float[Array, "*shape 3"]) -> Float[Array, "*shape"]:
    """Returns the factor by which `contract` scales a small Gaussian at `x`: `|det J|^(1/3)`.

    It is `(2 - 1 / |x|)^(2/3) |x|^(-4/3)` for `|x| > 1`, else 1.
    """
    norm = numerics.length(x)
    inverse = 1.0 / jnp.where(norm > 1.0, norm, 1.0)
    return (2.0 - inverse) ** (2.0 / 3.0) * inverse ** (4.0 / 3.0)


class DistanceWarp(NamedTuple):
    """The sampled interval of distances, and its length scale.

    Attributes:
      near: distance at `s = 0`, world units, at least 0.
      far: distance at `s = 1`, world units, > `near`; may differ between paths.
      unit: size of the scene, world units; steps start to grow at about this distance.
    """

    near: float
    far: float | Float[Array, ""]
    unit: float


def background_distance(domain: Domain, line: Polyline) -> Float[Array, ""]:
    """Returns the distance of the scene bounds from the start of a path's last segment.

    It is `inf` where there are none ahead, 0 where the path has bent beyond them, and has no
    gradient, see `exit_distance`.
    """
    last, leave = _last_exit(domain, line)
    if domain.space == "unbounded":
        return leave
    return jnp.where((last > 0) & jnp.isinf(leave), 0.0, leave)


def _last_exit(domain: Domain, line: Polyline) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """Returns the index of a path's last segment, and the exit distance from its start."""
    last = jnp.sum(jnp.isfinite(line.knots)) - 1
    leave = exit_distance(domain, line.points[last], line.directions[last])
    return last, jax.lax.stop_gradient(leave)


def warp_along(domain: Domain, line: Polyline, *, near: float, far: float) -> DistanceWarp:
    """Returns the distance warp of a path, which ends on an opaque surface or the scene bounds.

    The far distance is measured from the last bend, so that paths with many bends still reach the
    background.

    Args:
      domain: scene bounds.
      line: the path.
      near: distance of the first sample, world units.
      far: distance of the last sample from the last bend, where the path misses the bounds.
    """
    last, leave = _last_exit(domain, line)
    end = line.knots[last] + jnp.where(jnp.isfinite(leave), leave, far)
    if line.stop is not None:
        end = jnp.where(jnp.isfinite(line.stop), line.stop, end)
    # Keep a minimum length for samples even if the camera is on the scene bounds.
    return DistanceWarp(near, jnp.maximum(end, near + SHORTEST * domain.radius), domain.radius)


def to_distance(warp: DistanceWarp, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Maps `s` in `[0, 1]` to a distance in `[near, far]`, increasing up to rounding error.

    The transformed distance is interpolated from both ends, so that `s = 1` gives `far` up to
    rounding error, although the transform is flat there.
    """
    start, end = _ladder(warp, warp.near), _ladder(warp, warp.far)
    power = (1.0 - s) * start + s * end
    return _scale(warp) * (power ** (1.0 / _LAMBDA) - 1.0)


def to_unit(warp: DistanceWarp, t: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Maps a distance in `[near, far]` to `s` in `[0, 1]`; the inverse of `to_distance`."""
    start, end = _ladder(warp, warp.near), _ladder(warp, warp.far)
    return jnp.clip((start - _ladder(warp, t)) / (start - end), 0.0, 1.0)


def _scale(warp: DistanceWarp) -> float:
    """Returns the length unit of the power transformation: `|lambda - 1| / 2` times `unit`."""
    return abs(_LAMBDA - 1.0) / 2.0 * warp.unit


def _ladder(
    warp: DistanceWarp, t: float | Float[Array, "*shape"]
) -> float | Float[Array, "*shape"]:
    return (1.0 + t / _scale(warp)) ** _LAMBDA


def check_ball_size(domain: Domain, ball: BallOption) -> None:
    """Checks that a ball in which a field is sampled is no larger than one around the background.

    Raises:
      ValueError: if it is: the cells of its grid would be too large for an object.
    """
    most = math.sqrt(3.0) * domain.radius
    if domain.space != "unbounded" and ball[3] > most:
        raise ValueError(
            f"field_ball={','.join(map(str, ball))} is larger than a ball of radius {most:g} "
            "around the background. Give a ball around the object."
        )


class OccupancyGrid(NamedTuple):
    """Occupancy of the cells of the cube around a ball.

    Attributes:
      occupancy: occupancy of each cell, 1 or 0.
      ball: centre and radius of the ball, world units.
    """

    occupancy: Float[Array | np.ndarray, "cells cells cells"]
    ball: BallOption | Float[Array | np.ndarray, "4"]


def is_occupied(grid: OccupancyGrid, points: Float[Array, "points 3"]) -> Bool[Array, " points"]:
    """Returns which points, in world units, are in occupied cells; none outside the cube are."""
    ball, count = jnp.asarray(grid.ball, points.dtype), grid.occupancy.shape[0]
    offset = (points - ball[None, :3]) / ball[3]
    cells = jnp.floor(0.5 * count * (offset + 1.0)).astype(jnp.int32)
    occupancy = jnp.asarray(grid.occupancy)[tuple(jnp.clip(cells, 0, count - 1).T)]
    return jnp.all(jnp.abs(offset) < 1.0, axis=-1) & (occupancy > 0.0)


def meets_occupied(grid: OccupancyGrid, ray: Rays) -> Bool[Array, ""]:
    """Returns whether a straight ray meets an occupied cell within the ball.

    The ray is sampled at steps of a quarter of a cell.
    """
    ball = jnp.asarray(grid.ball, ray.origins.dtype)
    middle, half = chord(ball[3], ray.origins - ball[:3], ray.directions)
    along = middle + half * jnp.linspace(-1.0, 1.0, 4 * grid.occupancy.shape[0])
    points = ray.origins[None] + jnp.maximum(along, 0.0)[:, None] * ray.directions[None]
    return (half > 0.0) & jnp.any(is_occupied(grid, points))
