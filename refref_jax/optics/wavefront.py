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
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax.geometry import bvh
from refref_jax.geometry.rays import Rays
from refref_jax.optics import branching, budgets, footprints, media, path_tree, pools
from refref_jax.optics.branching import Arrival, Branches, RayState
from refref_jax.optics.branching import Geometry as Geometry
from refref_jax.optics.budgets import Budget, Room
from refref_jax.optics.footprints import Footprint
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.path_tree import NO_SEGMENT, Ends, PathTree, Segments
from refref_jax.optics.pools import Pool

BLOCK = 4096
"""Rays cast in a round. A larger one serves an accelerator, at the price of memory."""


class _Live(NamedTuple):
    """Rays that are to be cast.

    Attributes:
      state: the rays on their way.
      rays: index of each one's camera ray.
      segments: index of its current segment.
    """

    state: RayState
    rays: Int[Array, " live"]
    segments: Int[Array, " live"]

    @property
    def weights(self) -> Float[Array, "live 3"]:
        """The light that they carry."""
        return self.state.weight


class _Children(NamedTuple):
    """The branches of a block, reflected ones first.

    Attributes:
      live: the branches; the index of their segment is their parent's until it is logged.
      media: medium of each one's segment.
      parts: part that each one leaves.
      exists: which there are.
      traced: which are followed further.
    """

    live: _Live
    media: Int[Array, " branches"]
    parts: Int[Array, " branches"]
    exists: Bool[Array, " branches"]
    traced: Bool[Array, " branches"]


class _Walk(NamedTuple):
    """State of the loop.

    Attributes:
      stack: rays that are to be cast later.
      next: the block that is cast next.
      tree: what is known by now.
    """

    stack: Pool
    next: Pool
    tree: PathTree


def follow(
    geometry: Geometry,
    rays: Rays,
    inside: Int[Array, "rays slots"],
    *,
    budget: Budget,
    footprint: Footprint = "cone",
    block: int = BLOCK,
) -> PathTree:
    """Follows each ray along all branches; every child has one bend more than its parent.

    Args:
      geometry: the scene.
      rays: any number of camera rays.
      inside: the parts that each camera is in (see `media.nowhere`).
      budget: which light to follow, with at least one bend.
      footprint: whether to carry derivatives across the pixel.
      block: rays cast in a round.
    """
    return _follow(budget, footprint, block, geometry, rays, inside)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2))
def _follow(
    budget: Budget,
    footprint: Footprint,
    block: int,
    geometry: Geometry,
    rays: Rays,
    inside: Int[Array, "rays slots"],
) -> PathTree:
    count = rays.radii.shape[0]
    block = max(1, min(block, count))
    room = budgets.room(budget, count)

    def fits(walk: _Walk) -> Bool[Array, ""]:
        return (walk.stack.count <= room.live) & (walk.tree.ends.count <= room.paths)

    def advance(walk: _Walk) -> _Walk:
        walk = jax.lax.while_loop(
            lambda walk: (walk.next.count > 0) & fits(walk),
            lambda walk: _round(geometry, walk, budget, block, room),
            walk,
        )
        stack, lost = pools.shed(walk.stack, walk.tree.lost, room.live)
        ends, lost = pools.shed(walk.tree.ends, lost, room.paths)
        return _Walk(stack, walk.next, walk.tree._replace(ends=ends, lost=lost))

    start = _begin(rays, inside, footprint, block, room)
    return jax.lax.while_loop(lambda walk: walk.next.count > 0, advance, start).tree


@_follow.defjvp
def _refuse_gradients(
    budget: Budget, footprint: Footprint, block: int, primals: object, tangents: object
) -> None:
    del budget, footprint, block, primals, tangents
    raise TypeError(
        "Light paths of the wavefront have no derivatives with respect to rays or geometry: they "
        "would be silently wrong. Use optics.single_path for these, or hold rays and geometry "
        "constant with jax.lax.stop_gradient."
    )


def _begin(
    rays: Rays, inside: Int[Array, "rays slots"], footprint: Footprint, block: int, room: Room
) -> _Walk:
    """Puts the camera rays on the stack and their segments into the log."""
    count = rays.radii.shape[0]
    order = jnp.arange(count, dtype=jnp.int32)
    spread = jax.vmap(lambda ray: footprints.begin(ray, footprint))(rays)
    state = jax.vmap(branching.begin)(rays, inside, spread)
    ambient = jnp.full_like(order, media.AMBIENT)
    first = jnp.full_like(order, NO_SEGMENT)
    nowhere = jnp.full_like(order, media.EMPTY_SLOT)
    segments = Segments(
        first, state.point, state.direction, state.tau, ambient, nowhere, state.spread
    )
    ends = Ends(order, order, state.weight, order, order)
    # Beyond its capacity each list has room for what one round may append.
    tree = PathTree(
        segments=pools.fill(segments, count, room.segments + 2 * block),
        ends=pools.fill(ends, 0, room.paths + 3 * block),
        lost=jnp.zeros_like(rays.origins),
        casts=jnp.zeros((), jnp.int32),
    )
    stack = pools.fill(_Live(state, order, order), count, room.live + 2 * block)
    return _Walk(*pools.pop(stack, block), tree)


def _round(geometry: Geometry, walk: _Walk, budget: Budget, block: int, room: Room) -> _Walk:
    """Casts one block, ends paths, and puts the children on the stack."""
    live, alive = walk.next.items, jnp.arange(block, dtype=jnp.int32) < walk.next.count
    hits = _cast(geometry, live.state, alive)
    arrive = jax.vmap(branching.arrive, in_axes=(None, 0, 0))
    arrival = arrive(geometry, live.state, hits.slots)
    hit = alive & jnp.isfinite(hits.distances)
    status = jax.vmap(functools.partial(branching.ending, budget))(live.state, arrival, hit)
    bending = hit & (status == PathStatus.EMPTY)
    tree = walk.tree._replace(casts=walk.tree.casts + jnp.sum(alive, dtype=jnp.int32))
    medium = arrival.interaction.sides.medium_near
    # Only its first surface tells what a camera is in.
    tree = path_tree.name_media(tree, live.segments, medium, hit & (live.state.bends == 0))
    tree = _end(tree, live, status, alive & ~bending)
    branches = jax.vmap(functools.partial(branching.branch, budget))(
        live.state, arrival, hits.slots
    )
    tree, children = _log(tree, _children(live, branches, arrival, bending, budget), room)
    tree, stack = _push(tree, walk.stack, children, budget)
    return _Walk(*pools.pop(stack, block), tree)


def _cast(geometry: Geometry, state: RayState, alive: Bool[Array, " block"]) -> bvh.Hits:
    return bvh.closest_hits(
        geometry.surfaces.bvh,
        Rays(state.origin, state.direction, jnp.zeros_like(state.tau)),
        limits=jnp.where(alive, jnp.inf, -1.0).astype(state.tau.dtype),
        leaving=state.leaving,
    )


def _children(
    live: _Live,
    branches: Branches,
    arrival: Arrival,
    bending: Bool[Array, " block"],
    budget: Budget,
) -> _Children:
    """Lists the branches of the rays that bend."""
    sides = arrival.interaction.sides
    states = pools.join(branches.reflected, branches.transmitted)
    mediums = pools.join(sides.medium_near, sides.medium_far)
    untraced = ~arrival.interaction.total & (budget.reflections == "first")
    traced = pools.join(~untraced, jnp.ones_like(bending))
    if budget.reentry == "impossible":
        traced &= mediums != media.AMBIENT
    return _Children(
        live=_Live(
            states, pools.join(live.rays, live.rays), pools.join(live.segments, live.segments)
        ),
        media=mediums,
        parts=pools.join(sides.part, sides.part),
        exists=pools.join(bending, bending) & (jnp.max(states.weight, axis=-1) > 0.0),
        traced=traced,
    )


def _log(tree: PathTree, children: _Children, room: Room) -> tuple[PathTree, _Children]:
    """Logs the segments of children; drops the weakest of them if the log is full."""
    live = children.live
    left = room.segments - tree.segments.count
    kept = pools.strongest(children.exists, jnp.max(live.weights, axis=-1), left)
    index = tree.segments.count + jnp.cumsum(kept, dtype=jnp.int32) - 1
    state = live.state
    logged = Segments(
        live.segments,
        state.point,
        state.direction,
        state.tau,
        children.media,
        children.parts,
        state.spread,
    )
    log = pools.append(tree.segments, logged, kept)
    lost = pools.lose(tree.lost, live.rays, live.weights, children.exists & ~kept)
    children = children._replace(live=live._replace(segments=index), exists=kept)
    return tree._replace(segments=log, lost=lost), children


def _push(
    tree: PathTree, stack: Pool, children: _Children, budget: Budget
) -> tuple[PathTree, Pool]:
    """Puts children on the stack, and ends those that are not traced."""
    live = children.live
    if budget.reflections == "first" or budget.reentry == "impossible":
        escapes = (budget.reentry == "impossible") & (children.media == media.AMBIENT)
        status = jnp.where(escapes, PathStatus.ESCAPED, PathStatus.NOT_TRACED).astype(jnp.int32)
        tree = _end(tree, live, status, children.exists & ~children.traced)
    return tree, pools.append(stack, live, children.exists & children.traced)


def _end(
    tree: PathTree, live: _Live, status: Int[Array, " n"], ending: Bool[Array, " n"]
) -> PathTree:
    """Ends some rays as paths."""
    block = Ends(live.segments, live.rays, live.weights, live.state.bends, status)
    return tree._replace(ends=pools.append(tree.ends, block, ending))
