"""STAND-IN for `path_tracing.trace_ends`, to be removed when the path tree is merged."""

from typing import NamedTuple

import jax.numpy as jnp

from refref_jax.optics import path_tracing


class PathEnds(NamedTuple):
    """STAND-IN."""

    origins: object
    directions: object
    tau: object
    media: object
    rays: object
    weights: object
    bends: object
    statuses: object


class TracedEnds(NamedTuple):
    """STAND-IN."""

    ends: PathEnds
    lost: object
    casts: object


def trace_ends(geometry: object, rays: object, *, budget: object) -> TracedEnds:
    """STAND-IN."""
    count = rays.radii.shape[0]
    paths = path_tracing.trace(geometry, rays, budget=budget, capacity=count).paths
    last = jnp.minimum(paths.bends, paths.tau.shape[1] - 1)
    each = jnp.arange(paths.bends.shape[0])
    ends = PathEnds(
        paths.points[each, last],
        paths.directions[each, last],
        paths.tau[each, last],
        paths.media[each, last],
        paths.rays,
        paths.weights,
        paths.bends,
        paths.statuses,
    )
    alive = paths.statuses != 0
    traced = (alive & (paths.statuses != 4)) & (budget.bends > 0)
    casts = jnp.sum(jnp.where(traced, paths.bends + 1, 0))
    return TracedEnds(ends, jnp.zeros_like(rays.directions), casts)
