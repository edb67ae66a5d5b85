"""What is learned of the light between samples: tints, absorption, and a deformation of rays.

The throughput of a path is attenuated at every hit of a part's surface, reflected or refracted, and
along its length in the part's medium: `exp(-sum_p (n_p density_p + length_p absorption_p))`. The
tint of a surface is `exp(-density)`. A softplus, which has a gradient everywhere, keeps densities
and absorptions positive.

A deformation (`fields/raydef.py`) bends straight rays where no surface is known: it moves and turns
their samples (`move`), or bends them to polylines, whose knots it moves (`bend`).

Source: the Beer-Lambert law; the tint is the colour of Blender Cycles' glass BSDF.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.fields import base, registry
from refref_jax.fields.base import RadianceConfig
from refref_jax.optics.light_paths import LightPaths
from refref_jax.sampling import polylines, scene_bounds
from refref_jax.sampling.polylines import Gaussians, Polyline, PolylinePoint

# Almost white, with a useful slope of the softplus.
_INITIAL = -3.0

# Least density of a learned part.
_LEAST = 1e-6


class LearnedTints(NamedTuple):
    """Learned tints and absorption, before the softplus, linear RGB.

    Attributes:
      density: optical density of each part's surface, per hit.
      absorption: absorption of each part's medium, per scene radius.
    """

    density: Float[Array, "parts 3"]
    absorption: Float[Array, "parts 3"]


def init(parts: int) -> LearnedTints:
    """Returns initial values, for nearly clear parts."""
    # Two separate arrays, since training donates both buffers.
    initial = (jnp.full((parts, 3), _INITIAL, jnp.float32) for _ in LearnedTints._fields)
    return LearnedTints(*initial)


def tints(learned: LearnedTints) -> Float[Array, "parts 3"]:
    """Returns the factor on linear RGB at every hit of each part's surface."""
    return jnp.exp(-jax.nn.softplus(learned.density))


def absorptions(learned: LearnedTints, radius: float) -> Float[Array, "parts 3"]:
    """Returns the absorption of every part's medium, linear RGB, per world unit.

    Args:
      learned: learned tints and absorption.
      radius: radius of the scene, world units.
    """
    return jax.nn.softplus(learned.absorption) / radius


def optical_density(learned: LearnedTints | None) -> Float[Array, ""]:
    """Returns the mean density of all surfaces and of all media over a scene radius; 0 for none.

    With a small weight in the loss, it resolves an ambiguity of the images: a tint at both ends of
    a segment looks similar to absorption along it, and needs far less density.
    """
    if learned is None:
        return jnp.zeros(())
    return jnp.mean(jax.nn.softplus(learned.density)) + jnp.mean(
        jax.nn.softplus(learned.absorption)
    )


def attenuate(learned: LearnedTints | None, paths: LightPaths, *, radius: float) -> LightPaths:
    """Attenuates the throughput of paths by the tints and absorption along them.

    Args:
      learned: learned tints and absorption; `None` leaves the paths unchanged.
      paths: any number of paths, with hit counts and path lengths per part.
      radius: radius of the scene, world units.
    """
    if learned is None:
        return paths
    dimmed = transmittance(learned, crossings(paths, radius=radius))
    return paths._replace(throughput=paths.throughput * dimmed)


def transmittance(
    learned: LearnedTints, crossed: Float[Array, "paths unknowns"]
) -> Float[Array, "paths 3"]:
    """Returns the transmittance of paths through tints and media, linear RGB, from `crossings`."""
    return jnp.exp(numerics.product(-crossed, densities(learned)))


def crossings(paths: LightPaths, *, radius: float) -> Float[Array, "paths unknowns"]:
    """Returns how often paths hit each part, then their lengths in each medium over the radius."""
    return jnp.concatenate([paths.hit_counts, paths.path_lengths / radius], axis=-1)


def densities(learned: LearnedTints) -> Float[Array, "unknowns 3"]:
    """Returns the optical density of each surface, then that of each medium over the radius."""
    return jax.nn.softplus(jnp.concatenate(learned))


def of_densities(found: Float[Array, "unknowns 3"]) -> LearnedTints:
    """Inverts `densities`; they are at least 1e-6, where the softplus still has a gradient."""
    raw = jnp.maximum(found, _LEAST)
    return LearnedTints(*jnp.split(raw + jnp.log(-jnp.expm1(-raw)), 2))


def non_negative(
    normal: Float[np.ndarray, "unknowns unknowns"], right: Float[np.ndarray, " unknowns"]
) -> Float[np.ndarray, " unknowns"]:
    """Returns the non-negative densities `x` that minimise `x @ normal @ x / 2 - right @ x`."""
    ridge = 1e-9 * (np.trace(normal) or 1.0)
    root = np.linalg.cholesky(normal + ridge * np.eye(len(normal)))
    return scipy.optimize.nnls(root.T, np.linalg.solve(root, right))[0]


# ---- Deformation ----


class BentRay(NamedTuple):
    """A straight ray as a deformation bends it, at samples or knots, for its losses.

    Attributes:
      offsets: offsets of the points, in scene radii.
      places: distances of the points along the straight ray, in scene radii.
      straight: unit direction of the straight ray.
      turned: unit direction of travel at each point, or from it to the next.
      weights: weight of each point in the losses, without gradient.
    """

    offsets: Float[Array, "*paths points 3"]
    places: Float[Array, "*paths points"]
    straight: Float[Array, "*paths points 3"]
    turned: Float[Array, "*paths points 3"]
    weights: Float[Array, "*paths points"]


def move(
    params: base.Params,
    field: RadianceConfig,
    domain: scene_bounds.Domain,
    gaussians: Gaussians,
    points: PolylinePoint,
    progress: Float[Array, ""],
) -> tuple[Gaussians, PolylinePoint, BentRay]:
    """Moves and turns the samples of a straight ray.

    The multisamples of an interval move together. In an unbounded scene, offsets are those of the
    contracted points, so that the far background moves, too. Samples stay in the unit cube.

    Args:
      params: parameters of the field.
      field: shape of the field, which has a deformation.
      domain: scene bounds.
      gaussians: multisamples of each interval, in the unit cube.
      points: point of each interval.
      progress: progress of the training, 0 to 1.

    Returns:
      The moved multisamples, the turned points (whose positions are those before), and the bent
      ray, with equal weights. A second ray adds its multisamples to those of the ray, whose points
      stay as they are.
    """
    cells = jnp.mean(gaussians.positions, axis=-2)
    offsets = jax.vmap(registry.deform, in_axes=(None, None, 0, 0, None))(
        params, field, cells, points.direction, progress
    )
    radii = 4.0 if domain.space == "unbounded" else 2.0  # per edge of the cube
    per_edge = 2.0 if registry.has_second_ray(field) else radii
    moved = jnp.clip(gaussians.positions + offsets.position[:, None] / per_edge, 0.0, 1.0)
    turned = numerics.normalize(points.direction + offsets.direction)
    steps = radii * numerics.length(jnp.diff(cells, axis=0))
    places = jnp.concatenate([jnp.zeros_like(steps[:1]), jnp.cumsum(steps)])
    shifts = radii * (jnp.mean(moved, axis=-2) - cells)
    even = jnp.full_like(places, 1.0 / places.size)
    bent = BentRay(shifts, places, points.direction, turned, even)
    second = gaussians._replace(positions=moved)
    if registry.has_second_ray(field):
        pair = (jnp.concatenate(both, axis=1) for both in zip(gaussians, second, strict=True))
        return Gaussians(*pair), points, bent
    return second, points._replace(direction=turned), bent


def bend(
    params: base.Params,
    field: RadianceConfig,
    domain: scene_bounds.Domain,
    line: Polyline,
    warp: scene_bounds.DistanceWarp,
    progress: Float[Array, ""],
) -> tuple[Polyline, BentRay]:
    """Bends a straight ray to a polyline through knots, which are moved.

    The knots are evenly spread in the normalised coordinate, and the last one is at the end of the
    ray. They move across it: along it, they could only turn back or bunch up. In an unbounded
    scene, offsets grow with the distance from the centre. Knots stay within the scene bounds, and
    the camera where it is.

    Args:
      params: parameters of the field.
      field: shape of the field, which has a deformation with knots.
      domain: scene bounds.
      line: the straight ray.
      warp: distance warp of the straight ray.
      progress: progress of the training, 0 to 1.
    """
    count = registry.knots(field)
    t = scene_bounds.to_distance(warp, jnp.arange(count + 1, dtype=line.knots.dtype) / count)
    t = t.at[0].set(0.0)
    points = jax.vmap(polylines.point_at, in_axes=(None, 0))(line, t)
    cells = scene_bounds.to_unit_cube(domain, Gaussians(points.position, jnp.zeros_like(t)))
    offsets = jax.vmap(registry.deform, in_axes=(None, None, 0, 0, None))(
        params, field, cells.positions[1:], points.direction[1:], progress
    )
    reach = jnp.full_like(t, domain.radius)
    if domain.space == "unbounded":
        centre = jnp.asarray(domain.centre, t.dtype)
        reach = jnp.maximum(reach, numerics.length(points.position - centre[None]))
    ways = points.direction[1:]
    across = offsets.position - numerics.dot(offsets.position, ways)[:, None] * ways
    knots = points.position[1:] + reach[1:, None] * across
    knots = jax.vmap(lambda x: scene_bounds.nearest_within(domain, x))(knots)
    bent = polylines.through(line, knots)
    if domain.space == "unbounded":  # it ends at its last knot, as the straight ray does
        bent = bent._replace(stop=bent.arcs[-1] + numerics.length(knots[-1] - bent.points[-1]))
    shifts = jnp.concatenate([line.points[:1], knots]) - points.position
    turned = jnp.concatenate([bent.directions, bent.directions[-1:]])
    even = jnp.full_like(t, 1.0 / count)
    scaled = shifts / domain.radius, t / domain.radius
    return bent, BentRay(*scaled, points.direction, turned, even)
