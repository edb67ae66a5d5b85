"""The branches of a block of rays: which there are, their segments, and where they go next.

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


class Children(NamedTuple):
    """The branches of a block, reflected ones first.

    Attributes:
      live: the branches; the index of their segment is their parent's until it is logged.
      media: medium of each one's segment.
      parts: part that each one leaves.
      exists: which there are.
      traced: which are followed further.
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
    """Lists the branches of the rays that bend."""
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


def push(tree: PathTree, stack: Pool, children: Children, budget: Budget) -> tuple[PathTree, Pool]:
    """Puts children on the stack, and ends those that are not traced.

    They are the paper's first reflections, and rays that leave the objects for good.
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
    """Ends some rays as paths; what the budget leaves dark of their light is lost."""
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
