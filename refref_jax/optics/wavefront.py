"""Wavefront path tracing of rays along all branches of their paths.

Rays still to be cast are on a stack. Every iteration pops a block of rays and casts it: a ray that
hits nothing ends as a path; for a ray that hits a surface, the reflected and transmitted children
that the path settings follow are pushed on the stack. Blocks are therefore full until near the end,
even if few paths are deep. Children are traced before their parents' siblings (depth first), which
keeps the stack small.

Every segment of a path is stored once, with a pointer to its parent segment; a path is identified
by its last segment.

If a buffer exceeds its capacity, its records of least throughput are dropped, and the dropped
throughput of each ray is returned: the weights of a ray's paths and its dropped throughput sum to
1, minus absorption by tints and media.

Letters as in `light_paths`. Source: paper (arXiv 2505.05848), section 4.2, for the interaction
with surfaces.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from refref_jax.choices import Footprint
from refref_jax.geometry import bvh
from refref_jax.geometry.rays import Rays
from refref_jax.optics import branching, budgets, footprints, media, offspring, path_tree, pools
from refref_jax.optics.branching import RayState
from refref_jax.optics.budgets import Budget, Room
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.offspring import Live
from refref_jax.optics.path_tree import NO_SEGMENT, Ends, PathTree, Segments
from refref_jax.optics.pools import Pool
from refref_jax.optics.scene import Scene

BLOCK = 4096
"""Number of rays cast per iteration. Accelerators benefit from more, at the cost of memory."""

# From this number of blocks, the last rays are cast in smaller blocks, by a second compiled loop.
_MANY_BLOCKS = 6

# Ratio of the two block sizes; blocks of fewer rays than this have no second loop.
_SMALLER = 16


class _Walk(NamedTuple):
    """State of the loop.

    Attributes:
      stack: rays to be cast later.
      next: block of rays to be cast next.
      tree: path tree so far.
    """

    stack: Pool
    next: Pool
    tree: PathTree


def follow(
    geometry: Scene,
    rays: Rays,
    inside: Int[Array, "rays slots"],
    *,
    budget: Budget,
    footprint: Footprint = "cone",
    block: int = BLOCK,
) -> PathTree:
    """Traces each ray along all branches; every child has one bend more than its parent.

    Args:
      geometry: the scene.
      rays: any number of camera rays.
      inside: interior list of each camera (see `media.nowhere`).
      budget: path settings, with at least one bend.
      footprint: `differential` carries derivatives across the pixel.
      block: number of rays cast per iteration.
    """
    return _follow(budget, footprint, block, geometry, rays, inside)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2))
def _follow(
    budget: Budget,
    footprint: Footprint,
    block: int,
    geometry: Scene,
    rays: Rays,
    inside: Int[Array, "rays slots"],
) -> PathTree:
    count = rays.radii.shape[0]
    block = max(1, min(block, count))
    room = budgets.room(budget, count)
    walk = _begin(rays, inside, footprint, block, room)
    if count < _MANY_BLOCKS * block or block < _SMALLER:
        return _work_off(geometry, walk, budget, block, room, least=1).tree
    # Otherwise the few deepest rays would cast a full block in each iteration.
    walk = _work_off(geometry, walk, budget, block, room, least=block // 4)
    stack = pools.append(
        walk.stack, walk.next.items, jnp.arange(block, dtype=jnp.int32) < walk.next.count
    )
    small = block // _SMALLER
    walk = _Walk(*pools.pop(stack, small), walk.tree)
    return _work_off(geometry, walk, budget, small, room, least=1).tree


def _work_off(
    geometry: Scene, walk: _Walk, budget: Budget, block: int, room: Room, *, least: int
) -> _Walk:
    """Casts blocks until fewer than `least` rays are left."""

    def unfinished(walk: _Walk) -> Bool[Array, ""]:
        return walk.next.count + walk.stack.count >= least

    def fits(walk: _Walk) -> Bool[Array, ""]:
        return (walk.stack.count <= room.live) & (walk.tree.ends.count <= room.paths)

    def advance(walk: _Walk) -> _Walk:
        walk = jax.lax.while_loop(
            lambda walk: unfinished(walk) & fits(walk),
            lambda walk: _round(geometry, walk, budget, block, room),
            walk,
        )
        stack, lost = pools.shed(walk.stack, walk.tree.lost, room.live)
        ends, lost = pools.shed(walk.tree.ends, lost, room.paths)
        return _Walk(stack, walk.next, walk.tree._replace(ends=ends, lost=lost))

    return jax.lax.while_loop(unfinished, advance, walk)


@_follow.defjvp
def _refuse_gradients(
    budget: Budget, footprint: Footprint, block: int, primals: object, tangents: object
) -> None:
    del budget, footprint, block, primals, tangents
    raise TypeError(
        "Light paths of trace have no derivatives with respect to rays or geometry. Use "
        "follow_branch or follow_main_branches, or hold rays and geometry constant with "
        "jax.lax.stop_gradient."
    )


def _begin(
    rays: Rays, inside: Int[Array, "rays slots"], footprint: Footprint, block: int, room: Room
) -> _Walk:
    """Pushes the camera rays on the stack and stores their segments."""
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
    # Each buffer has slots beyond its capacity for the records that one iteration may append.
    tree = PathTree(
        segments=pools.fill(segments, count, room.segments + 2 * block),
        ends=pools.fill(ends, 0, room.paths + 3 * block),
        lost=jnp.zeros_like(rays.origins),
        casts=jnp.zeros((), jnp.int32),
    )
    stack = pools.fill(Live(state, order, order), count, room.live + 2 * block)
    return _Walk(*pools.pop(stack, block), tree)


def _round(geometry: Scene, walk: _Walk, budget: Budget, block: int, room: Room) -> _Walk:
    """Casts one block, ends paths, and pushes the children on the stack."""
    live, alive = walk.next.items, jnp.arange(block, dtype=jnp.int32) < walk.next.count
    hits = _cast(geometry, live.state, alive)
    arrive = jax.vmap(branching.arrive, in_axes=(None, 0, 0))
    arrival = arrive(geometry, live.state, hits.slots)
    hit = alive & jnp.isfinite(hits.distances)
    status = jax.vmap(functools.partial(branching.ending, budget))(live.state, arrival, hit)
    bending = hit & (status == PathStatus.EMPTY)
    tree = walk.tree._replace(casts=walk.tree.casts + jnp.sum(alive, dtype=jnp.int32))
    medium = arrival.interaction.sides.medium_near
    # The medium of a camera is known only from the first surface it sees.
    tree = path_tree.name_media(tree, live.segments, medium, hit & (live.state.bends == 0))
    tree = offspring.end_by(budget, tree, live, status, alive & ~bending)
    branches = jax.vmap(functools.partial(branching.branch, budget))(
        live.state, arrival, hits.slots
    )
    children = offspring.children_of(live, branches, arrival, bending, budget)
    tree, children = offspring.log(tree, children, room)
    tree, stack = offspring.push(tree, walk.stack, children, budget)
    return _Walk(*pools.pop(stack, block), tree)


def _cast(geometry: Scene, state: RayState, alive: Bool[Array, " block"]) -> bvh.Hits:
    return bvh.closest_hits(
        geometry.surfaces.bvh,
        Rays(state.origin, state.direction, jnp.zeros_like(state.tau)),
        limits=jnp.where(alive, jnp.inf, -1.0).astype(state.tau.dtype),
        leaving=state.leaving,
    )
