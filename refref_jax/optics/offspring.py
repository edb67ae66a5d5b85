"""Child rays of a block of rays: stores their segments and queues or ends them.

Letters as in `light_paths`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax.optics import branching, media, pools
from refref_jax.optics.branching import Arrival, Branches, RayState
from refref_jax.optics.budgets import Budget, Room
from refref_jax.optics.light_paths import PathStatus
from refref_jax.optics.path_tree import Ends, PathTree, Segments
from refref_jax.optics.pools import Pool


class Live(NamedTuple):
    """Active rays, which are still to be cast.

    Attributes:
      state: states of the rays.
      rays: index of each one's camera ray.
      segments: index of each one's current segment.
    """

    state: RayState
    rays: Int[Array, " live"]
    segments: Int[Array, " live"]

    @property
    def weights(self) -> Float[Array, "live 3"]:
        """Throughputs of the rays."""
        return self.state.weight


class Children(NamedTuple):
    """The child rays of a block, reflected ones first.

    Attributes:
      live: child rays; they have the segment index of their parent until their own is stored.
      media: medium of each child's segment.
      parts: part that each child's segment starts on.
      exists: mask of children with positive weight.
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
    budget: Budget,
) -> Children:
    """Returns the child rays of the rays that bend."""
    sides = arrival.interaction.sides
    states = pools.join(branches.reflected, branches.transmitted)
    mediums = pools.join(sides.medium_near, sides.medium_far)
    untraced = ~arrival.interaction.total & (budget.reflections == "first")
    traced = pools.join(~untraced, jnp.ones_like(bending))
    if budget.reentry == "impossible":
        traced &= mediums != media.AMBIENT
    return Children(
        live=Live(
            states, pools.join(live.rays, live.rays), pools.join(live.segments, live.segments)
        ),
        media=mediums,
        parts=pools.join(sides.part, sides.part),
        exists=pools.join(bending, bending) & (jnp.max(states.weight, axis=-1) > 0.0),
        traced=traced,
    )


def log(tree: PathTree, children: Children, room: Room) -> tuple[PathTree, Children]:
    """Stores the segments of children; drops the weakest children if the buffer is full."""
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


def push(tree: PathTree, stack: Pool, children: Children, budget: Budget) -> tuple[PathTree, Pool]:
    """Pushes children on the stack, and ends those that are not traced further.

    The latter are the paper's first reflections, and rays that cannot hit an object again.
    """
    live = children.live
    if budget.reflections == "first" or budget.reentry == "impossible":
        escapes = (budget.reentry == "impossible") & (children.media == media.AMBIENT)
        status = jnp.where(escapes, PathStatus.ESCAPED, PathStatus.NOT_TRACED).astype(jnp.int32)
        tree = end(tree, live, status, children.exists & ~children.traced)
    return tree, pools.append(stack, live, children.exists & children.traced)


def end_by(
    budget: Budget,
    tree: PathTree,
    live: Live,
    status: Int[Array, " n"],
    ending: Bool[Array, " n"],
) -> PathTree:
    """Ends some rays as paths; the weight of paths that the settings make black is dropped."""
    weights = jax.vmap(functools.partial(branching.shown, budget))(live.weights, status)
    lost = pools.lose(tree.lost, live.rays, live.weights - weights, ending)
    live = live._replace(state=live.state._replace(weight=weights))
    return end(tree._replace(lost=lost), live, status, ending)


def end(
    tree: PathTree, live: Live, status: Int[Array, " n"], ending: Bool[Array, " n"]
) -> PathTree:
    """Ends some rays as paths."""
    block = Ends(live.segments, live.rays, live.weights, live.state.bends, status)
    return tree._replace(ends=pools.append(tree.ends, block, ending))
