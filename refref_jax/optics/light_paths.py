"""Light paths: the polylines that light takes from a pixel into the scene.

Letters, as in the paper (section 4.2): a path has points `p_0 .. p_K`, unit directions
`d_0 .. d_K` and cumulative distances `tau_0 = 0 .. tau_K`; segment `i` is
`r(t) = p_i + (t - tau_i) d_i` for `t` in `[tau_i, tau_{i+1})`, and the last one never ends.
`t` is arc length in world units.
"""

import enum
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax.geometry.rays import Rays
from refref_jax.optics import footprints
from refref_jax.optics.footprints import Spread
from refref_jax.optics.media import AMBIENT


class PathStatus(enum.IntEnum):
    """How a path ended."""

    EMPTY = 0
    """The slot holds no path; its weight is 0."""
    MISSED = 1
    """The ray met no interface; the path is straight."""
    ESCAPED = 2
    """The path bent, left the objects and goes on for ever along its last direction."""
    OUT_OF_BENDS = 3
    """The path would meet another interface, but its budget of bends is spent."""
    NOT_TRACED = 4
    """The last direction was not traced against the objects: the paper's reflected ray, and every
    ray of a budget without bends."""
    TOTALLY_REFLECTED = 5
    """The path met a total reflection, which its budget does not follow."""


class LightPaths(NamedTuple):
    """The light paths of a batch of rays, padded to the same number of segments.

    A ray may have any number of paths, in any order. Its colour is the sum of its paths'
    colours times their weights. Segments inside the objects may be left out (see `details`): then
    the next one starts later than the one before it ends.

    Attributes:
      points: start of each segment, world units; finite but meaningless where unused.
      directions: unit direction of each segment; likewise.
      tau: arc length at the start of each segment, increasing from 0; `inf` where unused.
      ends: arc length at the end of each segment; `inf` for the last, and where unused.
      media: medium of each segment (see `media`).
      spreads: derivatives of each segment across the pixel, if they are carried (see
        `footprints`).
      rays: index of the ray that a path belongs to.
      weights: share of the path in its ray's linear RGB.
      radii: footprint of the ray's pixel as a cone radius at unit distance.
      bends: number of refractions and reflections.
      statuses: a `PathStatus`.
      meetings: how often the path met each part, if that is tallied (see `details`).
      passages: how far it went through each part's medium, world units; likewise.
    """

    points: Float[Array, "paths segments 3"]
    directions: Float[Array, "paths segments 3"]
    tau: Float[Array, "paths segments"]
    ends: Float[Array, "paths segments"]
    media: Int[Array, "paths segments"]
    spreads: Spread
    rays: Int[Array, " paths"]
    weights: Float[Array, "paths 3"]
    radii: Float[Array, " paths"]
    bends: Int[Array, " paths"]
    statuses: Int[Array, " paths"]
    meetings: Float[Array, "paths tallied"]
    passages: Float[Array, "paths tallied"]


class PathEnds(NamedTuple):
    """The last segments of light paths: all that a known background needs.

    Attributes:
      origins: start of the last segment, world units; finite but meaningless in empty slots.
      directions: its unit direction; likewise.
      tau: arc length from the camera to its start.
      media: its medium (see `media`).
      rays: index of the ray that a path belongs to.
      weights: share of the path in its ray's linear RGB; 0 in empty slots.
      bends: number of refractions and reflections.
      statuses: a `PathStatus`.
    """

    origins: Float[Array, "paths 3"]
    directions: Float[Array, "paths 3"]
    tau: Float[Array, " paths"]
    media: Int[Array, " paths"]
    rays: Int[Array, " paths"]
    weights: Float[Array, "paths 3"]
    bends: Int[Array, " paths"]
    statuses: Int[Array, " paths"]


def straight(rays: Rays) -> LightPaths:
    """Returns one straight path a ray, with full weight: the light paths of a plain NeRF."""
    count = rays.radii.shape[0]
    integers = jnp.arange(count, dtype=jnp.int32)
    return LightPaths(
        points=rays.origins[:, None],
        directions=rays.directions[:, None],
        tau=jnp.zeros_like(rays.radii)[:, None],
        ends=jnp.full_like(rays.radii, jnp.inf)[:, None],
        media=jnp.full((count, 1), AMBIENT, jnp.int32),
        spreads=jax.vmap(jax.vmap(footprints.nothing))(rays.origins[:, None]),
        rays=integers,
        weights=jnp.ones_like(rays.directions),
        radii=rays.radii,
        bends=jnp.zeros_like(integers),
        statuses=jnp.full_like(integers, PathStatus.NOT_TRACED),
        meetings=jnp.zeros_like(rays.origins, shape=(count, 0)),
        passages=jnp.zeros_like(rays.origins, shape=(count, 0)),
    )


def straight_ends(rays: Rays) -> PathEnds:
    """Returns the only segments of `straight`'s paths."""
    return ends_of(straight(rays))


def ends_of(paths: LightPaths) -> PathEnds:
    """Returns the last segment of each path; of one that does not exist, some segment."""
    used = jnp.sum(jnp.isfinite(paths.tau), axis=1, dtype=jnp.int32)
    path, last = jnp.arange(used.shape[0], dtype=jnp.int32), jnp.maximum(used - 1, 0)
    return PathEnds(
        origins=paths.points[path, last],
        directions=paths.directions[path, last],
        tau=paths.tau[path, last],
        media=paths.media[path, last],
        rays=paths.rays,
        weights=paths.weights,
        bends=paths.bends,
        statuses=paths.statuses,
    )


def filled_up(paths: LightPaths, *, multiple: int) -> LightPaths:
    """Returns the paths with empty slots after them, so that their number is a multiple."""
    count = paths.radii.shape[0]
    room = -(-count // multiple) * multiple
    # What is in an empty slot is finite: the last path again, which carries no light.
    paths = jax.tree.map(lambda x: x[jnp.minimum(jnp.arange(room), count - 1)], paths)
    real = jnp.arange(room) < count
    return paths._replace(
        weights=jnp.where(real[:, None], paths.weights, 0.0),
        statuses=jnp.where(real, paths.statuses, PathStatus.EMPTY),
    )


def exists(paths: LightPaths | PathEnds) -> Bool[Array, " paths"]:
    """Returns which slots hold a path."""
    return paths.statuses != PathStatus.EMPTY
