"""Tree of the light paths of many rays, and its conversion to lists of paths.

A segment that several paths share is stored once, with a pointer to its parent segment; a path is
identified by its last segment.

`pack` converts the tree of many batches to lists of equal length. A batch keeps its strongest
paths, in the order of its rays, the heaviest path of each ray first. If the batches together exceed
the total capacity, the weakest paths of all batches are dropped first, because the cost of sorting
depends on the number of slots.

Symbols as in `light_paths`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax.optics import queues
from refref_jax.optics.light_paths import LightPaths, PathEnds, PathStatus, RayDifferential, Stop
from refref_jax.optics.media import AMBIENT
from refref_jax.optics.path_settings import Detail
from refref_jax.optics.queues import Queue

NO_SEGMENT = -1
"""Parent of a camera ray's first segment."""

# Index past the end of any list: writes to it are dropped.
_NOWHERE = 2**31 - 1


class Segments(NamedTuple):
    """A list of path segments; the first ones are the camera rays.

    Attributes:
      parents: index of the parent segment, `NO_SEGMENT` for a camera ray.
      points: start of the segment, world units.
      directions: unit direction.
      tau: arc length from the camera to the start.
      media: medium of the segment (see `media`).
      parts: part on whose surface the segment starts, or `media.EMPTY_SLOT`.
      differentials: ray differential of the segment (see `RayDifferential`).
    """

    parents: Int[Array, " segments"]
    points: Float[Array, "segments 3"]
    directions: Float[Array, "segments 3"]
    tau: Float[Array, " segments"]
    media: Int[Array, " segments"]
    parts: Int[Array, " segments"]
    differentials: RayDifferential


class Ends(NamedTuple):
    """The ends of paths.

    Attributes:
      segments: index of the last segment.
      rays: index of the camera ray.
      throughput: share of the ray's linear RGB that the path carries.
      num_bends: number of bends.
      statuses: `PathStatus` of each path.
      stop: ends on opaque surfaces, `None` without such surfaces.
    """

    segments: Int[Array, " paths"]
    rays: Int[Array, " paths"]
    throughput: Float[Array, "paths 3"]
    num_bends: Int[Array, " paths"]
    statuses: Int[Array, " paths"]
    stop: Stop | None = None


class PathTree(NamedTuple):
    """All paths of the rays that are traced together.

    Attributes:
      segments: list of `Segments`.
      ends: list of `Ends`, one per path.
      dropped: dropped throughput of each ray, linear RGB.
      casts: number of rays that were cast.
    """

    segments: Queue
    ends: Queue
    dropped: Float[Array, "rays 3"]
    casts: Int[Array, ""]


def set_media(
    tree: PathTree,
    segments: Int[Array, " n"],
    media: Int[Array, " n"],
    which: Bool[Array, " n"],
) -> PathTree:
    """Sets the media of some segments."""
    log = tree.segments.items
    target = jnp.where(which, segments, log.media.shape[0])
    log = log._replace(media=log.media.at[target].set(media, mode="drop"))
    return tree._replace(segments=tree.segments._replace(items=log))


def listed(tree: PathTree, capacity: int) -> Ends:
    """Returns the ends of a tree in a list of a given capacity; slots past the last are empty."""
    ends = jax.tree.map(lambda x: x[:capacity], tree.ends.items)
    lanes = jnp.arange(capacity, dtype=jnp.int32)
    return emptied(ends, lanes >= tree.ends.count, jnp.zeros_like(lanes))


def emptied(ends: Ends, empty: Bool[Array, " paths"], home: Int[Array, " paths"]) -> Ends:
    """Clears the marked slots, which then refer to the camera ray `home`."""
    return Ends(
        segments=jnp.where(empty, home, ends.segments),
        rays=jnp.where(empty, home, ends.rays),
        throughput=jnp.where(empty[:, None], 0.0, ends.throughput),
        num_bends=jnp.where(empty, 0, ends.num_bends),
        statuses=jnp.where(empty, PathStatus.EMPTY, ends.statuses).astype(jnp.int32),
        stop=ends.stop and ends.stop._replace(tau=jnp.where(empty, jnp.inf, ends.stop.tau)),
    )


def last_segments(segments: Segments, ends: Ends) -> PathEnds:
    """Returns the last segment of each path."""
    last = jax.tree.map(lambda x: x[ends.segments], segments)
    return PathEnds(
        origins=last.points,
        directions=last.directions,
        tau=last.tau,
        media=last.media,
        rays=ends.rays,
        throughput=ends.throughput,
        num_bends=ends.num_bends,
        statuses=ends.statuses,
        differentials=last.differentials,
        stop=ends.stop,
    )


def polylines(
    segments: Segments, ends: Ends, radii: Float[Array, " paths"], *, detail: Detail, parts: int
) -> LightPaths:
    """Returns paths with the selected segments.

    Args:
      segments: all segments.
      ends: ends of the paths.
      radii: footprint of each path's pixel.
      detail: selection of segments, and whether hits are tallied per part.
      parts: number of parts in the scene.
    """
    walk = _walk_back(segments, ends, detail, parts if detail.tally == "parts" else 0)
    # Segments were selected from last to first and are right-aligned in their row.
    count = jnp.minimum(walk.found, detail.most)
    lanes = jnp.arange(detail.most, dtype=jnp.int32)[None]
    used = lanes < count[:, None]
    place = jnp.where(used, lanes + detail.most - count[:, None], detail.most - 1)
    picked = jnp.take_along_axis(walk.picked, place, axis=-1)
    stop = jnp.take_along_axis(walk.stops, place, axis=-1)
    read = jax.tree.map(lambda x: x[picked], segments)
    return LightPaths(
        points=read.points,
        directions=read.directions,
        tau=jnp.where(used, read.tau, jnp.inf),
        ends=jnp.where(used, stop, jnp.inf),
        media=jnp.where(used, read.media, AMBIENT),
        differentials=read.differentials,
        rays=ends.rays,
        throughput=ends.throughput,
        radii=radii,
        num_bends=ends.num_bends,
        statuses=ends.statuses,
        hit_counts=walk.hit_counts,
        path_lengths=_up_to_stops(segments, ends, walk.path_lengths),
        stop=ends.stop,
    )


def _up_to_stops(
    segments: Segments, ends: Ends, lengths: Float[Array, "paths tallied"]
) -> Float[Array, "paths tallied"]:
    """Adds the lengths of last segments that end on opaque surfaces to those in media."""
    if ends.stop is None:
        return lengths
    length = ends.stop.tau - segments.tau[ends.segments]
    parts = jnp.arange(lengths.shape[1], dtype=jnp.int32)[None]
    through = 1 + parts == segments.media[ends.segments][:, None]
    return lengths + jnp.where(through & jnp.isfinite(length)[:, None], length[:, None], 0.0)


class _Walk(NamedTuple):
    """State of the loop from the last segment of each path back to its first.

    Attributes:
      segment: current segment of each path, `NO_SEGMENT` if it is done.
      stop: arc length at the end of the current segment.
      found: number of selected segments so far.
      picked: selected segments of each path, right-aligned. If they do not fit, they overwrite each
        other at the left end, where the first segment of the path remains.
      stops: arc lengths at the ends of the selected segments.
      hit_counts: hit counts so far.
      path_lengths: path lengths so far.
    """

    segment: Int[Array, " paths"]
    stop: Float[Array, " paths"]
    found: Int[Array, " paths"]
    picked: Int[Array, "paths most"]
    stops: Float[Array, "paths most"]
    hit_counts: Float[Array, "paths tallied"]
    path_lengths: Float[Array, "paths tallied"]


def _walk_back(segments: Segments, ends: Ends, detail: Detail, tallied: int) -> _Walk:
    count = ends.segments.shape[0]
    none = jnp.zeros_like(segments.tau, shape=(count, tallied))
    lanes = jnp.arange(detail.most, dtype=jnp.int32)[None]
    names = jnp.arange(tallied, dtype=jnp.int32)[None]

    def step(walk: _Walk) -> _Walk:
        going = walk.segment != NO_SEGMENT
        at = jnp.maximum(walk.segment, 0)
        tau, medium = segments.tau[at], segments.media[at]
        wanted = going & ((detail.segments == "all") | (medium == AMBIENT) | jnp.isinf(walk.stop))
        here = wanted[:, None] & (lanes == jnp.maximum(detail.most - 1 - walk.found, 0)[:, None])
        # The last segment is infinite and is not added to the path lengths.
        length = jnp.where(going & jnp.isfinite(walk.stop), walk.stop - tau, 0.0)
        met = (going & (segments.parts[at] >= 0))[:, None] & (names == segments.parts[at][:, None])
        through = names + 1 == medium[:, None]
        return _Walk(
            segment=jnp.where(going, segments.parents[at], NO_SEGMENT),
            stop=tau,
            found=walk.found + wanted.astype(jnp.int32),
            picked=jnp.where(here, at[:, None], walk.picked),
            stops=jnp.where(here, walk.stop[:, None], walk.stops),
            hit_counts=walk.hit_counts + met.astype(none.dtype),
            path_lengths=walk.path_lengths + jnp.where(through, length[:, None], 0.0),
        )

    start = _Walk(
        segment=ends.segments,
        stop=jnp.full_like(none, jnp.inf, shape=(count,)),
        found=jnp.zeros_like(ends.segments),
        picked=jnp.zeros((count, detail.most), jnp.int32),
        stops=jnp.full_like(none, jnp.inf, shape=(count, detail.most)),
        hit_counts=none,
        path_lengths=none,
    )
    # Every segment has one bend more than its parent, so the loop terminates.
    return jax.lax.while_loop(lambda walk: jnp.any(walk.segment != NO_SEGMENT), step, start)


def pack(
    tree: PathTree, batches: int, rays: int, capacity: int
) -> tuple[Ends, Float[Array, "all_rays 3"]]:
    """Sorts paths into one list per batch.

    Args:
      tree: paths of all batches.
      batches: number of batches.
      rays: number of rays in each batch.
      capacity: capacity for the paths of each batch.

    Returns:
      The concatenated lists, and the throughput dropped so far for each ray.
    """
    most = min(batches * capacity, tree.ends.items.rays.shape[0])
    queue, dropped = queues.drop_weakest(tree.ends, tree.dropped, most)
    ends = listed(tree._replace(ends=queue), most)
    throughput = jnp.max(ends.throughput, axis=-1)
    # The slots past the last path form a batch of their own.
    lanes = jnp.arange(most, dtype=jnp.int32)
    batch = jnp.where(lanes < queue.count, ends.rays // rays, batches)
    fits = _strongest_of_each(batch, throughput, batches, capacity)
    order = jnp.lexsort((-throughput, jnp.where(fits, ends.rays, batches * rays))).astype(jnp.int32)
    group = jnp.where(fits, batch, batches)[order]
    target = jnp.where(fits[order], group * capacity + _rank_in_group(group, batches), _NOWHERE)
    source = jnp.full(batches * capacity, most, jnp.int32).at[target].set(order, mode="drop")
    packed = jax.tree.map(lambda x: x[jnp.minimum(source, most - 1)], ends)
    home = jnp.repeat(jnp.arange(batches, dtype=jnp.int32) * rays, capacity)
    dropped = queues.add_dropped(dropped, ends.rays, ends.throughput, ~fits)
    return emptied(packed, source == most, home), dropped


def _strongest_of_each(
    batch: Int[Array, " paths"], throughput: Float[Array, " paths"], batches: int, capacity: int
) -> Bool[Array, " paths"]:
    """Returns which paths are among the strongest of their batch; sorts only if necessary."""

    def choose(batch: Int[Array, " paths"]) -> Bool[Array, " paths"]:
        order = jnp.lexsort((-throughput, batch))
        rank = _rank_in_group(batch[order], batches)
        # Writing Booleans would compare and swap on an NVIDIA GPU.
        return jnp.zeros_like(batch).at[order].set(rank) < capacity

    real = batch < batches
    counts = jax.ops.segment_sum(jnp.ones_like(batch), batch, num_segments=batches + 1)
    crowded = jnp.any(counts[:batches] > capacity)
    return real & jax.lax.cond(crowded, choose, lambda batch: jnp.ones_like(batch, bool), batch)


def _rank_in_group(group: Int[Array, " n"], groups: int) -> Int[Array, " n"]:
    """Returns the position of each record within its group, for records sorted by group."""
    begin = jnp.searchsorted(group, jnp.arange(groups + 1, dtype=jnp.int32)).astype(jnp.int32)
    return jnp.arange(group.shape[0], dtype=jnp.int32) - begin[group]
