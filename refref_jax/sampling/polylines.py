"""Points on a light path at given coordinates, and multisamples of the pixel's cone around it.

A sampler works on one coordinate `t` along a path. Usually `t` is arc length. If the inside of the
objects is known to be clear, `t` can be the arc length outside them only: the same polyline with
its inner segments shrunk to length zero, so that no sample falls inside. In front of a backdrop, it
is the arc length inside them only, or within a ball around them.

An interval of a path is a conical frustum, represented by a few multisamples, each an isotropic
Gaussian, so that a field can blur detail that is finer than the pixel's footprint. The centre line
follows the bends. The width of the cone grows with arc length, as along a straight ray, or is that
of the ray differentials, if they are carried (`optics.light_paths`).

Source of the multisamples: Barron et al., Zip-NeRF (2023), section 2; paper (arXiv 2505.05848),
supplement, for the bent centre line.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.choices import BallOption
from refref_jax.geometry.rays import chord, orthonormal_basis
from refref_jax.optics import light_paths
from refref_jax.optics.light_paths import LightPaths, RayDifferential
from refref_jax.optics.media import AMBIENT

# Angles of Zip-NeRF's hexagon: two triangles of points, the second rotated by half a turn.
_HEXAGON = tuple(math.pi * turn for turn in (0.0, 2.0 / 3.0, 4.0 / 3.0, 1.0, 5.0 / 3.0, 1.0 / 3.0))

# Offsets of the six points along the ray, for the formula in `_hexagon_distances`.
_HEXAGON_STEPS = tuple(3.0 / math.sqrt(7.0) * (2.0 * j / 5.0 - 1.0) for j in range(6))

# Standard deviation of a multisample in units of its distance from the centre line.
_HEXAGON_SCALE = 0.5


class Polyline(NamedTuple):
    """One light path, ready for sampling.

    Attributes:
      points: start of each segment, world units.
      directions: unit direction of each segment.
      knots: coordinate `t` at the start of each segment, non-decreasing from 0; `inf` where unused.
      arcs: arc length from the camera to the start of each segment.
      outside: whether the segment is outside the objects. The last segment always counts as
        outside: truncated paths end on the background too.
      differentials: ray differential of each segment, if carried.
      radius: radius of the pixel's cone at unit distance.
      stop: coordinate `t` at which the path ends on an opaque surface, or at which the part of it
        that is sampled ends; `inf` if neither does, `None` in scenes without opaque surfaces.
    """

    points: Float[Array, "segments 3"]
    directions: Float[Array, "segments 3"]
    knots: Float[Array, " segments"]
    arcs: Float[Array, " segments"]
    outside: Bool[Array, " segments"]
    differentials: RayDifferential
    radius: Float[Array, ""]
    stop: Float[Array, ""] | None = None


class PolylinePoint(NamedTuple):
    """A point of a polyline.

    Attributes:
      position: position in world units.
      direction: unit direction of travel at the point.
      arc: arc length from the camera.
      outside: whether the point is outside the objects.
      footprint: half axes of the pixel's footprint, perpendicular to `direction`, world units.
    """

    position: Float[Array, "3"]
    direction: Float[Array, "3"]
    arc: Float[Array, ""]
    outside: Bool[Array, ""]
    footprint: Float[Array, "2 3"]


def whole_path(path: LightPaths) -> Polyline:
    """Returns one light path with arc length as its coordinate."""
    used = jnp.isfinite(path.tau)
    return Polyline(
        points=path.points,
        directions=path.directions,
        knots=path.tau,
        arcs=jnp.where(used, path.tau, 0.0),
        outside=_outside(path),
        differentials=path.differentials,
        radius=path.radii,
        stop=path.stop and path.stop.tau,
    )


def outside_path(path: LightPaths, *, also: tuple[int, ...] = ()) -> Polyline:
    """Returns one light path whose coordinate does not advance inside the objects.

    Args:
      path: one light path.
      also: parts in whose media the coordinate advances, too.
    """
    line = whole_path(path)
    sampled = line.outside
    for part in also:
        sampled |= path.media == 1 + part
    return _advancing(path, line, sampled)


def inside_path(path: LightPaths, *, parts: tuple[int, ...] | None = None) -> Polyline:
    """Returns one light path whose coordinate only advances inside the objects.

    Its stop is the end of its last segment inside, 0 if there is none.

    Args:
      path: one light path, with all of its segments.
      parts: parts in whose media the coordinate advances; all by default.
    """
    line = whole_path(path)
    inside = ~line.outside
    if parts is not None:
        media = jnp.asarray([1 + part for part in parts], path.media.dtype)
        inside &= jnp.any(path.media[:, None] == media[None, :], axis=-1)
    line = _advancing(path, line._replace(stop=None), inside)
    return line._replace(stop=jnp.max(line.knots, where=jnp.isfinite(line.knots), initial=0.0))


def path_in_ball(
    path: LightPaths, ball: BallOption, *, end: Float[Array, ""] | float = math.inf
) -> Polyline:
    """Returns one light path whose coordinate advances from a ball's surface to its surface.

    Its first and last segment are cut by the ball, and those between bends are kept whole. Its stop
    is where the path leaves the ball, or ends on an opaque surface or the background; 0 for a path
    beside the ball.

    Args:
      path: one light path, with all of its segments.
      ball: centre and radius of the ball, world units.
      end: distance of the background from the start of the last segment.
    """
    *centre, radius = ball
    line, used = whole_path(path), jnp.isfinite(path.tau)
    slots, last = jnp.arange(used.size), jnp.sum(used) - 1
    from_centre = line.points - jnp.asarray([centre], line.points.dtype)
    middle, half = jax.vmap(chord, in_axes=(None, 0, 0))(radius, from_centre, line.directions)
    leave = jnp.where(half > 0.0, jnp.maximum(middle + half, 0.0), 0.0)
    if line.stop is not None:
        leave = jnp.minimum(leave, line.stop - line.arcs)
    leave = jnp.where(slots == last, jnp.minimum(leave, end), leave)
    ends = jnp.where(slots == last, leave, path.ends - line.arcs)
    ends = jnp.where(slots == 0, jnp.minimum(ends, leave), ends)
    starts = jnp.where(slots == 0, jnp.clip(middle - half, 0.0, ends), 0.0)
    lengths = jnp.where(used, jnp.maximum(ends - starts, 0.0), 0.0)
    points, turns = line.differentials
    moved = line._replace(
        points=line.points + starts[:, None] * line.directions,
        arcs=line.arcs + starts,
        differentials=RayDifferential(points + starts[:, None, None] * turns, turns),
        stop=None,
    )
    return _with_lengths(path, moved, lengths)._replace(stop=jnp.sum(lengths))


def _advancing(path: LightPaths, line: Polyline, sampled: Bool[Array, " segments"]) -> Polyline:
    """Returns a light path whose coordinate only advances along some of its segments."""
    lengths = jnp.where(jnp.isfinite(path.ends) & sampled, path.ends - line.arcs, 0.0)
    return _with_lengths(path, line, lengths)


def _with_lengths(path: LightPaths, line: Polyline, lengths: Float[Array, " segments"]) -> Polyline:
    """Returns a light path along whose segments the coordinate advances by given lengths."""
    # Summed separately for each segment, in the same order, so that a segment of length 0 starts
    # exactly where the next one does. A running sum would round them apart, and a sample could fall
    # between.
    earlier = jnp.tril(jnp.ones((lengths.size, lengths.size), bool), k=-1)
    starts = jnp.sum(jnp.where(earlier, lengths[None, :], 0.0), axis=-1)
    line = line._replace(knots=jnp.where(jnp.isfinite(path.tau), starts, jnp.inf))
    if line.stop is None:
        return line
    last = jnp.sum(jnp.isfinite(path.tau)) - 1
    return line._replace(stop=starts[last] + (line.stop - line.arcs[last]))


def through(line: Polyline, vertices: Float[Array, "segments 3"]) -> Polyline:
    """Returns the line from the start of a straight one through other points.

    Its last segment continues beyond the last of them. Footprints grow with arc length as along the
    straight line. Where two vertices are equal, the segment between them has its direction.

    Args:
      line: a straight line, with one segment.
      vertices: the points, in order.
    """
    starts = jnp.concatenate([line.points[:1], vertices[:-1]])
    steps = vertices - starts
    lengths = numerics.length(steps)
    earlier = jnp.tril(jnp.ones((lengths.size, lengths.size), bool), k=-1)
    arcs = jnp.sum(jnp.where(earlier, lengths[None, :], 0.0), axis=-1)
    spread = jax.tree.map(lambda x: jnp.broadcast_to(x, (lengths.size, *x.shape[1:])), line)
    points, turns = line.differentials
    directions = jnp.where(lengths[:, None] > 0.0, numerics.normalize(steps), line.directions)
    return line._replace(
        points=starts,
        directions=directions,
        knots=arcs,
        arcs=arcs,
        outside=spread.outside,
        differentials=RayDifferential(
            points + arcs[:, None, None] * turns, spread.differentials.directions
        ),
    )


def point_at(line: Polyline, t: Float[Array, ""]) -> PolylinePoint:
    """Returns the point at coordinate `t >= 0`.

    At a knot, the later segment is used, as in the paper's half-open intervals
    `[tau_i, tau_{i+1})` (arXiv 2505.05848, section 4.2).
    """
    segment = segment_at(line, t)
    along = t - line.knots[segment]
    direction = line.directions[segment]
    arc = line.arcs[segment] + along
    return PolylinePoint(
        position=line.points[segment] + along * direction,
        direction=direction,
        arc=arc,
        outside=line.outside[segment],
        footprint=_footprint(line, segment, along, arc),
    )


def segment_at(line: Polyline, t: Float[Array, ""]) -> Int[Array, ""]:
    """Returns the index of the segment that contains coordinate `t`."""
    return jnp.sum(line.knots[1:] <= t, dtype=jnp.int32)


def _footprint(
    line: Polyline, segment: Int[Array, ""], along: Float[Array, ""], arc: Float[Array, ""]
) -> Float[Array, "2 3"]:
    """Returns the half axes of a footprint; those of a straight cone without differentials."""
    direction = line.directions[segment]
    if line.differentials.points.shape[-2] == 0:
        return line.radius * arc * jnp.stack(orthonormal_basis(direction))
    differential = jax.tree.map(lambda x: x[segment], line.differentials)
    return light_paths.across(differential, along, direction)


def _outside(path: LightPaths) -> Bool[Array, " segments"]:
    return (path.media == AMBIENT) | jnp.isinf(path.ends)


# ---- Multisamples ----


class Gaussians(NamedTuple):
    """Isotropic Gaussians, the multisamples of one interval of a path.

    Attributes:
      positions: means.
      scales: standard deviations.
    """

    positions: Float[Array, "samples 3"]
    scales: Float[Array, " samples"]


def multisamples(
    line: Polyline,
    start: Float[Array, ""],
    end: Float[Array, ""],
    rotation: Float[Array, ""],
    *,
    count: int,
) -> Gaussians:
    """Samples the frustum of one interval.

    Six multisamples match the mean of the frustum and its covariance across the ray; a single one
    lies on the centre line and has this covariance. A multisample belongs to the segment at its own
    coordinate, even if the interval straddles an interface.

    Args:
      line: the path.
      start: coordinate of the interval's start.
      end: coordinate of the interval's end, at least `start`.
      rotation: rotation of the pattern about the centre line, radians.
      count: number of multisamples, 1 or 6.

    Raises:
      ValueError: if `count` is neither 1 nor 6.
    """
    if count == 1:
        t = _frustum_mean(start, end)
        point = point_at(line, t)
        return Gaussians(point.position[None], (0.5 * _mean_radius(point.footprint))[None])
    if count != len(_HEXAGON):
        raise ValueError(
            f"count is {count}, but cone patterns have 1 or 6 points. Use 1 (centre line) or 6 "
            "(Zip-NeRF's hexagon)."
        )
    angles = jnp.asarray(_HEXAGON, start.dtype) + rotation

    def one_sample(t: Float[Array, ""], angle: Float[Array, ""]) -> Gaussians:
        point = point_at(line, t)
        right, up = point.footprint / math.sqrt(2.0)
        offset = jnp.cos(angle) * right + jnp.sin(angle) * up
        scale = _HEXAGON_SCALE / math.sqrt(2.0) * _mean_radius(point.footprint)
        return Gaussians(point.position + offset, scale)

    return jax.vmap(one_sample)(_hexagon_distances(start, end), angles)


def _mean_radius(footprint: Float[Array, "2 3"]) -> Float[Array, ""]:
    """Returns the radius of a disc with the mean second moment of an ellipse."""
    return numerics.length(footprint.reshape(6)) / math.sqrt(2.0)


def _frustum_mean(start: Float[Array, ""], end: Float[Array, ""]) -> Float[Array, ""]:
    """Returns the mean distance of a conical frustum (mip-NeRF, Eq 7), without overflow."""
    mean, ratio = _middle_and_ratio(start, end)
    return mean * (1.0 + 2.0 * ratio**2 / (3.0 + ratio**2))


def _hexagon_distances(start: Float[Array, ""], end: Float[Array, ""]) -> Float[Array, "6"]:
    """Returns the distances of the six points, which match the frustum's moments (Eq 3)."""
    mean, ratio = _middle_and_ratio(start, end)
    spread = jnp.sqrt((ratio**2 - 1.0) ** 2 + 4.0)
    steps = jnp.asarray(_HEXAGON_STEPS, start.dtype)
    shift = (1.0 + ratio) ** 2 + 2.0 + steps * spread
    return start + mean * ratio * shift / (ratio**2 + 3.0)


def _middle_and_ratio(
    start: Float[Array, ""], end: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns the middle of an interval, and the ratio of half-width to middle, 0 at the apex."""
    mean = 0.5 * (start + end)
    return mean, numerics.safe_divide(0.5 * (end - start), mean)
