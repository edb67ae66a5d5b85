"""Tree of the light paths of many rays, and its conversion to lists of paths.

A segment that several paths share is stored once, with a pointer to its parent segment; a path is
identified by its last segment.

`pack` converts the tree of many batches to lists of equal length. A batch keeps its strongest
paths, in the order of its rays, the heaviest path of each ray first. If the batches together exceed
the total capacity, the weakest paths of all batches are dropped first, because the cost of sorting
depends on the number of slots.

Symbols as in `light_paths`.

The tree, and the rays that are still to be traced, are kept in queues with static capacity. A queue
is an array of records with a count; records past the count are meaningless. Appending writes a full
block, so a queue has one block of space beyond its capacity. After appending, callers reduce the
queue to its capacity with `drop_weakest`, which drops the records of least throughput.
"""

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax.optics.light_paths import LightPaths, PathEnds, PathStatus, RayDifferential, Stop
from refref_jax.optics.media import AMBIENT
from refref_jax.optics.path_settings import Detail

Records = Any
"""NamedTuple of arrays with one leading axis.

`drop_weakest` requires the fields `throughput` and `rays`.
"""


class Queue(NamedTuple):
    """A list of records.

    Attributes:
      items: records, along the leading axis of each field.
      count: number of valid records.
    """

    items: Records
    count: Int[Array, ""]  # type: ignore[assignment]  # hides tuple.count


def fill(items: Records, count: int, size: int) -> Queue:
    """Returns a queue of `size` records, whose first `count` hold the given records."""

    def pad(x: Array) -> Array:
        return jnp.concatenate([x, jnp.zeros((size - x.shape[0], *x.shape[1:]), x.dtype)])

    return Queue(jax.tree.map(pad, items), jnp.int32(count))


def join(first: Records, second: Records) -> Records:
    """Concatenates two blocks of records."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)


def append(queue: Queue, block: Records, keep: Bool[Array, " block"]) -> Queue:
    """Appends the selected records of a block, in order.

    Args:
      queue: queue with space for at least one block beyond its count.
      block: records of the same type.
      keep: mask of the records to append.
    """
    order = front_first(keep)
    items = jax.tree.map(
        lambda old, new: jax.lax.dynamic_update_slice_in_dim(old, new[order], queue.count, 0),
        queue.items,
        block,
    )
    return Queue(items, queue.count + jnp.sum(keep, dtype=jnp.int32))


def pop(queue: Queue, size: int) -> tuple[Queue, Queue]:
    """Removes up to `size` records from the end; returns the remaining and the removed records."""
    start = jnp.maximum(queue.count - size, 0)
    taken = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, size, 0), queue.items)
    return Queue(queue.items, start), Queue(taken, queue.count - start)


def drop_weakest(
    queue: Queue, dropped: Float[Array, "rays 3"], capacity: int
) -> tuple[Queue, Float[Array, "rays 3"]]:
    """Drops the weakest records beyond a capacity. Its cost is negligible if there are none.

    Args:
      queue: records with fields `throughput` (linear RGB) and `rays` (index of the camera ray).
      dropped: throughput dropped so far for each ray.
      capacity: maximum number of records to keep.

    Returns:
      The queue, in its original order, and the updated dropped throughput.
    """

    def drop(queue: Queue, dropped: Float[Array, "rays 3"]) -> tuple[Queue, Float[Array, "rays 3"]]:
        throughput, rays = queue.items.throughput, queue.items.rays
        filled = jnp.arange(rays.shape[0], dtype=jnp.int32) < queue.count
        kept = strongest(filled, jnp.max(throughput, axis=-1), jnp.int32(capacity))
        order = front_first(kept)
        items = jax.tree.map(lambda x: x[order], queue.items)
        dropped = add_dropped(dropped, rays, throughput, filled & ~kept)
        return Queue(items, jnp.sum(kept, dtype=jnp.int32)), dropped

    return jax.lax.cond(queue.count > capacity, drop, lambda *same: same, queue, dropped)


def add_dropped(
    dropped: Float[Array, "rays 3"],
    rays: Int[Array, " n"],
    throughput: Float[Array, "n 3"],
    which: Bool[Array, " n"],
) -> Float[Array, "rays 3"]:
    """Adds the throughput of the marked records to the dropped throughput of their rays."""
    return dropped.at[rays].add(jnp.where(which[:, None], throughput, 0.0))


def strongest(
    mask: Bool[Array, " n"], strength: Float[Array, " n"], capacity: Int[Array, ""]
) -> Bool[Array, " n"]:
    """Returns the `capacity` strongest of the marked records; all of them if there are fewer.

    Among equally strong records, the first are kept. Sorts only if there are more than
    `capacity`.
    """

    def choose(mask: Bool[Array, " n"]) -> Bool[Array, " n"]:
        order = jnp.argsort(jnp.where(mask, -strength, jnp.inf), stable=True).astype(jnp.int32)
        places = jnp.arange(mask.shape[0], dtype=jnp.int32)
        rank = jnp.zeros_like(order).at[order].set(places)
        return mask & (rank < capacity)

    fits = jnp.sum(mask, dtype=jnp.int32) <= capacity
    return jax.lax.cond(fits, lambda mask: mask, choose, mask)


def front_first(keep: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Returns indices that move the marked records to the front, in order.

    The remaining indices are valid but arbitrary.
    """
    count = keep.shape[0]
    target = jnp.where(keep, jnp.cumsum(keep, dtype=jnp.int32) - 1, count)
    lanes = jnp.arange(count, dtype=jnp.int32)
    return jnp.zeros(count, jnp.int32).at[target].set(lanes, mode="drop")


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


class LastSegments(NamedTuple):
    """The last segments of paths, where no others are stored; fields as in `Segments`."""

    points: Float[Array, "paths 3"]
    directions: Float[Array, "paths 3"]
    tau: Float[Array, " paths"]
    media: Int[Array, " paths"]
    differentials: RayDifferential


class Ends(NamedTuple):
    """The ends of paths.

    Attributes:
      segments: index of the last segment; `None` if segments are not stored.
      rays: index of the camera ray.
      throughput: share of the ray's linear RGB that the path carries.
      num_bends: number of bends.
      statuses: `PathStatus` of each path.
      stop: ends on opaque surfaces, `None` without such surfaces.
      last: last segments, if segments are not stored.
    """

    segments: Int[Array, " paths"] | None
    rays: Int[Array, " paths"]
    throughput: Float[Array, "paths 3"]
    num_bends: Int[Array, " paths"]
    statuses: Int[Array, " paths"]
    stop: Stop | None = None
    last: LastSegments | None = None


class PathTree(NamedTuple):
    """All paths of the rays that are traced together.

    Attributes:
      segments: list of `Segments`; only their number, if they are not stored.
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
        segments=None if ends.segments is None else jnp.where(empty, home, ends.segments),
        rays=jnp.where(empty, home, ends.rays),
        throughput=jnp.where(empty[:, None], 0.0, ends.throughput),
        num_bends=jnp.where(empty, 0, ends.num_bends),
        statuses=jnp.where(empty, PathStatus.EMPTY, ends.statuses).astype(jnp.int32),
        stop=ends.stop and ends.stop._replace(tau=jnp.where(empty, jnp.inf, ends.stop.tau)),
        last=ends.last and _first_where(empty, ends.last),
    )


def _first_where(empty: Bool[Array, " paths"], last: LastSegments) -> LastSegments:
    """Returns last segments with that of the first path in empty slots: finite, if meaningless."""

    def choose(x: Array) -> Array:
        return jnp.where(empty.reshape(-1, *[1] * (x.ndim - 1)), x[:1], x)

    return jax.tree.map(choose, last)


def last_segments(segments: Segments | None, ends: Ends) -> PathEnds:
    """Returns the last segment of each path."""
    last = ends.last or jax.tree.map(lambda x: x[ends.segments], segments)
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
    last = cast(Array, ends.segments)
    count = last.shape[0]
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
        segment=last,
        stop=jnp.full_like(none, jnp.inf, shape=(count,)),
        found=jnp.zeros_like(last),
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
    queue, dropped = drop_weakest(tree.ends, tree.dropped, most)
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
    dropped = add_dropped(dropped, ends.rays, ends.throughput, ~fits)
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
