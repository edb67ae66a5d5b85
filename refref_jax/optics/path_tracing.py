"""The light paths of batches of rays under a budget.

Rays are followed in one large pool (see `wavefront`); then each batch packs its refracted paths
and the reflections worth keeping into one list of fixed capacity. Rays that miss the objects
have no reflection and take no room for one.

To differentiation, light paths are constants: parameters of fields have gradients along them, but
rays and geometry have none, and asking for one is an error. The loops have no reverse mode, and the
hits that they find are constants besides.

Source: paper (arXiv 2505.05848), section 4.2. Letters as in `light_paths`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.geometry.rays import Rays
from refref_jax.optics.budgets import Budget
from refref_jax.optics.light_paths import LightPaths, PathStatus, straight
from refref_jax.optics.wavefront import Followed, Geometry, follow


class Traced(NamedTuple):
    """Light paths of a batch of rays.

    Attributes:
      paths: the paths.
      dropped: the share of each ray's light that found no room in the list. Its refracted path
        carries it instead, so that weights still sum to 1.
    """

    paths: LightPaths
    dropped: Float[Array, " rays"]


def trace(geometry: Geometry, rays: Rays, *, budget: Budget, capacity: int) -> Traced:
    """Traces one batch of rays.

    Args:
      geometry: the scene.
      rays: camera rays, outside every body.
      budget: which light to follow.
      capacity: room for reflections, at most the number of rays; see `budgets.capacity_for`.
    """
    batch = jax.tree.map(lambda x: x[None], rays)
    traced = trace_batches(geometry, batch, budget=budget, capacity=capacity)
    return jax.tree.map(lambda x: x[0], traced)


def trace_batches(geometry: Geometry, rays: Rays, *, budget: Budget, capacity: int) -> Traced:
    """Traces many batches in one pool, which amortises the latency of the traversal's loop.

    Args:
      geometry: the scene.
      rays: camera rays `[batches, rays]`, outside every body.
      budget: which light to follow.
      capacity: room for reflections in each batch, at most its number of rays.

    Returns:
      The paths of each batch, stacked; `rays` counts within a batch.
    """
    if budget.bends == 0:
        return jax.vmap(lambda batch: Traced(straight(batch), jnp.zeros_like(batch.radii)))(rays)
    return _trace_batches(budget, capacity, geometry, rays)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _trace_batches(budget: Budget, capacity: int, geometry: Geometry, rays: Rays) -> Traced:
    shape = rays.radii.shape
    pool = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rays)
    followed = follow(geometry, pool, bends=budget.bends)
    batches = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), followed)
    return jax.vmap(lambda batch: pack(batch, budget=budget, capacity=capacity))(batches)


@_trace_batches.defjvp
def _refuse_gradients(budget: Budget, capacity: int, primals: object, tangents: object) -> None:
    del budget, capacity, primals, tangents
    raise TypeError(
        "Light paths have no derivatives with respect to rays or geometry here: they would be "
        "silently wrong. Differentiate with respect to the parameters of the fields only, or hold "
        "rays and geometry constant with jax.lax.stop_gradient."
    )


def pack(followed: Followed, *, budget: Budget, capacity: int) -> Traced:
    """Joins refracted paths and first reflections of a batch into one list.

    The list holds the refracted paths first, in the order of the rays, then `capacity` slots
    for reflections, the strongest first. Weights are `1 - R` and `R` (paper, Fresnel blend).
    Where the first surface reflects totally, the followed path is that reflection already.

    Args:
      followed: the batch.
      budget: which light to follow.
      capacity: room for reflections; not used unless the budget asks for them.
    """
    count = followed.hit.shape[0]
    order = jnp.arange(count, dtype=jnp.int32)
    refracted = followed.paths._replace(rays=order)
    if budget.reflections == "none":
        return Traced(refracted, jnp.zeros_like(refracted.radii))
    partial = followed.hit & ~followed.first.total
    strength = jnp.where(partial, followed.first.reflectance, -1.0)
    strength_kept, kept = jax.lax.top_k(strength, capacity)
    share_kept = jnp.maximum(strength_kept, 0.0)
    share = jnp.zeros_like(strength).at[kept].set(share_kept)
    refracted = refracted._replace(weights=refracted.weights * (1.0 - share)[:, None])
    reflected = _reflections(followed, kept, share_kept, strength_kept >= 0.0)
    joined = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), refracted, reflected)
    return Traced(joined, jnp.maximum(strength, 0.0) - share)


def _reflections(
    followed: Followed,
    rays: Int[Array, " kept"],
    share: Float[Array, " kept"],
    real: Bool[Array, " kept"],
) -> LightPaths:
    """Returns the paths that some rays take by reflection at their first surface."""
    first = jax.tree.map(lambda x: x[rays], followed.first)
    camera = jax.tree.map(lambda x: x[rays], followed.paths)
    is_start = jnp.arange(camera.tau.shape[1]) == 0

    def two_segments(before: Array, after: Array) -> Array:
        mask = is_start.reshape(1, -1, *[1] * (before.ndim - 1))
        return jnp.where(mask, before[:, None], after[:, None])

    origin = camera.points[:, 0]
    tau = two_segments(jnp.zeros_like(share), numerics.length(first.position - origin))
    return LightPaths(
        points=two_segments(origin, first.position),
        directions=two_segments(camera.directions[:, 0], first.reflected),
        tau=jnp.where(jnp.arange(tau.shape[1])[None] <= 1, tau, jnp.inf),
        media=two_segments(first.medium_before, first.medium_before),
        rays=rays.astype(jnp.int32),
        weights=jnp.broadcast_to(share[:, None], origin.shape),
        radii=camera.radii,
        bends=jnp.ones_like(camera.bends),
        statuses=jnp.where(real, PathStatus.NOT_TRACED, PathStatus.EMPTY).astype(jnp.int32),
    )
