"""Points on a light path at given coordinates, computed from its cumulative distances.

A sampler works on one coordinate `t` along a path. Usually `t` is arc length. If the inside of the
objects is known to be clear, `t` can be the arc length outside them only: the same polyline with
its inner segments shrunk to length zero, so that no sample falls inside.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax.geometry.rays import orthonormal_basis
from refref_jax.optics import ray_differentials
from refref_jax.optics.light_paths import LightPaths
from refref_jax.optics.media import AMBIENT
from refref_jax.optics.ray_differentials import RayDifferential


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
      stop: coordinate `t` at which the path ends on an opaque surface, `inf` if it does not;
        `None` in scenes without such surfaces.
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
    lengths = jnp.where(jnp.isfinite(path.ends) & sampled, path.ends - line.arcs, 0.0)
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
    return ray_differentials.across(differential, along, direction)


def _outside(path: LightPaths) -> Bool[Array, " segments"]:
    return (path.media == AMBIENT) | jnp.isinf(path.ends)
