"""Known backgrounds: textured cubes, textured spheres and environment maps.

A background is a record of arrays; the `*_radiance` functions return its linear RGB radiance along
one ray. `u` is 0 at the left edge of an image and 1 at the right, `v` is 0 at its *bottom* edge and
1 at the top, and pixel `(row, column)` of `[h, w]` has its centre at `u = (column + 0.5) / w`,
`v = 1 - (row + 0.5) / h`. Colours are interpolated bilinearly between centres. The world frame is
that of the rays, with z up.

All functions are differentiable with respect to ray and texels, with kinks at texel centres and at
the edges of a cube. `radiance_of` converts a background to a function for `render_known`.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from refref_jax import numerics
from refref_jax.render import pixels
from refref_jax.sampling import scene_bounds

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
    middle, half = scene_bounds.chord(background.radius, origin, direction)
    return _look(background.texture, origin + (middle + half) * direction)


def environment_radiance(
    background: Environment, origin: Float[Array, "3"], direction: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Returns the radiance of an environment along a ray; its origin has no effect."""
    del origin
    return _look(background.texture, direction)


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
