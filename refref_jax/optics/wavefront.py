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
"""Rays cast in a round. A larger one serves an accelerator, at the price of memory."""

# From so many blocks of rays on the last ones are cast in smaller blocks: a second loop to compile.
_MANY_BLOCKS = 6

# How many times smaller; blocks of fewer rays have no such part.
_SMALLER = 16


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
    geometry: Scene,
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
    # The few rays that go deepest would cast a whole block each round.
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
        "Light paths of the wavefront have no derivatives with respect to rays or geometry: they "
        "would be silently wrong. Use follow_branch or follow_main_branches for these, or hold "
        "rays and geometry constant with jax.lax.stop_gradient."
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
    stack = pools.fill(Live(state, order, order), count, room.live + 2 * block)
    return _Walk(*pools.pop(stack, block), tree)


def _round(geometry: Scene, walk: _Walk, budget: Budget, block: int, room: Room) -> _Walk:
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
