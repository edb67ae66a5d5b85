"""Light paths: polylines of light from a pixel into the scene.

Symbols, as in the paper (section 4.2): a path has points `p_0 .. p_K`, unit directions
`d_0 .. d_K` and cumulative distances `tau_0 = 0 .. tau_K`; segment `i` is
`r(t) = p_i + (t - tau_i) d_i` for `t` in `[tau_i, tau_{i+1})`, and the last one never ends.
`t` is arc length in world units.

`reflected_first` separates the paths of a pixel by their branch at the first surface: light that
the outside of the objects reflects, and the rest, which passes through the objects or misses them.

A ray differential is the footprint of a pixel along its ray. To first order, the bundle of rays of
a pixel is described by the derivatives of the central ray's point and direction with respect to two
coordinates across the pixel. They are propagated through every bend by forward-mode differentiation
of the steps that bend the ray. Behind a glass ball, the footprint is several times wider than after
the same distance in air, and a flat ellipse rather than a disc.

The coordinates are scaled so that, at distance `t`, a straight ray has two orthogonal derivatives
of length `radius * t`: the cone of `Rays.radii`. Their orientation is arbitrary, since a square
pixel has the same second moments in all directions.

Source: Igehy, Tracing Ray Differentials (1999).
"""

import enum
import functools
from collections.abc import Callable
from typing import Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.choices import Footprint
from refref_jax.geometry.rays import Rays, orthonormal_basis
from refref_jax.optics.media import AMBIENT

# Near the critical angle the derivatives are unbounded. A footprint of this width covers the
# scene, and its square is still finite.
_WIDEST = 1e6

_Result = TypeVar("_Result")


class RayDifferential(NamedTuple):
    """Ray differential: derivatives of a ray across its pixel; empty if they are not carried.

    Attributes:
      points: derivatives of the segment's start, world units.
      directions: derivatives of the segment's unit direction.
    """

    points: Float[Array, "*rays axes 3"]
    directions: Float[Array, "*rays axes 3"]


class Bend(NamedTuple):
    """Differentiated results of a ray's interaction with a surface.

    Attributes:
      point: hit point on the surface, world units.
      reflected: mirrored unit direction.
      transmitted: refracted unit direction.
    """

    point: Float[Array, "3"]
    reflected: Float[Array, "3"]
    transmitted: Float[Array, "3"]


def begin_differential(ray: Rays, footprint: Footprint) -> RayDifferential:
    """Returns the ray differential of a camera ray: all rays of a pixel start at one point."""
    if footprint == "cone":
        return no_differential(ray.origins)
    sides = ray.radii * jnp.stack(orthonormal_basis(ray.directions))
    return RayDifferential(jnp.zeros_like(sides), sides)


def no_differential(like: Float[Array, "3"]) -> RayDifferential:
    """Returns the empty ray differential of a ray whose derivatives are not carried."""
    none = jnp.zeros((0, 3), like.dtype)
    return RayDifferential(none, none)


def bend(
    surface: Callable[[Array, Array, Array | None], tuple[Bend, _Result]],
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    differential: RayDifferential,
    *,
    tilts: Float[Array, "2 2"] | None = None,
) -> tuple[_Result, RayDifferential, RayDifferential]:
    """Bends a ray and its differential.

    Args:
      surface: function of origin, direction and tilt of the surface (two slopes) that returns a
        `Bend` and an auxiliary output.
      origin: origin of the ray.
      direction: unit direction of the ray.
      differential: differential of the ray.
      tilts: tilt of the surface per unit of each coordinate across the pixel; 0 by default.

    Returns:
      The auxiliary output, and the differentials of the reflected and the transmitted ray.
    """
    if differential.points.shape[0] == 0:
        return surface(origin, direction, None)[1], differential, differential
    none = None if tilts is None else jnp.zeros(2, origin.dtype)
    _, push, result = jax.linearize(surface, origin, direction, none, has_aux=True)
    moved = jax.vmap(push)(differential.points, differential.directions, tilts)
    moved = jax.tree.map(lambda x: jnp.clip(x, -_WIDEST, _WIDEST), moved)
    return (
        result,
        RayDifferential(moved.point, moved.reflected),
        RayDifferential(moved.point, moved.transmitted),
    )


def across(
    differential: RayDifferential, along: Float[Array, ""], direction: Float[Array, "3"]
) -> Float[Array, "axes 3"]:
    """Returns the half axes of a footprint in the plane perpendicular to its ray.

    Args:
      differential: ray differential of the segment.
      along: distance from the segment's start, world units.
      direction: unit direction of the segment.
    """
    moved = differential.points + along * differential.directions
    rows = jnp.broadcast_to(direction, moved.shape)
    return moved - numerics.dot(moved, rows)[:, None] * rows


class PathStatus(enum.IntEnum):
    """Reason for the end of a path."""

    EMPTY = 0
    """The slot is empty; its throughput is 0."""
    MISSED = 1
    """The ray hit no interface; the path is straight."""
    ESCAPED = 2
    """The path bent, left the objects and continues to infinity along its last direction."""
    OUT_OF_BENDS = 3
    """The path was truncated: it would hit another interface after the max bends."""
    NOT_TRACED = 4
    """The last direction was not traced against the objects: the paper's reflected ray, and all
    rays if max bends is 0."""
    TOTALLY_REFLECTED = 5
    """The path hit a total internal reflection, which its settings do not follow."""
    OPAQUE = 6
    """The path ended on an opaque surface."""


class Stop(NamedTuple):
    """Where paths end on opaque surfaces; records of scenes without opaque parts have none.

    Attributes:
      tau: arc length from the camera to the surface; `inf` if the path ends elsewhere.
      radiance: linear RGB radiance of the surface; `None` if it is unknown.
    """

    tau: Float[Array, "*paths"]
    radiance: Float[Array, "*paths 3"] | None


class LightPaths(NamedTuple):
    """The light paths of a batch of rays, padded to the same number of segments.

    A ray may have any number of paths, in any order. Its colour is the sum of the colours of its
    paths, multiplied by their throughput. Segments inside the objects may be omitted (see
    `path_settings`); then there is a gap in arc length before the next segment.

    Attributes:
      points: start of each segment, world units; finite but meaningless where unused.
      directions: unit direction of each segment; finite but meaningless where unused.
      tau: arc length at the start of each segment, increasing from 0; `inf` where unused.
      ends: arc length at the end of each segment; `inf` for the last, and where unused.
      media: medium of each segment (see `media`).
      differentials: ray differential of each segment, if carried (see `RayDifferential`).
      rays: index of each path's ray.
      throughput: share of the ray's linear RGB that the path carries.
      radii: footprint of the ray's pixel as a cone radius at unit distance.
      num_bends: number of refractions and reflections.
      statuses: `PathStatus` of each path.
      hit_counts: hit count per part, if tallied (see `path_settings`).
      path_lengths: path length in each part's medium, world units, if tallied.
      stop: ends on opaque surfaces, `None` without such surfaces.
    """

    points: Float[Array, "paths segments 3"]
    directions: Float[Array, "paths segments 3"]
    tau: Float[Array, "paths segments"]
    ends: Float[Array, "paths segments"]
    media: Int[Array, "paths segments"]
    differentials: RayDifferential
    rays: Int[Array, " paths"]
    throughput: Float[Array, "paths 3"]
    radii: Float[Array, " paths"]
    num_bends: Int[Array, " paths"]
    statuses: Int[Array, " paths"]
    hit_counts: Float[Array, "paths tallied"]
    path_lengths: Float[Array, "paths tallied"]
    stop: Stop | None = None


class PathEnds(NamedTuple):
    """Last segments of light paths; sufficient for a known background.

    Attributes:
      origins: start of the last segment, world units; finite but meaningless in empty slots.
      directions: unit direction of the last segment; finite but meaningless in empty slots.
      tau: arc length from the camera to the start of the last segment.
      media: medium of the last segment (see `media`).
      rays: index of each path's ray.
      throughput: share of the ray's linear RGB that the path carries; 0 in empty slots.
      num_bends: number of refractions and reflections.
      statuses: `PathStatus` of each path.
      differentials: ray differential of the last segment, if carried (see `RayDifferential`).
      stop: ends on opaque surfaces, `None` without such surfaces.
    """

    origins: Float[Array, "paths 3"]
    directions: Float[Array, "paths 3"]
    tau: Float[Array, " paths"]
    media: Int[Array, " paths"]
    rays: Int[Array, " paths"]
    throughput: Float[Array, "paths 3"]
    num_bends: Int[Array, " paths"]
    statuses: Int[Array, " paths"]
    differentials: RayDifferential
    stop: Stop | None = None


def straight(rays: Rays, *, footprint: Footprint = "cone") -> LightPaths:
    """Returns one straight path per ray, with full throughput: the light paths of a plain NeRF."""
    count = rays.radii.shape[0]
    integers = jnp.arange(count, dtype=jnp.int32)
    return LightPaths(
        points=rays.origins[:, None],
        directions=rays.directions[:, None],
        tau=jnp.zeros_like(rays.radii)[:, None],
        ends=jnp.full_like(rays.radii, jnp.inf)[:, None],
        media=jnp.full((count, 1), AMBIENT, jnp.int32),
        differentials=jax.tree.map(
            lambda x: x[:, None],
            jax.vmap(functools.partial(begin_differential, footprint=footprint))(rays),
        ),
        rays=integers,
        throughput=jnp.ones_like(rays.directions),
        radii=rays.radii,
        num_bends=jnp.zeros_like(integers),
        statuses=jnp.full_like(integers, PathStatus.NOT_TRACED),
        hit_counts=jnp.zeros_like(rays.origins, shape=(count, 0)),
        path_lengths=jnp.zeros_like(rays.origins, shape=(count, 0)),
    )


def straight_ends(rays: Rays, *, footprint: Footprint = "cone") -> PathEnds:
    """Returns the last segments of the paths of `straight`."""
    return ends_of(straight(rays, footprint=footprint))


def ends_of(paths: LightPaths) -> PathEnds:
    """Returns the last segment of each path; an arbitrary segment for empty slots."""
    used = jnp.sum(jnp.isfinite(paths.tau), axis=1, dtype=jnp.int32)
    path, last = jnp.arange(used.shape[0], dtype=jnp.int32), jnp.maximum(used - 1, 0)
    return PathEnds(
        origins=paths.points[path, last],
        directions=paths.directions[path, last],
        tau=paths.tau[path, last],
        media=paths.media[path, last],
        rays=paths.rays,
        throughput=paths.throughput,
        num_bends=paths.num_bends,
        statuses=paths.statuses,
        differentials=jax.tree.map(lambda x: x[path, last], paths.differentials),
        stop=paths.stop,
    )


def filled_up(paths: LightPaths, *, multiple: int) -> LightPaths:
    """Returns the paths, padded with empty slots to a multiple of a number."""
    count = paths.radii.shape[0]
    padded = -(-count // multiple) * multiple
    # Empty slots repeat the last path with throughput 0, so that their values are finite.
    paths = jax.tree.map(lambda x: x[jnp.minimum(jnp.arange(padded), count - 1)], paths)
    real = jnp.arange(padded) < count
    return paths._replace(
        throughput=jnp.where(real[:, None], paths.throughput, 0.0),
        statuses=jnp.where(real, paths.statuses, PathStatus.EMPTY),
    )


def exists(paths: LightPaths | PathEnds) -> Bool[Array, " paths"]:
    """Returns which slots hold a path."""
    return paths.statuses != PathStatus.EMPTY


Branch = Literal["both", "transmitted", "reflected"]
"""Paths to select: both branches, `reflected` ones, or `transmitted` ones (all others)."""


def heaviest(
    share: Float[Array, " paths"],
    of_rays: Int[Array, " paths"],
    exists: Bool[Array, " paths"],
    *,
    rays: int,
) -> Bool[Array, " paths"]:
    """Returns which paths carry the most light of their ray; several, if they carry as much.

    Args:
      share: throughput of each path, mean over RGB.
      of_rays: index of each path's ray.
      exists: whether a slot holds a path.
      rays: number of rays.
    """
    most = jax.ops.segment_max(share, of_rays, num_segments=rays)
    return exists & (share >= most[of_rays])


def reflected_first(paths: LightPaths) -> Bool[Array, " paths"]:
    """Returns which paths were reflected at the first surface they hit.

    These change direction in their medium: their second segment starts at the end of the first. If
    a path has more segments outside the objects than are stored (see `path_settings`), its second
    segment is unknown and it counts as transmitted; with one convex object this never happens. The
    camera is
    assumed to be outside all objects.
    """
    if paths.tau.shape[-1] < 2:
        return jnp.zeros_like(paths.num_bends, bool)
    at_once = paths.tau[:, 1] == paths.ends[:, 0]
    # A thin sheet lets light through without a change of medium.
    at_once &= jnp.any(paths.directions[:, 1] != paths.directions[:, 0], axis=-1)
    return (paths.num_bends > 0) & at_once & (paths.media[:, 1] == paths.media[:, 0])
