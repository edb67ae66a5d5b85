"""The tree of light paths that a pool of rays grows, and how paths are read from it.

A segment is stored once, however many paths share it, with a pointer to the one before it; a path
is known by its last segment. Letters as in `light_paths`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax.optics.light_paths import LightPaths, PathEnds, PathStatus
from refref_jax.optics.pools import Pool

NO_SEGMENT = -1
"""The segment before a camera ray."""


class Segments(NamedTuple):
    """A log of path segments; the first ones are the camera rays.

    Attributes:
      parents: index of the segment before, `NO_SEGMENT` for a camera ray.
      points: start, world units.
      directions: unit direction.
      tau: arc length from the camera to the start.
      media: medium (see `media`).
    """

    parents: Int[Array, " segments"]
    points: Float[Array, "segments 3"]
    directions: Float[Array, "segments 3"]
    tau: Float[Array, " segments"]
    media: Int[Array, " segments"]


class Ends(NamedTuple):
    """Where paths end.

    Attributes:
      segments: index of the last segment.
      rays: index of the camera ray.
      weights: share in its linear RGB.
      bends: number of bends.
      statuses: a `PathStatus`.
    """

    segments: Int[Array, " paths"]
    rays: Int[Array, " paths"]
    weights: Float[Array, "paths 3"]
    bends: Int[Array, " paths"]
    statuses: Int[Array, " paths"]


class PathTree(NamedTuple):
    """All paths of a pool of rays.

    Attributes:
      segments: the log.
      ends: one record a path.
      lost: share of each ray's linear RGB that found no room.
      casts: number of rays that were cast.
    """

    segments: Pool
    ends: Pool
    lost: Float[Array, "rays 3"]
    casts: Int[Array, ""]


def listed(tree: PathTree, capacity: int) -> Ends:
    """Returns the ends of a tree in a list of that capacity; slots past the last are empty."""
    ends = jax.tree.map(lambda x: x[:capacity], tree.ends.items)
    lanes = jnp.arange(capacity, dtype=jnp.int32)
    return emptied(ends, lanes >= tree.ends.count, jnp.zeros_like(lanes))


def emptied(ends: Ends, empty: Bool[Array, " paths"], home: Int[Array, " paths"]) -> Ends:
    """Takes the paths out of some slots; these then look along the camera ray `home`."""
    return Ends(
        segments=jnp.where(empty, home, ends.segments),
        rays=jnp.where(empty, home, ends.rays),
        weights=jnp.where(empty[:, None], 0.0, ends.weights),
        bends=jnp.where(empty, 0, ends.bends),
        statuses=jnp.where(empty, PathStatus.EMPTY, ends.statuses).astype(jnp.int32),
    )


def last_segments(segments: Segments, ends: Ends) -> PathEnds:
    """Returns only the last segment of each path."""
    last = jax.tree.map(lambda x: x[ends.segments], segments)
    return PathEnds(
        origins=last.points,
        directions=last.directions,
        tau=last.tau,
        media=last.media,
        rays=ends.rays,
        weights=ends.weights,
        bends=ends.bends,
        statuses=ends.statuses,
    )


def polylines(
    segments: Segments, ends: Ends, radii: Float[Array, " paths"], *, bends: int
) -> LightPaths:
    """Returns the paths in full, padded to `bends + 1` segments.

    Args:
      segments: the log.
      ends: of the wanted paths.
      radii: footprint of each path's pixel.
      bends: most bends of any path.
    """

    def step(segment: Int[Array, " paths"], place: Int[Array, ""]) -> tuple[Array, Segments]:
        """Reads one segment of every path, from the last place to the first."""
        used = place <= ends.bends
        read = jax.tree.map(lambda x: x[segment], segments)
        read = read._replace(tau=jnp.where(used, read.tau, jnp.inf))
        return jnp.where(used, read.parents, segment), read

    places = jnp.arange(bends, -1, -1, dtype=jnp.int32)
    _, read = jax.lax.scan(step, ends.segments, places)
    read = jax.tree.map(lambda x: jnp.moveaxis(x[::-1], 0, 1), read)
    return LightPaths(
        points=read.points,
        directions=read.directions,
        tau=read.tau,
        media=jnp.where(jnp.isfinite(read.tau), read.media, 0),
        rays=ends.rays,
        weights=ends.weights,
        radii=radii,
        bends=ends.bends,
        statuses=ends.statuses,
    )
