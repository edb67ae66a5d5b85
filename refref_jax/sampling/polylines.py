"""Points on a light path, found exactly by its cumulative distances.

A sampler works on one coordinate `t` along a path. Usually `t` is arc length. Where the inside
of the objects is known to be clear, `t` may count only the way outside them: the same polyline
with its inner segments shrunk to length zero, so that no sample can fall inside.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax.optics.light_paths import LightPaths
from refref_jax.optics.media import AMBIENT


class Polyline(NamedTuple):
    """One light path, ready to be sampled.

    Attributes:
      points: start of each segment, world units.
      directions: unit direction of each segment.
      knots: the coordinate `t` at which each segment starts, not decreasing from 0; `inf` where
        unused.
      arcs: arc length from the camera to the start of each segment.
      outside: whether the segment runs outside the objects. The last segment always counts as
        outside: a path that ran out of bends ends on the background like any other.
    """

    points: Float[Array, "segments 3"]
    directions: Float[Array, "segments 3"]
    knots: Float[Array, " segments"]
    arcs: Float[Array, " segments"]
    outside: Bool[Array, " segments"]


class PolylinePoint(NamedTuple):
    """A point of a polyline.

    Attributes:
      position: world units.
      direction: unit direction of travel there.
      arc: arc length from the camera.
      outside: whether it lies outside the objects.
    """

    position: Float[Array, "3"]
    direction: Float[Array, "3"]
    arc: Float[Array, ""]
    outside: Bool[Array, ""]


def whole_path(path: LightPaths) -> Polyline:
    """Returns one light path with arc length as its coordinate."""
    used = jnp.isfinite(path.tau)
    return Polyline(
        path.points, path.directions, path.tau, jnp.where(used, path.tau, 0.0), _outside(path)
    )


def outside_path(path: LightPaths) -> Polyline:
    """Returns one light path whose coordinate stands still inside the objects."""
    line = whole_path(path)
    ends = jnp.append(path.tau[1:], jnp.inf)
    lengths = jnp.where(jnp.isfinite(ends) & line.outside, ends - line.arcs, 0.0)
    # Summed anew for each segment, in one order: a segment without length then starts exactly
    # where the next one does. A running sum rounds them apart, and a sample falls between.
    earlier = jnp.tril(jnp.ones((lengths.size, lengths.size), bool), k=-1)
    starts = jnp.sum(jnp.where(earlier, lengths[None, :], 0.0), axis=-1)
    return line._replace(knots=jnp.where(jnp.isfinite(path.tau), starts, jnp.inf))


def point_at(line: Polyline, t: Float[Array, ""]) -> PolylinePoint:
    """Returns the point at coordinate `t >= 0`.

    At a knot the later segment is taken, as in the paper's half-open intervals
    `[tau_i, tau_{i+1})` (arXiv 2505.05848, section 4.2).
    """
    segment = segment_at(line, t)
    along = t - line.knots[segment]
    direction = line.directions[segment]
    return PolylinePoint(
        position=line.points[segment] + along * direction,
        direction=direction,
        arc=line.arcs[segment] + along,
        outside=line.outside[segment],
    )


def segment_at(line: Polyline, t: Float[Array, ""]) -> Int[Array, ""]:
    """Returns the index of the segment that holds coordinate `t`."""
    return jnp.sum(line.knots[1:] <= t, dtype=jnp.int32)


def _outside(path: LightPaths) -> Bool[Array, " segments"]:
    is_last = jnp.arange(path.tau.shape[0]) == path.bends
    return (path.media == AMBIENT) | is_last
