"""Surfaces of a scene: packed on the host (NumPy), evaluated at ray hits on the device.

A surface point has a position, two normals and the part of the scene that it belongs to. The
*geometric* normal is that of the triangle and determines the side that a ray is on. The *shading*
normal is interpolated between the corners and determines the directions of the reflected and
refracted rays; on a flat part both normals agree. Both point out of the object.

A surface is either a set of triangles (`Surfaces`) or a `LevelSet`: where a signed value is 0.
`closest` and `meet` take both. What a ray hits first is an integer for both, without gradient: the
triangle, or the *stretch* of the ray in which the value changes its sign. The part of a ray that is
in the ball of a level set is divided into `STRETCHES` equal ones, so walls that are thinner than a
stretch may be missed. `meet` finds the point again, with gradients.

The point of a level set is implicit. From `f(o + t d) = 0` follows, with the slope `g` of `f`,
`dt/df = -1 / (g.d)`, `dt/do = -g / (g.d)` and `dt/dd = -t g / (g.d)`, whatever the length of `g`.
`meet` finds `t` by iteration, without gradient, and then takes one step of Newton's method that is
written so that its derivatives are these. They are exact to first order; second derivatives are
not. At grazing incidence they are unbounded, and bounded here by a smallest cosine.

Source of the gradient: Yariv et al., Multiview Neural Surface Reconstruction by Disentangling
Geometry and Appearance (2020), section 3.1, for any length of the slope.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.geometry import bvh_build
from refref_jax.geometry.bvh import BVH, NO_PRIMITIVE, closest_primitive
from refref_jax.geometry.rays import geometric_normal, interpolate, intersect
from refref_jax.geometry.triangle_meshes import Mesh

STRETCHES = 64
"""Number of stretches of a ray in the ball of a level set."""

# Distance from its origin at which a ray may meet a level set again, in radii of the ball.
_CLEARANCE = 1e-3

# Number of iterations of the Illinois method within a stretch, before the step of Newton's.
_ROUNDS = 8

# Smallest cosine between a ray and the slope in the gradient of an implicit point.
_GRAZING = 0.05


class Surfaces(NamedTuple):
    """All surfaces of a scene, indexed by the primitives of their BVH.

    Attributes:
      bvh: the BVH, which also holds the corners.
      normals: outward unit shading normals at the three corners.
      parts: index of each triangle's mesh part.
      radiance: linear RGB radiance of opaque parts at the three corners, meaningless elsewhere;
        empty if it is unknown, or no part is opaque.
    """

    bvh: BVH
    normals: Float[Array, "primitives 3 3"]
    parts: Int[Array, " primitives"]
    radiance: Float[Array, "radiating 3 3"]


class LevelSet(NamedTuple):
    """A closed surface, in a ball, where a signed value is 0. It is the one part of its scene.

    Attributes:
      values: function of points `[n, 3]`, world units, that returns their values `[n]`, negative
        inside; a pytree, such as `jax.tree_util.Partial`, with its parameters as arrays.
      step: half of the distance of the points between which the slope is a difference, world units.
      centre: centre of the ball, world units.
      radius: radius of the ball, world units.
    """

    values: Callable[[Array], Array]
    step: Float[Array, ""]
    centre: Float[Array, "3"]
    radius: Float[Array, ""]


class SurfacePoint(NamedTuple):
    """A point on a surface; the two normals of a level set agree.

    Attributes:
      position: point on the triangle's plane, world units.
      geometric_normal: outward unit normal of the triangle.
      shading_normal: outward unit normal, interpolated between the corners.
      part: index of the mesh part.
      scale: largest absolute coordinate of the triangle, which sets the rounding error of
        `position`.
      radiance: linear RGB radiance of the surface, `None` if it is unknown.
    """

    position: Float[Array, "3"]
    geometric_normal: Float[Array, "3"]
    shading_normal: Float[Array, "3"]
    part: Int[Array, ""]
    scale: Float[Array, ""]
    radiance: Float[Array, "3"] | None = None


def surface_point(
    surfaces: Surfaces, primitive_id: Int[Array, ""], barycentric: Float[Array, "2"]
) -> SurfacePoint:
    """Returns the point of one triangle at barycentric coordinates.

    The position is computed from the corners, not from a distance along a ray, so its error does
    not grow with the length of the ray.

    Args:
      surfaces: surfaces of the scene.
      primitive_id: index of a triangle; for `NO_PRIMITIVE` the result is finite but meaningless.
      barycentric: weights of the second and third corner.
    """
    corners = surfaces.bvh.triangles[primitive_id]
    geometric = geometric_normal(corners)
    blended = interpolate(surfaces.normals[primitive_id], barycentric)
    shading = numerics.normalize(blended)
    opposed = numerics.dot(shading, geometric) <= 0.0
    radiance = None
    if surfaces.radiance.shape[0]:
        radiance = interpolate(surfaces.radiance[primitive_id], barycentric)
    return SurfacePoint(
        position=interpolate(corners, barycentric),
        geometric_normal=geometric,
        shading_normal=jnp.where(opposed, geometric, shading),
        part=surfaces.parts[primitive_id],
        scale=numerics.largest_component(corners.reshape(9)),
        radiance=radiance,
    )


def closest(
    surfaces: Surfaces | LevelSet,
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    limit: Float[Array, ""],
    exclude: Int[Array, ""],
) -> Int[Array, ""]:
    """Returns what a ray hits first, without gradient: a triangle, or a stretch of the ray.

    Args:
      surfaces: surfaces of the scene.
      origin: origin of the ray, world units.
      direction: unit direction of the ray.
      limit: distance up to which hits count.
      exclude: triangle that cannot be hit; a level set cannot be hit right at the origin.

    Returns:
      Index of the triangle or stretch, `NO_PRIMITIVE` for a miss.
    """
    if not isinstance(surfaces, LevelSet):
        return closest_primitive(surfaces.bvh, origin, direction, limit, exclude)
    surfaces, origin, direction = jax.lax.stop_gradient((surfaces, origin, direction))
    edges = _edges(surfaces, origin, direction)
    values = _along(surfaces, origin, direction, edges)
    crosses = ((values[1:] > 0.0) != (values[:-1] > 0.0)) & (edges[:-1] < limit)
    crosses &= edges[-1] > edges[0]
    return jnp.where(jnp.any(crosses), jnp.argmax(crosses), NO_PRIMITIVE).astype(jnp.int32)


def meet(
    surfaces: Surfaces | LevelSet,
    primitive_id: Int[Array, ""],
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
) -> SurfacePoint:
    """Returns the point where a ray hits a surface, with gradients.

    Args:
      surfaces: surfaces of the scene.
      primitive_id: triangle or stretch that is hit; the result for `NO_PRIMITIVE` is finite but
        meaningless.
      origin: origin of the ray, world units.
      direction: unit direction of the ray.
    """
    if isinstance(surfaces, LevelSet):
        return _implicit_point(surfaces, primitive_id, origin, direction)
    corners = surfaces.bvh.triangles[primitive_id]
    found = intersect(origin, direction, corners).barycentric
    # A ray without a hit reads an arbitrary triangle: keep it out of values and gradients.
    barycentric = jnp.where(primitive_id == NO_PRIMITIVE, 1.0 / 3.0, found)
    return surface_point(surfaces, primitive_id, barycentric)


def slope(surface: LevelSet, point: Float[Array, "3"]) -> Float[Array, "3"]:
    """Returns the slope of a level set's value at a point, by central differences."""
    return _value_and_slope(surface, point)[1]


def _value_and_slope(
    surface: LevelSet, point: Float[Array, "3"]
) -> tuple[Float[Array, ""], Float[Array, "3"]]:
    axes = jnp.eye(3, dtype=point.dtype)
    shifts = jnp.concatenate([jnp.zeros_like(axes[:1]), axes, -axes])
    values = surface.values(point[None] + surface.step * shifts)
    return values[0], (values[1:4] - values[4:]) / (2.0 * surface.step)


def _along(
    surface: LevelSet,
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    distances: Float[Array, " n"],
) -> Float[Array, " n"]:
    return surface.values(origin[None] + distances[:, None] * direction[None])


def _edges(
    surface: LevelSet, origin: Float[Array, "3"], direction: Float[Array, "3"]
) -> Float[Array, " edges"]:
    """Returns the distances of the ends of a ray's stretches; all equal if it misses the ball."""
    offset = origin - surface.centre
    middle = -numerics.dot(offset, direction)
    beside = numerics.length(offset + middle * direction)
    half = numerics.safe_sqrt(jnp.maximum(surface.radius**2 - beside**2, 0.0))
    start = jnp.maximum(middle - half, _CLEARANCE * surface.radius)
    length = jnp.maximum(middle + half - start, 0.0)
    return start + length * (jnp.arange(STRETCHES + 1, dtype=origin.dtype) / STRETCHES)


def _implicit_point(
    surface: LevelSet,
    stretch: Int[Array, ""],
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
) -> SurfacePoint:
    fixed, start, towards = jax.lax.stop_gradient((surface, origin, direction))
    t, enters = _crossing(fixed, stretch, start, towards)
    near = start + t * towards
    value, steepest = _value_and_slope(surface, near)
    fixed_slope = jax.lax.stop_gradient(steepest)
    along = numerics.dot(fixed_slope, towards)
    least = _GRAZING * numerics.length(fixed_slope)
    steep = jnp.where(enters, jnp.minimum(along, -least), jnp.maximum(along, least))
    moved = origin + t * direction - near
    distance = t - numerics.safe_divide(value + numerics.dot(fixed_slope, moved), steep)
    position = origin + distance * direction
    normal = numerics.normalize(slope(surface, position))
    # A slope by differences may face the wrong way at grazing incidence: mirror it.
    facing = numerics.dot(normal, direction)
    wrong = (facing < 0.0) != enters
    normal = jnp.where(wrong, normal - 2.0 * facing * direction, normal)
    scale = numerics.largest_component(position)
    return SurfacePoint(position, normal, normal, jnp.zeros((), jnp.int32), scale)


def _crossing(
    surface: LevelSet,
    stretch: Int[Array, ""],
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Returns the distance at which the value is 0 in a stretch, and whether the ray enters there.

    Source: Dowell and Jarratt, A Modified Regula Falsi Method (1971): the Illinois method.
    """
    edges = _edges(surface, origin, direction)
    ends = edges[jnp.maximum(stretch, 0)], edges[jnp.maximum(stretch, 0) + 1]

    def narrow(_: Int[Array, ""], bracket: tuple[Array, Array, Array, Array]) -> tuple[Array, ...]:
        a, at_a, b, at_b = bracket
        c = jnp.clip(b - numerics.safe_divide(at_b * (b - a), at_b - at_a), *ends)
        at_c = _along(surface, origin, direction, c[None])[0]
        kept = jnp.sign(at_c) == jnp.sign(at_b)
        # An end that is kept twice counts half, or the bracket would shrink from one side only.
        a, at_a = jnp.where(kept, a, b), jnp.where(kept, 0.5 * at_a, at_b)
        return a, at_a, c, at_c

    first, last = _along(surface, origin, direction, jnp.stack(ends))
    _, _, t, _ = jax.lax.fori_loop(0, _ROUNDS, narrow, (ends[0], first, ends[1], last))
    return t, first > 0.0


def pack_meshes(
    meshes: Sequence[Mesh], *, radiance: Sequence[Float[np.ndarray, "_ 3 3"]] = ()
) -> Surfaces:
    """Packs meshes for the device; none may be empty, and parts are numbered in their order.

    Args:
      meshes: meshes of the parts.
      radiance: linear RGB radiance at the corners of each mesh, or nothing.
    """
    return build_surfaces(
        np.concatenate([np.zeros((0, 3, 3)), *(mesh.vertices[mesh.faces] for mesh in meshes)]),
        np.concatenate([np.zeros((0, 3, 3)), *(mesh.normals for mesh in meshes)]),
        np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes]),
        radiance=np.concatenate([np.zeros((0, 3, 3)), *radiance]),
    )


def build_surfaces(
    triangles: Float[np.ndarray, "faces 3 3"],
    normals: Float[np.ndarray, "faces 3 3"],
    parts: Int[np.ndarray, " faces"],
    *,
    radiance: Float[np.ndarray, "radiating 3 3"] | None = None,
) -> Surfaces:
    """Builds the `Surfaces` of a triangle soup, in single precision.

    Args:
      triangles: corners, counter-clockwise seen from outside, world units. May be empty.
      normals: outward unit shading normals at the corners.
      parts: part index of each triangle.
      radiance: linear RGB radiance at the corners of all triangles, or of none.

    Returns:
      The surfaces, in the leaf order of their tree.
    """
    if radiance is None or len(radiance) == 0:
        radiance = np.zeros((0, 3, 3))
    bvh, primitive_ids = bvh_build.build(triangles.astype(np.float32))
    if len(triangles) == 0:
        return Surfaces(
            bvh,
            numerics.host_array(np.zeros_like(bvh.triangles)),
            numerics.host_array(primitive_ids),
            numerics.host_array(radiance.astype(np.float32)),
        )
    return Surfaces(
        bvh,
        numerics.host_array(normals[primitive_ids].astype(np.float32)),
        numerics.host_array(parts[primitive_ids].astype(np.int32)),
        numerics.host_array(
            (radiance[primitive_ids] if len(radiance) else radiance).astype(np.float32)
        ),
    )
