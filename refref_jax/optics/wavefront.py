"""Wavefront path tracing of rays along all branches of their paths.

Rays still to be cast are on a stack. Every iteration pops a block of rays and casts it: a ray that
hits nothing ends as a path; for a ray that hits a surface, the reflected and transmitted children
that the path settings follow are pushed on the stack. Blocks are therefore full until near the end,
even if few paths are deep. Children are traced before their parents' siblings (depth first), which
keeps the stack small.

Every segment of a path is stored once, with a pointer to its parent segment; a path is identified
by its last segment.

If a buffer exceeds its capacity, its records of least throughput are dropped, and the dropped
throughput of each ray is returned: the throughput of a ray's paths and its dropped throughput sum
to 1, minus absorption by tints and media.

Symbols as in `light_paths`. Source: paper (arXiv 2505.05848), section 4.2, for the interaction
with surfaces.
"""

import functools
from typing import Literal, NamedTuple, NoReturn, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax.choices import Footprint
from refref_jax.compilation import chosen_by_platform
from refref_jax.geometry import bvh
from refref_jax.geometry.rays import Rays
from refref_jax.optics import light_paths, media, path_settings, path_step, path_tree
from refref_jax.optics.light_paths import PathStatus, Stop
from refref_jax.optics.media import Scene
from refref_jax.optics.path_settings import Capacities, PathSettings
from refref_jax.optics.path_step import Arrival, Branches, RayState
from refref_jax.optics.path_tree import (
    NO_SEGMENT,
    Ends,
    LastSegments,
    PathTree,
    Queue,
    Segments,
    join,
)

StoredSegments = Literal["all", "last"]

# Number of rays cast per iteration: a core's cache holds so many, with their children. On an
# accelerator a block of many rays costs as much as one of few, so all rays are one block.
_BLOCK_ON_CPU, _BLOCK = 1024, 1 << 20


class Live(NamedTuple):
    """Active rays, which are still to be cast.

    Attributes:
      state: states of the rays.
      rays: index of each one's camera ray.
      segments: index of each one's current segment; `None` if segments are not stored.
      media: medium of the current segment; `None` if segments are stored.
    """

    state: RayState
    rays: Int[Array, " live"]
    segments: Int[Array, " live"] | None
    media: Int[Array, " live"] | None = None

    @property
    def throughput(self) -> Float[Array, "live 3"]:
        """Throughputs of the rays."""
        return self.state.throughput


class Children(NamedTuple):
    """The child rays of a block, reflected ones first.

    Attributes:
      live: child rays; `segments` is that of the parent until the child's segment is stored.
      media: medium of each child's segment.
      parts: part on whose surface each child's segment starts.
      exists: mask of children with positive throughput.
      traced: mask of children that are traced further.
    """

    live: Live
    media: Int[Array, " branches"]
    parts: Int[Array, " branches"]
    exists: Bool[Array, " branches"]
    traced: Bool[Array, " branches"]


def children_of(
    live: Live,
    branches: Branches,
    arrival: Arrival,
    bending: Bool[Array, " block"],
    settings: PathSettings,
) -> Children:
    """Returns the child rays of the rays that bend."""
    sides = arrival.interaction.sides
    states = join(branches.reflected, branches.transmitted)
    mediums = join(sides.medium_near, sides.medium_far)
    untraced = ~arrival.interaction.total & (settings.reflections == "first")
    traced = join(~untraced, jnp.ones_like(bending))
    if settings.reentry == "impossible":
        traced &= mediums != media.AMBIENT
    return Children(
        live=Live(
            states,
            join(live.rays, live.rays),
            join(live.segments, live.segments),
            None if live.media is None else mediums,
        ),
        media=mediums,
        parts=join(sides.part, sides.part),
        exists=join(bending, bending) & (jnp.max(states.throughput, axis=-1) > 0.0),
        traced=traced,
    )


def store_segments(
    tree: PathTree, children: Children, capacities: Capacities
) -> tuple[PathTree, Children]:
    """Stores the segments of children; drops the weakest children if the buffer is full.

    Without stored segments only their number counts, with the same limit.
    """
    live = children.live
    left = capacities.segments - tree.segments.count
    kept = path_tree.strongest(children.exists, jnp.max(live.throughput, axis=-1), left)
    log, logged = tree.segments, None
    if log.items is not None:
        logged = _segments(live.state, live.segments, children.media, children.parts)
        index = log.count + jnp.cumsum(kept, dtype=jnp.int32) - 1
        children = children._replace(live=live._replace(segments=index))
    log = path_tree.append(log, logged, kept)
    dropped = path_tree.add_dropped(
        tree.dropped, live.rays, live.throughput, children.exists & ~kept
    )
    return tree._replace(segments=log, dropped=dropped), children._replace(exists=kept)


def _segments(
    state: RayState,
    parents: Int[Array, " n"] | None,
    media: Int[Array, " n"],
    parts: Int[Array, " n"],
) -> Segments:
    """Returns the current segments of rays."""
    parents = cast(Array, parents)
    line = state.point, state.direction, state.tau
    return Segments(parents, *line, media, parts, state.differential)


def _last_segments(live: Live) -> LastSegments | None:
    """Returns the current segments of rays, if no others are stored."""
    if live.media is None:
        return None
    state = live.state
    return LastSegments(state.point, state.direction, state.tau, live.media, state.differential)


def push_or_end(
    tree: PathTree, stack: Queue, children: Children, settings: PathSettings
) -> tuple[PathTree, Queue]:
    """Pushes children on the stack, and ends those that are not traced further.

    The latter are the paper's first reflections, and rays that cannot hit an object again.
    """
    live = children.live
    if settings.reflections == "first" or settings.reentry == "impossible":
        escapes = (settings.reentry == "impossible") & (children.media == media.AMBIENT)
        status = jnp.where(escapes, PathStatus.ESCAPED, PathStatus.NOT_TRACED).astype(jnp.int32)
        tree = end(tree, live, status, children.exists & ~children.traced)
    return tree, path_tree.append(stack, live, children.exists & children.traced)


def end_by(
    settings: PathSettings,
    tree: PathTree,
    live: Live,
    status: Int[Array, " n"],
    ending: Bool[Array, " n"],
    stop: Stop | None,
) -> PathTree:
    """Ends some rays as paths; the throughput of paths that the settings make black is dropped."""
    throughput = jax.vmap(functools.partial(path_step.contribution, settings))(
        live.throughput, status
    )
    dropped = path_tree.add_dropped(tree.dropped, live.rays, live.throughput - throughput, ending)
    live = live._replace(state=live.state._replace(throughput=throughput))
    return end(tree._replace(dropped=dropped), live, status, ending, stop=stop)


def end(
    tree: PathTree,
    live: Live,
    status: Int[Array, " n"],
    ending: Bool[Array, " n"],
    *,
    stop: Stop | None = None,
) -> PathTree:
    """Ends some rays as paths, on opaque surfaces if stops are given."""
    like = tree.ends.items.stop
    if like is not None and stop is None:
        tau = jnp.full_like(live.state.tau, jnp.inf)
        stop = Stop(tau, None if like.radiance is None else jnp.zeros_like(live.throughput))
    state, last = live.state, _last_segments(live)
    block = Ends(live.segments, live.rays, live.throughput, state.num_bends, status, stop, last)
    return tree._replace(ends=path_tree.append(tree.ends, block, ending))


class _Walk(NamedTuple):
    """State of the loop.

    Attributes:
      stack: rays to be cast later.
      next: block of rays to be cast next.
      tree: path tree so far.
    """

    stack: Queue
    next: Queue
    tree: PathTree


def follow(
    scene: Scene,
    rays: Rays,
    interior_list: Int[Array, "rays slots"],
    *,
    settings: PathSettings,
    footprint: Footprint = "cone",
    block: int | None = None,
    segments: StoredSegments = "all",
) -> PathTree:
    """Traces each ray along all branches; every child has one bend more than its parent.

    Args:
      scene: the scene.
      rays: any number of camera rays; each of them three times, for red, green and blue, in a scene
        with dispersion.
      interior_list: interior list of each camera (see `media.empty_interior_list`).
      settings: path settings, with at least one bend.
      footprint: `differential` carries derivatives across the pixel.
      block: number of rays cast per iteration; by default what suits the platform.
      segments: segments to store, `all` or the `last` one of each path.
    """
    return _follow(settings, footprint, block, segments, scene, rays, interior_list)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2, 3))
def _follow(
    settings: PathSettings,
    footprint: Footprint,
    block: int | None,
    segments: StoredSegments,
    scene: Scene,
    rays: Rays,
    interior_list: Int[Array, "rays slots"],
) -> PathTree:
    kind = _Kind(settings, footprint, segments)
    if block is not None:
        return _in_blocks(scene, rays, interior_list, kind, block)
    return _as_platform_likes(scene, rays, interior_list, kind=kind)


class _Kind(NamedTuple):
    """What is traced, and what is kept of it; arguments of `follow`."""

    settings: PathSettings
    footprint: Footprint
    segments: StoredSegments = "all"


def _in_blocks(
    scene: Scene,
    rays: Rays,
    interior_list: Int[Array, "rays slots"],
    kind: _Kind,
    block: int,
) -> PathTree:
    count = rays.radii.shape[0]
    block = max(1, min(block, count))
    capacities = _capacities(kind.settings, count, block)
    walk = _begin(scene, rays, interior_list, kind, block, capacities)
    return _trace_remaining(scene, walk, kind.settings, block, capacities).tree


def _capacities(settings: PathSettings, count: int, block: int) -> Capacities:
    """Returns the capacities for some rays, without what their stack cannot fill.

    Each iteration pushes at most `2 * block` children. While some of them are on the stack, all
    that are pushed above them have more bends than the ones with the fewest bends among them. So
    there are never more such groups than bends, above the camera rays.
    """
    capacities = path_settings.capacities(settings, count)
    most = count + 2 * block * settings.max_bends
    return capacities._replace(live=min(capacities.live, most))


def _in_cached_blocks(
    scene: Scene,
    rays: Rays,
    interior_list: Int[Array, "rays slots"],
    *,
    kind: _Kind,
) -> PathTree:
    return _in_blocks(scene, rays, interior_list, kind, _BLOCK_ON_CPU)


def _at_once(
    scene: Scene,
    rays: Rays,
    interior_list: Int[Array, "rays slots"],
    *,
    kind: _Kind,
) -> PathTree:
    """Traces all rays as one block, with lists as long as those of `_in_cached_blocks`."""
    tree = _in_blocks(scene, rays, interior_list, kind, _BLOCK)
    like = _empty(scene, rays, interior_list, kind=kind)
    return jax.tree.map(lambda x, y: x[: y.shape[0]] if y.ndim else x, tree, like)


def _empty(
    scene: Scene,
    rays: Rays,
    interior_list: Int[Array, "rays slots"],
    *,
    kind: _Kind,
) -> PathTree:
    """Returns the path tree of `_in_cached_blocks` before any ray is cast."""
    count = rays.radii.shape[0]
    block = max(1, min(_BLOCK_ON_CPU, count))
    capacities = _capacities(kind.settings, count, block)
    return _begin(scene, rays, interior_list, kind, block, capacities).tree


_as_platform_likes = chosen_by_platform(
    "follow_light_paths", cpu=_in_cached_blocks, default=_at_once, like=_empty
)


def _trace_remaining(
    scene: Scene,
    walk: _Walk,
    settings: PathSettings,
    block: int,
    capacities: Capacities,
) -> _Walk:
    """Casts blocks until no rays are left."""

    def more(walk: _Walk) -> Bool[Array, ""]:
        return walk.next.count > 0

    def fits(walk: _Walk) -> Bool[Array, ""]:
        return (walk.stack.count <= capacities.live) & (walk.tree.ends.count <= capacities.paths)

    def advance(walk: _Walk) -> _Walk:
        walk = jax.lax.while_loop(
            lambda walk: more(walk) & fits(walk),
            lambda walk: _trace_block(scene, walk, settings, block, capacities),
            walk,
        )
        stack, dropped = path_tree.drop_weakest(walk.stack, walk.tree.dropped, capacities.live)
        ends, dropped = path_tree.drop_weakest(walk.tree.ends, dropped, capacities.paths)
        return _Walk(stack, walk.next, walk.tree._replace(ends=ends, dropped=dropped))

    return jax.lax.while_loop(more, advance, walk)


@_follow.defjvp
def _refuse_gradients(
    settings: PathSettings,
    footprint: Footprint,
    block: int | None,
    segments: StoredSegments,
    primals: object,
    tangents: object,
) -> NoReturn:
    del settings, footprint, block, segments, primals, tangents
    raise TypeError(
        "Light paths of trace have no derivatives with respect to rays or the scene. Use "
        "follow_branch or follow_main_branches, or hold rays and the scene constant with "
        "jax.lax.stop_gradient."
    )


def _no_stop(scene: Scene, state: RayState) -> Stop | None:
    """Returns stops for a list of paths that end nowhere; none without opaque parts."""
    if not media.has_opaque(scene.interfaces):
        return None
    known = media.meshes_of(scene).radiance.shape[0] > 0
    return Stop(
        jnp.full_like(state.tau, jnp.inf), jnp.zeros_like(state.throughput) if known else None
    )


def _begin(
    scene: Scene,
    rays: Rays,
    interior_list: Int[Array, "rays slots"],
    kind: _Kind,
    block: int,
    capacities: Capacities,
) -> _Walk:
    """Pushes the camera rays on the stack and stores their segments."""
    count = rays.radii.shape[0]
    order = jnp.arange(count, dtype=jnp.int32)
    differential = jax.vmap(lambda ray: light_paths.begin_differential(ray, kind.footprint))(rays)
    state = jax.vmap(path_step.begin)(rays, interior_list, differential)
    if media.has_dispersion(scene.interfaces):  # three rays follow each other, one per channel
        channels = jnp.eye(3, dtype=state.throughput.dtype)
        state = state._replace(throughput=channels[order % 3])
    ambient = jnp.full_like(order, media.AMBIENT)
    live, segments = Live(state, order, None, ambient), None
    if kind.segments == "all":
        first, nowhere = jnp.full_like(order, NO_SEGMENT), jnp.full_like(order, media.EMPTY_SLOT)
        live, segments = Live(state, order, order), _segments(state, first, ambient, nowhere)
    stop, last = _no_stop(scene, state), _last_segments(live)
    ends = Ends(live.segments, order, state.throughput, order, order, stop, last)
    # Each buffer has slots beyond its capacity for the records that one iteration may append.
    tree = PathTree(
        segments=path_tree.fill(segments, count, capacities.segments + 2 * block),
        ends=path_tree.fill(ends, 0, capacities.paths + 3 * block),
        dropped=jnp.zeros_like(rays.origins),
        casts=jnp.zeros((), jnp.int32),
    )
    stack = path_tree.fill(live, count, capacities.live + 2 * block)
    return _Walk(*path_tree.pop(stack, block), tree)


def _trace_block(
    scene: Scene, walk: _Walk, settings: PathSettings, block: int, capacities: Capacities
) -> _Walk:
    """Casts one block, ends paths, and pushes the children on the stack."""
    live, alive = walk.next.items, jnp.arange(block, dtype=jnp.int32) < walk.next.count
    hits = _cast(scene, live.state, alive)
    arrive = jax.vmap(path_step.arrive, in_axes=(None, 0, 0))
    arrival = arrive(scene, live.state, hits.primitive_ids)
    hit = alive & jnp.isfinite(hits.distances)
    status = jax.vmap(functools.partial(path_step.end_status, settings))(live.state, arrival, hit)
    bending = hit & (status == PathStatus.EMPTY)
    tree = walk.tree._replace(casts=walk.tree.casts + jnp.sum(alive, dtype=jnp.int32))
    medium = arrival.interaction.sides.medium_near
    # The medium of a camera is known only from the first surface it sees.
    seen = hit & (live.state.num_bends == 0)
    if live.media is None:
        tree = path_tree.set_media(tree, live.segments, medium, seen)
    else:
        live = live._replace(media=jnp.where(seen, medium, live.media))
    ended, stop = jax.vmap(path_step.stop)(live.state, arrival, status)
    tree = end_by(settings, tree, live._replace(state=ended), status, alive & ~bending, stop)
    branches = jax.vmap(functools.partial(path_step.branch, settings))(
        live.state, arrival, hits.primitive_ids
    )
    children = children_of(live, branches, arrival, bending, settings)
    tree, children = store_segments(tree, children, capacities)
    tree, stack = push_or_end(tree, walk.stack, children, settings)
    return _Walk(*path_tree.pop(stack, block), tree)


def _cast(scene: Scene, state: RayState, alive: Bool[Array, " block"]) -> bvh.Hits:
    return bvh.closest_hits(
        media.meshes_of(scene).bvh,
        Rays(state.origin, state.direction, jnp.zeros_like(state.tau)),
        limits=jnp.where(alive, jnp.inf, -1.0).astype(state.tau.dtype),
        exclude_primitive=state.exclude_primitive,
    )
