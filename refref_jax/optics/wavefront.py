"""Follows rays through the objects along all branches of their paths: the wavefront.

Rays that are still to be cast lie on a stack. Every round takes a block off its top and casts it:
a ray that meets nothing ends as a path; one that meets a surface leaves its reflected and its
transmitted child on the stack, as the budget has it. So a block is full until the very end,
however few rays go deep, and children are followed before their elders: the stack stays low.

Every segment of a path is logged once, with a pointer to the segment before it; a path is known by
its last one.

Where any list outgrows its capacity, the least throughput is dropped, and each ray's loss is
returned: the weights of a ray's paths and its loss sum to the light that went in, less what tints
and absorption took.

Letters as in `light_paths`. Source: paper (arXiv 2505.05848), section 4.2, for what happens at a
surface.
"""

import functools
import math
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.geometry import bvh, surfaces
from refref_jax.geometry.rays import Rays
from refref_jax.optics import interaction, media, pools, splitting
from refref_jax.optics.budgets import Budget
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.path_tree import NO_SEGMENT, Ends, PathTree, Segments
from refref_jax.optics.pools import Pool

_Items = TypeVar("_Items")

BLOCK = 8192
"""Rays cast in a round. A larger one serves an accelerator, at the price of memory."""


class Geometry(NamedTuple):
    """All that light meets: surfaces, and the interfaces that they stand for."""

    surfaces: surfaces.Surfaces
    interfaces: media.Interfaces


class _Live(NamedTuple):
    """Rays that are to be cast.

    Attributes:
      origins: where to cast from, just off the surface.
      points: start of the current segment, on the surface.
      directions: unit.
      tau: arc length at the start.
      weights: throughput.
      rays: index of the camera ray.
      bends: number of bends so far.
      leaving: triangle slot that the segment starts on.
      inside: the parts that the ray is in (see `media`).
      segments: index of the current segment.
    """

    origins: Float[Array, "live 3"]
    points: Float[Array, "live 3"]
    directions: Float[Array, "live 3"]
    tau: Float[Array, " live"]
    weights: Float[Array, "live 3"]
    rays: Int[Array, " live"]
    bends: Int[Array, " live"]
    leaving: Int[Array, " live"]
    inside: Int[Array, "live slots"]
    segments: Int[Array, " live"]


class _Met(NamedTuple):
    """What a block of rays meets.

    Attributes:
      interaction: what the surfaces do.
      length: of the segments that end there.
      kept: what is left of the light by the medium on the way and by the surface's tint.
    """

    interaction: interaction.Interaction
    length: Float[Array, " block"]
    kept: Float[Array, "block 3"]


class _Room(NamedTuple):
    """Most records that each list keeps."""

    live: int
    segments: int
    paths: int


class _Walk(NamedTuple):
    """State of the loop."""

    stack: Pool[_Live]
    tree: PathTree


class _Children(NamedTuple):
    """The branches of a block, reflected ones first.

    Attributes:
      live: their states; the index of the segment is not known yet.
      media: medium of each one's segment.
      exists: which there are.
      traced: which are followed further.
    """

    live: _Live
    media: Int[Array, " branches"]
    exists: Bool[Array, " branches"]
    traced: Bool[Array, " branches"]


def follow(
    geometry: Geometry,
    rays: Rays,
    inside: Int[Array, "rays slots"],
    *,
    budget: Budget,
    block: int = BLOCK,
) -> PathTree:
    """Follows each ray along all branches of a budget.

    The loop ends, since every child has one bend more than its parent.

    Args:
      geometry: the scene.
      rays: any number of camera rays.
      inside: the parts that each camera is in (see `media.nowhere`).
      budget: which light to follow, with at least one bend.
      block: rays cast in a round.
    """
    return _follow(budget, block, geometry, rays, inside)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _follow(
    budget: Budget, block: int, geometry: Geometry, rays: Rays, inside: Int[Array, "rays slots"]
) -> PathTree:
    count = rays.radii.shape[0]
    block = max(1, min(block, count))
    room = _room(budget, count)

    def fits(walk: _Walk) -> Bool[Array, ""]:
        return (walk.stack.count <= room.live) & (walk.tree.ends.count <= room.paths)

    def advance(walk: _Walk) -> _Walk:
        """Goes on round by round until there is too much of something, or all is done."""
        walk = jax.lax.while_loop(
            lambda walk: (walk.stack.count > 0) & fits(walk),
            lambda walk: _round(geometry, walk, budget, block, room),
            walk,
        )
        stack, lost = pools.shed(walk.stack, walk.tree.lost, room.live)
        ends, lost = pools.shed(walk.tree.ends, lost, room.paths)
        return _Walk(stack, walk.tree._replace(ends=ends, lost=lost))

    start = _begin(rays, inside, block, room)
    return jax.lax.while_loop(lambda walk: walk.stack.count > 0, advance, start).tree


@_follow.defjvp
def _refuse_gradients(budget: Budget, block: int, primals: object, tangents: object) -> None:
    del budget, block, primals, tangents
    raise TypeError(
        "Light paths of the wavefront have no derivatives with respect to rays or geometry: they "
        "would be silently wrong. Use optics.single_path for these, or hold rays and geometry "
        "constant with jax.lax.stop_gradient."
    )


def _begin(rays: Rays, inside: Int[Array, "rays slots"], block: int, room: _Room) -> _Walk:
    """Puts the camera rays on the stack and their segments into the log."""
    count = rays.radii.shape[0]
    integers = jnp.arange(count, dtype=jnp.int32)
    zeros = jnp.zeros_like(rays.radii)
    ambient = jnp.full(count, media.AMBIENT, jnp.int32)
    live = _Live(
        origins=rays.origins,
        points=rays.origins,
        directions=rays.directions,
        tau=zeros,
        weights=jnp.ones_like(rays.origins),
        rays=integers,
        bends=jnp.zeros_like(integers),
        leaving=jnp.full(count, bvh.NO_SLOT, jnp.int32),
        inside=inside,
        segments=integers,
    )
    first = jnp.full(count, NO_SEGMENT, jnp.int32)
    segments = Segments(first, rays.origins, rays.directions, zeros, ambient)
    ends = Ends(integers, integers, live.weights, live.bends, integers)
    # Beyond its capacity each list has room for what one round may append.
    tree = PathTree(
        segments=_pool(segments, count, room.segments + 2 * block),
        ends=_pool(ends, 0, room.paths + 3 * block),
        lost=jnp.zeros_like(rays.origins),
        casts=jnp.zeros((), jnp.int32),
    )
    return _Walk(_pool(live, count, room.live + 2 * block), tree)


def _room(budget: Budget, rays: int) -> _Room:
    return _Room(
        live=math.ceil(rays * budget.live_per_ray),
        segments=math.ceil(rays * (1.0 + budget.segments_per_ray)),
        paths=math.ceil(rays * budget.paths_per_ray),
    )


def _pool(items: NamedTuple, count: int, slots: int) -> Pool:
    """Returns a pool with some slots of which the first hold the records given."""

    def pad(x: Array) -> Array:
        return jnp.concatenate([x, jnp.zeros((slots - x.shape[0], *x.shape[1:]), x.dtype)])

    return Pool(jax.tree.map(pad, items), jnp.int32(count))


def _round(geometry: Geometry, walk: _Walk, budget: Budget, block: int, room: _Room) -> _Walk:
    """Casts one block, ends paths, and puts the children on the stack."""
    start = jnp.maximum(walk.stack.count - block, 0)
    live = jax.tree.map(
        lambda x: jax.lax.dynamic_slice_in_dim(x, start, block, 0), walk.stack.items
    )
    alive = start + jnp.arange(block) < walk.stack.count
    hits = bvh.closest_hits(
        geometry.surfaces.bvh,
        Rays(live.origins, live.directions, jnp.zeros_like(live.tau)),
        limits=jnp.where(alive, jnp.inf, -1.0).astype(live.tau.dtype),
        leaving=live.leaving,
    )
    hit = alive & jnp.isfinite(hits.distances)
    met = _meet(geometry, live, hits)
    status = _status(live, met, hit, budget)
    bending = hit & (status == PathStatus.EMPTY)
    tree = walk.tree._replace(casts=walk.tree.casts + jnp.sum(alive, dtype=jnp.int32))
    tree = _name_first_medium(tree, live, met, hit)
    tree = _end(tree, live, status, alive & ~bending)
    tree, children = _log(tree, _branch(live, met, hits.slots, bending, budget), room)
    return _push(tree, Pool(walk.stack.items, start), children, budget)


def _meet(geometry: Geometry, live: _Live, hits: bvh.Hits) -> _Met:
    """Returns what the next surfaces do to rays; without meaning for those that meet nothing."""

    def meet_one(
        direction: Array, inside: Array, point: Array, slot: Array, barycentric: Array
    ) -> _Met:
        surface = surfaces.surface_point(geometry.surfaces, slot, barycentric)
        met = interaction.meet(surface, geometry.interfaces, inside, direction)
        length = numerics.length(met.position - point)
        passed = media.transmittance(geometry.interfaces, met.sides.medium_near, length)
        return _Met(met, length, passed * met.sides.tint)

    return jax.vmap(meet_one)(
        live.directions, live.inside, live.points, hits.slots, hits.barycentrics
    )


def _status(
    live: _Live, met: _Met, hit: Bool[Array, " block"], budget: Budget
) -> Int[Array, " block"]:
    """Returns how paths end that end here; `EMPTY` for those that bend."""
    missed = jnp.where(live.bends > 0, PathStatus.ESCAPED, PathStatus.MISSED)
    met_what = jnp.where(live.bends < budget.bends, PathStatus.EMPTY, PathStatus.OUT_OF_BENDS)
    if budget.total_reflection == "ended":
        met_what = jnp.where(met.interaction.total, PathStatus.TOTALLY_REFLECTED, met_what)
    return jnp.where(hit, met_what, missed).astype(jnp.int32)


def _name_first_medium(
    tree: PathTree, live: _Live, met: _Met, hit: Bool[Array, " block"]
) -> PathTree:
    """Notes the medium of camera rays, which only their first surface tells."""
    log = tree.segments.items
    nowhere = log.media.shape[0]
    target = jnp.where(hit & (live.bends == 0), live.segments, nowhere)
    named = log.media.at[target].set(met.interaction.sides.medium_near, mode="drop")
    return tree._replace(segments=tree.segments._replace(items=log._replace(media=named)))


def _branch(
    live: _Live,
    met: _Met,
    slots: Int[Array, " block"],
    bending: Bool[Array, " block"],
    budget: Budget,
) -> _Children:
    """Returns both branches of every ray; their segment is still their parent's."""
    meeting = met.interaction
    arriving = live.weights * met.kept
    share = jax.vmap(functools.partial(splitting.shares, budget))(
        meeting.reflectance, meeting.total, live.bends == 0, jnp.max(arriving, axis=-1)
    )

    def side(origins: Array, directions: Array, part: Array, inside: Array) -> _Live:
        return live._replace(
            origins=origins,
            points=meeting.position,
            directions=directions,
            tau=live.tau + met.length,
            weights=arriving * part[:, None],
            bends=live.bends + 1,
            leaving=slots,
            inside=inside,
        )

    both = _join(
        side(meeting.restart_reflected, meeting.reflected, share.reflected, live.inside),
        side(
            meeting.restart_transmitted,
            meeting.transmitted,
            share.transmitted,
            meeting.sides.inside_after,
        ),
    )
    everywhere = jnp.ones_like(bending)
    untraced = ~meeting.total & (budget.reflections == "first")
    return _Children(
        live=both,
        media=_join(meeting.sides.medium_near, meeting.sides.medium_far),
        exists=_join(bending, bending) & (jnp.max(both.weights, axis=-1) > 0.0),
        traced=_join(~untraced, everywhere),
    )


def _join(first: _Items, second: _Items) -> _Items:
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)


def _log(tree: PathTree, children: _Children, room: _Room) -> tuple[PathTree, _Children]:
    """Logs the segments of children; drops the weakest of them if the log is full."""
    live = children.live
    left = room.segments - tree.segments.count
    kept = pools.strongest(children.exists, jnp.max(live.weights, axis=-1), left)
    index = tree.segments.count + jnp.cumsum(kept, dtype=jnp.int32) - 1
    logged = Segments(live.segments, live.points, live.directions, live.tau, children.media)
    tree = tree._replace(
        segments=pools.append(tree.segments, logged, kept),
        lost=pools.lose(tree.lost, live.rays, live.weights, children.exists & ~kept),
    )
    return tree, children._replace(live=live._replace(segments=index), exists=kept)


def _push(tree: PathTree, stack: Pool[_Live], children: _Children, budget: Budget) -> _Walk:
    """Puts children on the stack, and ends those that are not traced."""
    live = children.live
    if budget.reflections == "first":
        status = jnp.full_like(live.rays, PathStatus.NOT_TRACED)
        tree = _end(tree, live, status, children.exists & ~children.traced)
    return _Walk(pools.append(stack, live, children.exists & children.traced), tree)


def _end(
    tree: PathTree, live: _Live, status: Int[Array, " n"], ending: Bool[Array, " n"]
) -> PathTree:
    """Ends some rays as paths."""
    block = Ends(live.segments, live.rays, live.weights, live.bends, status)
    return tree._replace(ends=pools.append(tree.ends, block, ending))
