"""Known backgrounds: textured cubes, textured spheres and environment maps.

A background is a record of arrays; the `*_radiance` functions return its linear RGB radiance along
one ray. `u` is 0 at the left edge of an image and 1 at the right, `v` is 0 at its *bottom* edge and
1 at the top, and pixel `(row, column)` of `[h, w]` has its centre at `u = (column + 0.5) / w`,
`v = 1 - (row + 0.5) / h`. Colours are interpolated bilinearly between centres. The world frame is
that of the rays, with z up.

All functions are differentiable with respect to ray and texels, with kinks at texel centres and at
the edges of a cube. `radiance_of` converts a background to a function for `render_known`, and
`shade` evaluates such a function at the ends of light paths.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.geometry.rays import chord
from refref_jax.optics import light_paths
from refref_jax.optics.light_paths import LightPaths, PathEnds
from refref_jax.render import pixels

Radiance = Callable[[Float[Array, "3"], Float[Array, "3"]], Float[Array, "3"]]
"""Radiance along one ray: function of origin and unit direction, world units, to linear RGB."""


class SrgbTexture(NamedTuple):
    """Images that are stored as sRGB.

    They are interpolated as sRGB and decoded afterwards, as Blender Cycles does with 8-bit images;
    the other order differs by up to 0.1 between texels.

    Attributes:
      texels: sRGB values, row 0 at the top.
    """

    texels: Float[Array, "*images h w 3"]


class LinearTexture(NamedTuple):
    """Images that are stored as linear RGB.

    Attributes:
      texels: linear RGB values, row 0 at the top.
    """

    texels: Float[Array, "*images h w 3"]


Texture = SrgbTexture | LinearTexture

# Middles of the quadrants of a pixel, whose edges are root 3 times its ray differential.
_MIDDLE = 3.0**0.5 / 4.0
_QUADRANTS = [(-_MIDDLE, -_MIDDLE), (-_MIDDLE, _MIDDLE), (_MIDDLE, -_MIDDLE), (_MIDDLE, _MIDDLE)]

# Number of paths whose radiance is evaluated at once.
_CHUNK = 4096


class CubeBackground(NamedTuple):
    """Background cube: six square walls around a centre, each with an image.

    The point `(u, v)` of a wall is
    `centre + half_extent (normal + (2u - 1) u_axis + (2v - 1) v_axis)`.

    Attributes:
      texture: one image per wall, all of the same size.
      normals: outward unit normals of the walls.
      u_axes: unit direction of increasing `u` on each wall.
      v_axes: unit direction of increasing `v` on each wall.
      half_extent: half the edge of the cube, world units.
      centre: centre of the cube, world units; `None` for the origin.
    """

    texture: Texture
    normals: Float[Array, "walls 3"]
    u_axes: Float[Array, "walls 3"]
    v_axes: Float[Array, "walls 3"]
    half_extent: Float[Array, ""]
    centre: Float[Array, "3"] | None = None


class SphereBackground(NamedTuple):
    """Background sphere: a sphere around a centre with an equirectangular image.

    The image is indexed by the direction from the centre to the sphere, as in `Environment`.

    Attributes:
      texture: one image.
      radius: radius of the sphere, world units.
      centre: centre of the sphere, world units; `None` for the origin.
    """

    texture: Texture
    radius: Float[Array, ""]
    centre: Float[Array, "3"] | None = None


class Environment(NamedTuple):
    """Environment map: an equirectangular image at infinity.

    A unit direction maps to `u = 0.5 - atan2(y, x) / (2 pi)`, `v = 0.5 + asin(z) / pi`: the middle
    column is `+x`, and the seam is `-x`.

    Attributes:
      texture: one image.
    """

    texture: Texture


Background = CubeBackground | SphereBackground | Environment


class _Neighbours(NamedTuple):
    """The two rows, or columns, on both sides of a position.

    Attributes:
      low, high: indices of the rows or columns.
      fraction: position between `low` (0) and `high` (1).
    """

    low: Int[Array, ""]
    high: Int[Array, ""]
    fraction: Float[Array, ""]


def radiance_of(background: Background) -> Radiance:
    """Returns a background as a function of one ray, for `render_known`.

    The function is a pytree with the arrays of the background, so that compiled programs take them
    as arguments.

    Example:
      >>> import jax.numpy as jnp
      >>> from refref_jax.render import Environment, LinearTexture, radiance_of
      >>> grey = radiance_of(Environment(LinearTexture(jnp.full((2, 4, 3), 0.5))))
      >>> grey(jnp.zeros(3), jnp.array([0.0, 1.0, 0.0])).tolist()
      [0.5, 0.5, 0.5]
    """
    functions = {
        CubeBackground: cube_radiance,
        SphereBackground: sphere_radiance,
        Environment: environment_radiance,
    }
    return jax.tree_util.Partial(functions[type(background)], background)


def cube_radiance(
    background: CubeBackground, origin: Float[Array, "3"], direction: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Returns the radiance along a ray inside the cube, at the wall through which it leaves.

    A ray that starts on or beyond a wall and points away from the cube sees that wall at its
    origin; a ray that starts outside and points to the cube sees the far wall through the near one,
    or the border of a wall if it misses the cube. Images repeat beyond the border of a wall for the
    last half texel, as in Cycles. A zero direction sees the first wall at the origin of the ray.
    """
    origin = _from_centre(background, origin)
    dot_all = jax.vmap(numerics.dot, in_axes=(0, None))
    gaps = background.half_extent - dot_all(background.normals, origin)
    distances = numerics.time_to_close(gaps, dot_all(background.normals, direction))
    wall = jnp.argmin(distances)
    reached = jnp.isfinite(distances[wall])
    distance = jnp.where(reached, distances[wall], 0.0)
    point = (origin + distance * direction) / background.half_extent
    u = jnp.clip(0.5 * (numerics.dot(point, background.u_axes[wall]) + 1.0), 0.0, 1.0)
    v = jnp.clip(0.5 * (numerics.dot(point, background.v_axes[wall]) + 1.0), 0.0, 1.0)
    height, width = background.texture.texels.shape[-3:-1]
    rows, columns = _repeated((1.0 - v) * height - 0.5, height), _repeated(u * width - 0.5, width)
    return _interpolate(background.texture, (wall,), rows, columns)


def sphere_radiance(
    background: SphereBackground, origin: Float[Array, "3"], direction: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Returns the radiance along a ray inside the sphere, at the point where it leaves.

    A ray that starts outside and misses the sphere sees the nearest point of its line to the
    centre; a ray with the sphere behind it sees the point where its line leaves the sphere.
    Gradients are finite everywhere; if the line is tangent to the sphere, the gradient of the
    distance is 0 (`numerics.safe_sqrt`).
    """
    origin = _from_centre(background, origin)
    middle, half = chord(background.radius, origin, direction)
    return _look(background.texture, origin + (middle + half) * direction)


def environment_radiance(
    background: Environment, origin: Float[Array, "3"], direction: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Returns the radiance of an environment along a ray; its origin has no effect."""
    del origin
    return _look(background.texture, direction)


def shade(paths: LightPaths | PathEnds, radiance: Radiance, *, rays: int) -> Float[Array, "rays 3"]:
    """Returns the linear RGB of rays: the sum over their paths of throughput times radiance.

    This is a pure function, for use under jit, vmap and differentiation: with respect to the
    radiance function's parameters, and to paths that have gradients (`follow_branch`,
    `follow_main_branches`).

    Args:
      paths: paths of these rays, along one axis, or a single path. If `trace` or `follow_branch`
        was mapped, map this function too.
      radiance: function of origin and direction that returns linear RGB; it is evaluated at the
        last segment of every path.
      rays: number of rays that the paths belong to.

    Raises:
      ValueError: if the paths have more than one axis, the radiance function does not return
        three numbers, or the radiance of an opaque part is unknown.

    Example:
      >>> import numpy as np
      >>> import refref_jax
      >>> from refref_jax.render import shade
      >>> ray = refref_jax.Rays(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.full(1, 1e-3))
      >>> empty = refref_jax.assemble([])
      >>> paths = refref_jax.trace(empty, ray, settings=refref_jax.PATH_PRESETS["straight"]).paths
      >>> shade(paths, lambda origin, direction: 0.5 + 0.5 * direction, rays=1).tolist()
      [[0.5, 0.5, 1.0]]
    """
    if paths.statuses.ndim > 1:
        raise ValueError(
            f"The paths have the axes {paths.statuses.shape}, but one axis is expected. Apply "
            "jax.vmap to shade as well as to the function that traced the paths."
        )
    if paths.statuses.ndim == 0:
        paths = jax.tree.map(lambda x: x[None], paths)
    ends = light_paths.ends_of(paths) if isinstance(paths, LightPaths) else paths
    exists = light_paths.exists(ends)
    # Empty slots use the segment of the first path, so that the input of radiance is valid.
    held = jnp.where(exists, jnp.arange(exists.shape[0], dtype=jnp.int32), 0)
    ends = jax.tree.map(lambda x: x[held], ends)
    return jax.ops.segment_sum(_light(radiance, ends, exists), ends.rays, num_segments=rays)


def sum_light(radiance: Radiance, ends: PathEnds, rays: int) -> Float[Array, "rays 3"]:
    """Returns the linear RGB of each ray, evaluated in chunks up to the last path.

    The list usually has many empty slots, and a texture lookup costs about as much as casting a
    ray.
    """
    slots = ends.rays.shape[0]
    chunk = min(_CHUNK, slots)
    count = jnp.sum(light_paths.exists(ends), dtype=jnp.int32)

    def add(state: tuple[Array, Array]) -> tuple[Array, Array]:
        start, linear = state
        index = start + jnp.arange(chunk, dtype=jnp.int32)
        part = jax.tree.map(lambda x: x[jnp.minimum(index, slots - 1)], ends)
        light = _light(radiance, part, index < count)
        return start + chunk, linear.at[part.rays].add(light)

    begin = jnp.zeros((), jnp.int32), jnp.zeros((rays, 3), ends.throughput.dtype)
    return jax.lax.while_loop(lambda state: state[0] < count, add, begin)[1]


def _from_centre(
    background: CubeBackground | SphereBackground, point: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Returns a point relative to the centre of a background."""
    return point if background.centre is None else point - background.centre


def _look(texture: Texture, towards: Float[Array, "3"]) -> Float[Array, "3"]:
    """Looks up an equirectangular image in a direction of any length.

    The elevation is computed as `atan2(z, sqrt(x^2 + y^2))`, which is as precise at the poles as
    elsewhere, unlike `asin(z)`. Exactly at a pole, `u` is 0.5, with gradient 0. Columns wrap
    around; beyond the centres of the first and the last row the image is constant.
    """
    azimuth = numerics.safe_atan2(towards[1], towards[0])
    elevation = numerics.safe_atan2(towards[2], numerics.length(towards[:2]))
    u, v = 0.5 - azimuth / (2.0 * jnp.pi), 0.5 + elevation / jnp.pi
    height, width = texture.texels.shape[-3:-1]
    rows, columns = _held((1.0 - v) * height - 0.5, height), _repeated(u * width - 0.5, width)
    return _interpolate(texture, (), rows, columns)


def _repeated(position: Float[Array, ""], size: int) -> _Neighbours:
    """Returns the neighbours of a position, with wrap-around."""
    low = jnp.floor(position)
    index = low.astype(jnp.int32)
    return _Neighbours(index % size, (index + 1) % size, position - low)


def _held(position: Float[Array, ""], size: int) -> _Neighbours:
    """Returns the neighbours of a position, clamped to the ends."""
    held = jnp.clip(position, 0.0, size - 1.0)
    low = jnp.floor(held)
    index = low.astype(jnp.int32)
    return _Neighbours(index, jnp.minimum(index + 1, size - 1), held - low)


def _interpolate(
    texture: Texture, image: tuple[Int[Array, ""], ...], rows: _Neighbours, columns: _Neighbours
) -> Float[Array, "3"]:
    """Returns the bilinear interpolation of four texels of one of the images, as linear RGB."""
    texels = texture.texels
    # One gather with the full index, so that images are not copied for each ray.
    upper, lower = (
        _mix(texels[(*image, row, columns.low)], texels[(*image, row, columns.high)], columns)
        for row in (rows.low, rows.high)
    )
    colours = _mix(upper, lower, rows)
    return pixels.srgb_to_linear(colours) if isinstance(texture, SrgbTexture) else colours


def _mix(low: Float[Array, "3"], high: Float[Array, "3"], at: _Neighbours) -> Float[Array, "3"]:
    return low + at.fraction * (high - low)


def _light(
    radiance: Radiance, ends: PathEnds, real: Bool[Array, " paths"]
) -> Float[Array, "paths 3"]:
    """Returns the contribution of each path to its ray; 0 for paths that are not `real`."""
    seen = _seen(radiance, ends)
    if seen.shape != ends.directions.shape:
        raise ValueError(
            f"The radiance function returned an array of shape {seen.shape[1:]} for one ray. "
            "Return linear RGB, of shape (3,)."
        )
    if ends.stop is not None:
        if ends.stop.radiance is None:
            raise ValueError(
                "Light may end on a part whose radiance is unknown. Give every opaque part a "
                "radiance in scene.json, or train a field."
            )
        seen = jnp.where(jnp.isfinite(ends.stop.tau)[:, None], ends.stop.radiance, seen)
    return jnp.where(real[:, None], ends.throughput * seen.astype(ends.throughput.dtype), 0.0)


def _seen(radiance: Radiance, ends: PathEnds) -> Array:
    """Returns the radiance at the end of each path.

    It is the mean over four places of the path's footprint, if ray differentials are carried.
    """
    look = jax.vmap(radiance)
    if ends.differentials.points.shape[1] == 0:
        return look(ends.origins, ends.directions)

    exact = functools.partial(jnp.einsum, precision=jax.lax.Precision.HIGHEST)

    def look_beside(offset: Float[Array, "2"]) -> Array:
        moved = jax.tree.map(lambda axes: exact("a,pax->px", offset, axes), ends.differentials)
        directions = jax.vmap(numerics.normalize)(ends.directions + moved.directions)
        return look(ends.origins + moved.points, directions)

    return jnp.mean(jax.lax.map(look_beside, jnp.asarray(_QUADRANTS, ends.tau.dtype)), axis=0)
