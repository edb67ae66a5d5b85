"""One light path, differentiable: the scan.

The same steps as the wavefront's, for one ray along one branch of its tree. Which triangles are met
is found without gradients; where each is met is computed anew from its corners. So positions,
directions, arc lengths and weights of a path have gradients with respect to indices of refraction,
tints, absorption, corners, normals and the ray.

The gradient is that of this path as it is: the same triangles in the same order, and the same
branches. It does not see that light moves to another triangle or falls below the cut. At the
critical angle refraction and reflectance have a gradient that grows without bound; at it and
beyond it the derivatives of the refracted ray are 0 (see `snell.transmission`), and those of the
totally reflected ray are its own.

Source: paper (arXiv 2505.05848), section 4.2. Letters as in `light_paths`.
"""

import functools
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from refref_jax.geometry.bvh import NO_SLOT
from refref_jax.geometry.closest_hit import closest_slot
from refref_jax.geometry.rays import Rays
from refref_jax.optics import branching, footprints, media, scene
from refref_jax.optics.branching import RayState
from refref_jax.optics.budgets import Budget
from refref_jax.optics.light_paths import LightPaths, PathStatus
from refref_jax.optics.scene import Scene

_Record = TypeVar("_Record")


class _Segment(NamedTuple):
    """One segment of the path.

    Attributes:
      state: the ray on it.
      medium: it runs through; known from the surface at its end, or else from the one before.
      used: whether the path comes so far.
    """

    state: RayState
    medium: Int[Array, ""]
    used: Bool[Array, ""]


class _Walk(NamedTuple):
    """State of the scan.

    Attributes:
      state: the ray.
      medium: that it is in, as far as its last surface tells.
      traced: whether it is to be cast; not the paper's first reflection, nor without any bends.
      status: `EMPTY` as long as the path goes on.
    """

    state: RayState
    medium: Int[Array, ""]
    traced: Bool[Array, ""]
    status: Int[Array, ""]


def follow_branch(
    geometry: Scene,
    ray: Rays,
    reflects: Bool[Array, " bends"],
    *,
    budget: Budget,
    inside: Int[Array, " slots"] | None = None,
) -> LightPaths:
    """Follows one ray along one branch.

    Args:
      geometry: the scene.
      ray: one camera ray.
      reflects: for each bend whether to take the reflected branch; where reflection is total it is
        taken in any case. All false is the main path.
      budget: which light to follow; its `bends` must be the number of `reflects`.
      inside: the parts that the camera is in, for the rule `priority` (see `media`).

    Returns:
      One path. Its weight is 0 where the budget does not follow the branch: where its light went
      to the sibling.

    Raises:
      ValueError: if `reflects` has not one entry a bend.

    Example:
      What a plane of glass lets through, and how that changes with the index `n`: the share is
      `4 n / (n + 1)^2`, its derivative `4 (1 - n) / (n + 1)^3`.

      >>> import jax, numpy as np, trimesh
      >>> import refref_jax
      >>> glass = refref_jax.single_body(trimesh.creation.box(), index=1.5)
      >>> ray = refref_jax.Rays(np.array([-2.0, 0.1, 0.2]), np.array([1.0, 0.0, 0.0]), 1e-3)
      >>> budget = refref_jax.Budget(bends=1, reflections="all")
      >>> def transmitted(index):
      ...     scene, straight_on = refref_jax.with_index(glass, index), jax.numpy.zeros(1, bool)
      ...     return refref_jax.follow_branch(scene, ray, straight_on, budget=budget).weights[0]
      >>> share, slope = jax.jit(jax.value_and_grad(transmitted))(1.5)
      >>> print(f"{share:.4f} {slope:.4f}")
      0.9600 -0.1280
    """
    if reflects.shape[0] != budget.bends:
        raise ValueError(
            f"There are {reflects.shape[0]} choices for {budget.bends} bends. Give one choice for "
            "each bend of the budget."
        )
    reflects = jnp.asarray(reflects)
    geometry, ray = scene.in_one_precision(geometry, ray)
    if inside is None:
        inside = media.nowhere(geometry.interfaces)
    start = _Walk(
        branching.begin(ray, inside, footprints.nothing(ray.origins)),
        jnp.int32(media.AMBIENT),
        jnp.asarray(budget.bends > 0),
        jnp.int32(PathStatus.EMPTY),
    )
    # One step more than bends: the last one only sees whether the path escapes.
    choices = jnp.append(reflects, False)
    advance = functools.partial(_advance, geometry, budget)
    end, segments = jax.lax.scan(advance, start, choices)
    return _record(budget, ray, end, segments)


def _advance(
    geometry: Scene, budget: Budget, walk: _Walk, reflect: Bool[Array, ""]
) -> tuple[_Walk, _Segment]:
    """Casts the ray; ends the path, or takes one of the two branches."""
    state, alive = walk.state, walk.status == PathStatus.EMPTY
    limit = jnp.where(alive & walk.traced, jnp.inf, -1.0).astype(state.tau.dtype)
    slot = closest_slot(geometry.surfaces.bvh, state.origin, state.direction, limit, state.leaving)
    hit = slot != NO_SLOT
    arrival = branching.arrive(geometry, state, slot)
    ended = jnp.where(
        walk.traced, branching.ending(budget, state, arrival, hit), PathStatus.NOT_TRACED
    )
    status = jnp.where(alive, ended, walk.status).astype(jnp.int32)
    met, sides = arrival.interaction, arrival.interaction.sides
    mirrored = reflect | met.total
    branches = branching.branch(budget, state, arrival, slot)
    bent = _Walk(
        state=_either(mirrored, branches.reflected, branches.transmitted),
        medium=jnp.where(mirrored, sides.medium_near, sides.medium_far),
        traced=~(reflect & ~met.total & (budget.reflections == "first")),
        status=status,
    )
    segment = _Segment(state, jnp.where(hit, sides.medium_near, walk.medium), alive)
    going_on = status == PathStatus.EMPTY
    return _either(going_on, bent, walk._replace(status=status)), segment


def _either(which: Bool[Array, ""], first: _Record, second: _Record) -> _Record:
    return jax.tree.map(lambda a, b: jnp.where(which, a, b), first, second)


def _record(budget: Budget, ray: Rays, end: _Walk, segments: _Segment) -> LightPaths:
    used = segments.used
    tau = jnp.where(used, segments.state.tau, jnp.inf)
    none = jnp.zeros_like(tau, shape=(0,))
    return LightPaths(
        points=segments.state.point,
        directions=segments.state.direction,
        tau=tau,
        ends=jnp.append(tau[1:], jnp.inf),
        spreads=segments.state.spread,
        media=jnp.where(used, segments.medium, media.AMBIENT),
        rays=jnp.zeros_like(end.status),
        weights=branching.shown(budget, end.state.weight, end.status),
        radii=ray.radii,
        bends=end.state.bends,
        statuses=end.status,
        meetings=none,
        passages=none,
    )
