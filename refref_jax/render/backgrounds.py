"""What light sees where it comes from, when that is known: textured walls and environments.

A background is a record of arrays; `*_radiance` is what one ray sees of it, in linear RGB. `u` goes
from 0 at an image's left edge to 1 at its right, `v` from 0 at its *bottom* to 1 at its top, and
pixel `(row, column)` of `[h, w]` has its centre at `u = (column + 0.5) / w`,
`v = 1 - (row + 0.5) / h`. Between centres colours are bilinear. The world is that of the rays, with
z up.

Everything is differentiable with respect to ray and texels; a texel's border and a cube's edge are
kinks. `radiance_of` makes a background what `render_known` takes.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from refref_jax import numerics
from refref_jax.render import colour
from refref_jax.sampling import domains

Radiance = Callable[[Float[Array, "3"], Float[Array, "3"]], Float[Array, "3"]]
"""What one ray sees: from origin and unit direction, world units, to linear RGB."""


class SrgbTexture(NamedTuple):
    """Images that are stored as sRGB.

    They are interpolated as they are stored and decoded afterwards, as Blender Cycles does with
    8-bit images; the other order is off by up to 0.1 between texels.

    Attributes:
      texels: sRGB, row 0 at the top.
    """

    texels: Float[Array, "*images h w 3"]


class LinearTexture(NamedTuple):
    """Images that are stored as linear RGB.

    Attributes:
      texels: linear RGB, row 0 at the top.
    """

    texels: Float[Array, "*images h w 3"]


Texture = SrgbTexture | LinearTexture


class CubeBackground(NamedTuple):
    """Six square walls around the origin, each with an image.

    A wall's point is `half_extent (normal + (2u - 1) u_axis + (2v - 1) v_axis)`.

    Attributes:
      texture: one image a wall, all of one size.
      normals: of the walls, outward, unit.
      u_axes: direction of growing `u` on each wall, unit.
      v_axes: direction of growing `v`.
      half_extent: half the cube's edge, world units.
    """

    texture: Texture
    normals: Float[Array, "walls 3"]
    u_axes: Float[Array, "walls 3"]
    v_axes: Float[Array, "walls 3"]
    half_extent: Float[Array, ""]


class SphereBackground(NamedTuple):
    """A sphere around the origin with an equirectangular image.

    The image is laid out by the direction from the origin to the wall, as an `Environment`'s.

    Attributes:
      texture: one image.
      radius: of the sphere, world units.
    """

    texture: Texture
    radius: Float[Array, ""]


class Environment(NamedTuple):
    """An equirectangular image, infinitely far away.

    A unit direction sees `u = 0.5 - atan2(y, x) / (2 pi)`, `v = 0.5 + asin(z) / pi`: the middle
    column is `+x`, and `-x` the seam.

    Attributes:
      texture: one image.
    """

    texture: Texture


Background = CubeBackground | SphereBackground | Environment


class _Neighbours(NamedTuple):
    """The two rows, or columns, that a position lies between.

    Attributes:
      low, high: their indices.
      fraction: how far from `low` to `high`.
    """

    low: Int[Array, ""]
    high: Int[Array, ""]
    fraction: Float[Array, ""]


def radiance_of(background: Background) -> Radiance:
    """Returns a background as a function of one ray, for `render_known`.

    The function is a pytree whose arrays are the background's, so that compiled programs take them
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
    """Returns what a ray inside the cube sees: the wall through which it leaves.

    A ray that starts on a wall or beyond it and goes away from the cube sees that wall where it
    stands; one that starts beyond and looks back sees the far wall through the near one, and a
    wall's border where it misses the cube. The image repeats over a wall's border for the last half
    of a texel, as Cycles has it. A zero direction sees the first wall where it stands.
    """
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
    """Returns what a ray inside the sphere sees: the point where it leaves.

    A ray that starts outside and misses the sphere, or has it behind, sees the point of its line
    that is nearest to the origin, or where its line left. Gradients are finite everywhere; where
    the line only touches the sphere the distance to it has gradient 0 (`numerics.safe_sqrt`).
    """
    middle, half = domains.chord(background.radius, origin, direction)
    return _look(background.texture, origin + (middle + half) * direction)


def environment_radiance(
    background: Environment, origin: Float[Array, "3"], direction: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Returns what a ray sees of an environment, wherever it starts."""
    del origin
    return _look(background.texture, direction)


def _look(texture: Texture, towards: Float[Array, "3"]) -> Float[Array, "3"]:
    """Looks up an equirectangular image in a direction of any length.

    The elevation is formed from both legs, `atan2(z, sqrt(x^2 + y^2))`, which is as precise at the
    poles as elsewhere, where `asin(z)` is not. Exactly at a pole `u` is 0.5, with gradient 0.
    Columns wrap around; beyond the middle of the first and the last row the image is constant.
    """
    azimuth = numerics.safe_atan2(towards[1], towards[0])
    elevation = numerics.safe_atan2(towards[2], numerics.length(towards[:2]))
    u, v = 0.5 - azimuth / (2.0 * jnp.pi), 0.5 + elevation / jnp.pi
    height, width = texture.texels.shape[-3:-1]
    rows, columns = _held((1.0 - v) * height - 0.5, height), _repeated(u * width - 0.5, width)
    return _interpolate(texture, (), rows, columns)


def _repeated(position: Float[Array, ""], size: int) -> _Neighbours:
    """Returns the neighbours on a ring."""
    low = jnp.floor(position)
    index = low.astype(jnp.int32)
    return _Neighbours(index % size, (index + 1) % size, position - low)


def _held(position: Float[Array, ""], size: int) -> _Neighbours:
    """Returns the neighbours on a line, whose ends go on for ever."""
    held = jnp.clip(position, 0.0, size - 1.0)
    low = jnp.floor(held)
    index = low.astype(jnp.int32)
    return _Neighbours(index, jnp.minimum(index + 1, size - 1), held - low)


def _interpolate(
    texture: Texture, image: tuple[Int[Array, ""], ...], rows: _Neighbours, columns: _Neighbours
) -> Float[Array, "3"]:
    """Returns the bilinear colour between four texels of one of the images, as linear RGB."""
    texels = texture.texels
    # One gather with the full index: an image is never copied for a ray.
    upper, lower = (
        _mix(texels[(*image, row, columns.low)], texels[(*image, row, columns.high)], columns)
        for row in (rows.low, rows.high)
    )
    colours = _mix(upper, lower, rows)
    return colour.srgb_to_linear(colours) if isinstance(texture, SrgbTexture) else colours


def _mix(low: Float[Array, "3"], high: Float[Array, "3"], at: _Neighbours) -> Float[Array, "3"]:
    return low + at.fraction * (high - low)
