"""The far field as a surface: a cube, a sphere or an environment with learned radiance.

Where the world behind the objects is a surface at a known place, a pixel is a linear function of
the radiance on that surface: the sum over its light paths of throughput times radiance. This module
maps the ends of light paths to points of the surface (`locate`), and evaluates the linear function
(`colours`) and its transpose (`transposed`).

The surface is a cube map: six faces with a grid of `n + 1` by `n + 1` vertices each, between which
radiance is interpolated bilinearly. The faces of a cube are separate images; those of a sphere (by
direction from its centre) and of an environment (by direction of the light) are indexed through
equal angles and share the vertices of common edges: there are neither seams nor poles.

The unknowns are a pyramid: the radiance is the sum of the bilinear interpolations of all levels,
each with half the resolution of the next. A coarse level is determined by many pixels and fills
the gaps of the finer ones, where no light path ends.

The radiance may be linear in the direction of light: a vertex then holds nine derivatives as well.

A pixel is a square: its light path is shifted by the ray differential to several places of the
pixel (`taps`), and a footprint wider than that reads a coarser level of a mipmap.

Sources: Igehy, Tracing Ray Differentials (1999); for the sum over levels Bramble, Pasciak and Xu,
Parallel Multilevel Preconditioners (1990).
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from refref_jax import numerics
from refref_jax.choices import Space
from refref_jax.compilation import native_loop, record, with_record
from refref_jax.geometry.rays import chord
from refref_jax.optics.light_paths import PathEnds
from refref_jax.sampling import scene_bounds
from refref_jax.sampling.scene_bounds import Domain

FACES = 6

# Number of cells per side below which a level is not halved again.
_COARSEST = 4

# Width of a pixel per cone radius: a square has the variance of a disc of this radius.
_PIXEL_WIDTH = math.sqrt(3.0)

# XLA unrolls loops over fewer paths, and aborts if a native loop has none left.
_FEW = 64

FAINT = 0.1
"""Throughput below which one tap determines the radiance."""

# A footprint this wide, in cells, covers the surface; near the critical angle it is unbounded.
_WIDEST = 1e6

Pyramid = tuple[Float[Array, "6 _ _ channels"], ...]
"""Radiance of each level, coarse to fine; linear RGB, then its derivatives by the direction."""
Mips = tuple[Float[Array, "6 _ _ channels"], ...]
"""The same at each resolution, fine to coarse."""


class Lookups(NamedTuple):
    """Points of the surface that light paths end on; lengths are in cells of the resolution read.

    Attributes:
      pixels: index of the pixel that each path belongs to.
      entries: first vertex of the face, in a list of the vertices of all resolutions.
      sides: number of cells per side of the face.
      taps: number of taps along both axes of the pixel, 0 for empty slots.
      starts: position of the first tap, column and row of the grid.
      steps: change of the position from tap to tap, along both axes.
      throughput: throughput of the path, linear RGB.
      directions: direction of the light's path, if the radiance depends on it.
    """

    pixels: Int[Array, "*paths"]
    entries: Int[Array, "*paths"]
    sides: Int[Array, "*paths"]
    taps: Int[Array, "*paths 2"]
    starts: Float[Array, "*paths 2"]
    steps: Float[Array, "*paths 2 2"]
    throughput: Float[Array, "*paths 3"]
    directions: Float[Array, "*paths axes"]


def sides(resolution: int) -> tuple[int, ...]:
    """Returns the number of cells per side of each level, coarse to fine."""
    found = [resolution]
    while found[-1] % 2 == 0 and found[-1] // 2 >= _COARSEST:
        found.append(found[-1] // 2)
    return tuple(reversed(found))


def init(resolution: int, *, radiance: Float[Array, "3"] | float = 0.0, axes: int = 0) -> Pyramid:
    """Returns a surface of uniform radiance.

    Args:
      resolution: number of cells per side of a face.
      radiance: linear RGB.
      axes: number of axes of the direction that the radiance may depend on, 0 or 3.
    """
    shapes = [(FACES, side + 1, side + 1, 3 + 3 * axes) for side in sides(resolution)]
    base = jnp.zeros(shapes[0]).at[..., :3].set(radiance)
    return (base, *(jnp.zeros(shape) for shape in shapes[1:]))


def locate(
    domain: Domain,
    ends: PathEnds,
    pixels: Int[Array, " paths"],
    *,
    resolution: int,
    most_taps: int,
    axes: int = 0,
    faint: float | Float[Array, ""] = FAINT,
) -> Lookups:
    """Returns where light paths end on the surface.

    Args:
      domain: scene bounds; their `space` is the kind of the surface.
      ends: last segments of the paths. Paths without ray differentials have one tap.
      pixels: index of the pixel that each path belongs to.
      resolution: number of cells per side of a face.
      most_taps: largest number of taps along each axis of a pixel.
      axes: number of axes of the direction that the radiance depends on.
      faint: throughput below which a path has only one tap.
    """
    faces, places, across = jax.vmap(functools.partial(_place, domain))(
        ends.origins, ends.directions, ends.differentials.points, ends.differentials.directions
    )
    half = 0.5 * resolution
    across = jnp.clip(_PIXEL_WIDTH * half * across, -_WIDEST, _WIDEST)
    widths = jnp.sqrt(jnp.sum(jnp.square(across), axis=-1))
    brightest = jnp.max(ends.throughput, axis=-1)
    most = jnp.where(brightest < faint, 1, most_taps)
    coarser = jnp.round(jnp.log2(jnp.maximum(jnp.max(widths, axis=-1) / most, 1.0)))
    levels = jnp.minimum(coarser.astype(jnp.int32), len(sides(resolution)) - 1)
    first, side = jnp.unstack(jnp.asarray(_grids(resolution))[levels], axis=-1)
    scale = jnp.exp2(-levels.astype(across.dtype))
    taps = jnp.clip(jnp.ceil(scale[:, None] * widths), 1, most[:, None])
    steps = across * (scale[:, None] / taps)[..., None]
    middle = jnp.sum(0.5 * (taps - 1.0)[..., None] * steps, axis=1)
    return Lookups(
        pixels=pixels,
        entries=first + faces * (side + 1) ** 2,
        sides=side,
        taps=jnp.where(brightest[:, None] > 0.0, taps.astype(jnp.int32), 0),
        starts=(half * scale)[:, None] * (places + 1.0) - middle,
        steps=steps,
        throughput=ends.throughput,
        directions=ends.directions[:, :axes],
    )


def _place(
    domain: Domain,
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    points: Float[Array, "axes 3"],
    directions: Float[Array, "axes 3"],
) -> tuple[Int[Array, ""], Float[Array, "2"], Float[Array, "2 2"]]:
    """Returns a ray's face and its place there in `[-1, 1]`, with derivatives across the pixel."""
    towards = to_surface(domain, origin, direction)
    axis = jnp.argmax(jnp.abs(towards)).astype(jnp.int32)
    face = 2 * axis + (towards[axis] > 0.0).astype(jnp.int32)

    place = functools.partial(place_on_face, domain, axis)
    if points.shape[0] == 0:
        return face, place(origin, direction), jnp.zeros((2, 2), origin.dtype)
    at, push = jax.linearize(place, origin, direction)
    return face, at, jax.vmap(push)(points, directions)


def place_on_face(
    domain: Domain, axis: Int[Array, ""], origin: Float[Array, "3"], direction: Float[Array, "3"]
) -> Float[Array, "2"]:
    """Returns where a ray meets a face of the surface, in `[-1, 1]` along both of its edges.

    The face is that across `axis` ahead of the ray, whose origin is in world units.
    """
    towards = to_surface(domain, origin, direction, axis=axis)
    major = jnp.abs(towards[axis])
    others = jnp.stack([towards[(axis + 1) % 3], towards[(axis + 2) % 3]])
    ratio = numerics.safe_divide(others, jnp.broadcast_to(major, others.shape))
    return ratio if domain.space == "bounded" else (4.0 / jnp.pi) * jnp.arctan(ratio)


def to_surface(
    domain: Domain,
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    *,
    axis: Int[Array, ""] | None = None,
) -> Float[Array, "3"]:
    """Returns the vector from the centre to the surface; of a cube's plane, if `axis` is given."""
    if domain.space == "unbounded":
        return direction
    from_centre = origin - jnp.asarray(domain.centre, origin.dtype)
    if axis is not None and domain.space == "bounded":
        wall = jnp.where(direction[axis] > 0.0, domain.radius, -domain.radius)
        distance = numerics.safe_divide(wall - from_centre[axis], direction[axis])
        return from_centre + distance * direction
    if domain.space == "spherical":
        middle, half = chord(domain.radius, from_centre, direction)
        return from_centre + (middle + half) * direction
    distance = scene_bounds.exit_distance(domain, origin, direction)
    return from_centre + jnp.where(jnp.isfinite(distance), distance, 0.0) * direction


def mipmap(pyramid: Pyramid, space: Space) -> Mips:
    """Returns the radiance at all resolutions, fine to coarse: the sum of the levels, then halved.

    Args:
      pyramid: radiance of each level.
      space: kind of the surface, `bounded` for a cube, whose faces are separate.
    """
    total = pyramid[0]
    for level in pyramid[1:]:
        total = _refine(total) + level
    mips = [_joined(total, space)]
    for _ in pyramid[1:]:
        mips.append(_joined(_halve(mips[-1]), space))
    return tuple(mips)


def _refine(grid: Float[Array, "6 side side channels"]) -> Float[Array, "6 finer finer channels"]:
    """Returns the bilinear interpolation of a grid at the vertices of one twice as fine."""
    zero = jnp.zeros((), grid.dtype)
    for axis in (1, 2):
        dilated = jax.lax.pad(grid, zero, [(0, 0, int(n == axis)) for n in range(4)])
        wider = jax.lax.pad(dilated, zero, [(int(n == axis),) * 2 + (0,) for n in range(4)])
        beside = _every(wider, axis, 0, -2, 1) + _every(wider, axis, 2, None, 1)
        grid = dilated + 0.5 * beside
    return grid


def _halve(
    grid: Float[Array, "6 side side channels"],
) -> Float[Array, "6 coarser coarser channels"]:
    """Returns weighted means at every second vertex: 1/4, 1/2, 1/4, or 2/3, 1/3 at an edge."""
    zero = jnp.zeros((), grid.dtype)
    for axis in (1, 2):
        wider = jax.lax.pad(grid, zero, [(int(n == axis),) * 2 + (0,) for n in range(4)])
        beside = _every(wider, axis, 0, -1, 2) + _every(wider, axis, 2, None, 2)
        count = (grid.shape[axis] + 1) // 2
        share = jnp.ones(count, grid.dtype).at[jnp.array([0, count - 1])].set(4.0 / 3.0)
        mean = 0.5 * _every(grid, axis, 0, None, 2) + 0.25 * beside
        grid = mean * share.reshape([-1 if n == axis else 1 for n in range(4)])
    return grid


def _every(grid: Array, axis: int, start: int, stop: int | None, stride: int) -> Array:
    """Returns a slice along one axis."""
    return grid[tuple(slice(start, stop, stride) if n == axis else slice(None) for n in range(4))]


def _joined(
    grid: Float[Array, "6 side side channels"], space: Space
) -> Float[Array, "6 side side channels"]:
    """Returns a grid whose faces agree on their common edges, unless it is a cube's."""
    if space == "bounded":
        return grid
    where, groups = _edges(grid.shape[1] - 1)
    rows = grid.reshape(-1, grid.shape[-1])
    sums = jax.ops.segment_sum(rows[where], groups, num_segments=int(groups.max()) + 1)
    shares = np.bincount(groups).astype(np.float32)[:, None]
    means = (sums / shares)[groups]
    return rows.at[where].set(means, unique_indices=True).reshape(grid.shape)


@functools.lru_cache(maxsize=64)
def _edges(side: int) -> tuple[Int[np.ndarray, " edges"], Int[np.ndarray, " edges"]]:
    """Returns the vertices on edges of the cube map, and a number for each point of the edges."""
    row, column = np.mgrid[: side + 1, : side + 1]
    corners = []
    for face in range(FACES):
        axis, positive = divmod(face, 2)
        point = np.empty((side + 1, side + 1, 3), np.int64)
        point[..., axis] = side * positive
        point[..., (axis + 1) % 3], point[..., (axis + 2) % 3] = column, row
        corners.append(point)
    points = np.stack(corners).reshape(-1, 3)
    where = np.flatnonzero(np.sum((points == 0) | (points == side), axis=1) > 1)
    _, groups = np.unique(points[where], axis=0, return_inverse=True)
    return where, groups.reshape(-1).astype(np.int32)


def _table(mips: Mips) -> Float[Array, "texels channels"]:
    """Returns the radiance of all resolutions as one list."""
    return jnp.concatenate([mip.reshape(-1, mip.shape[-1]) for mip in mips])


def _grids(resolution: int) -> Int[np.ndarray, "levels 2"]:
    """Returns the first entry in the list, and the number of cells per side, of each resolution."""
    fine_to_coarse = sides(resolution)[::-1]
    sizes = [FACES * (side + 1) ** 2 for side in fine_to_coarse]
    first = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    return np.stack([first, fine_to_coarse], axis=-1).astype(np.int32)


def _corners(
    lookups: Lookups, along: Int[Array, "*paths"], across: Int[Array, "*paths"]
) -> list[tuple[Int[Array, "*paths"], Float[Array, "*paths"]]]:
    """Returns entry and bilinear weight of the four vertices around one tap of a light path.

    A tap beyond the edge of its face stays on it.
    """
    precision = lookups.starts.dtype
    shifts = [n.astype(precision)[..., None] for n in (along, across)]
    place = (
        lookups.starts + shifts[0] * lookups.steps[..., 0, :] + shifts[1] * lookups.steps[..., 1, :]
    )
    side = lookups.sides[..., None]
    place = jnp.clip(place, 0.0, side.astype(precision))
    cell = jnp.minimum(place.astype(jnp.int32), side - 1)
    (column, row), part = jnp.unstack(cell, axis=-1), place - cell.astype(precision)
    (right, up), stride = jnp.unstack(part, axis=-1), lookups.sides + 1
    entry = lookups.entries + row * stride + column
    return [
        (entry, (1.0 - right) * (1.0 - up)),
        (entry + 1, right * (1.0 - up)),
        (entry + stride, (1.0 - right) * up),
        (entry + stride + 1, right * up),
    ]


def _mean(lookups: Lookups) -> Float[Array, "*paths 3"]:
    """Returns the share of the throughput that each tap of a path has."""
    count = jnp.maximum(jnp.prod(lookups.taps, axis=-1, keepdims=True), 1)
    return lookups.throughput / count.astype(lookups.starts.dtype)


def _seen_along(
    lookups: Lookups, values: Float[Array, "*paths channels"]
) -> Float[Array, "*paths 3"]:
    """Returns the radiance along paths, of values at the points that they end on."""
    each = [values[..., 3 * n : 3 * n + 3] for n in range(values.shape[-1] // 3)]
    return sum((lookups.directions[..., n, None] * x for n, x in enumerate(each[1:])), each[0])


def _along(lookups: Lookups, slopes: Float[Array, "*paths 3"]) -> Float[Array, "*paths channels"]:
    """Returns the transpose of `_seen_along`."""
    axes = range(lookups.directions.shape[-1])
    return jnp.concatenate([slopes, *(lookups.directions[..., n, None] * slopes for n in axes)], -1)


def radiance(mips: Mips, lookups: Lookups) -> Float[Array, "paths 3"]:
    """Returns the linear RGB radiance that each path sees; its throughput does not matter."""
    count = lookups.pixels.shape[0]
    numbers = jnp.arange(count, dtype=jnp.int32)
    each = lookups._replace(pixels=numbers, throughput=jnp.ones_like(lookups.throughput))
    return _colours(count, mips, each)


def colours(mips: Mips, lookups: Lookups, *, pixels: int) -> Float[Array, "pixels 3"]:
    """Returns the linear RGB of pixels: their paths' sum of throughput times radiance.

    Its gradients are those by the radiance and the throughput; places and footprints are constants.

    Args:
      mips: radiance at all resolutions (`mipmap`).
      lookups: points of the surface that the paths end on.
      pixels: number of pixels.
    """
    return _colours(pixels, mips, lookups)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _colours(pixels: int, mips: Mips, lookups: Lookups) -> Float[Array, "pixels 3"]:
    return jax.lax.platform_dependent(
        _table(mips),
        lookups,
        cpu=functools.partial(_read if lookups.pixels.size < _FEW else _read_native, pixels),
        default=functools.partial(_read, pixels),
    )


def _colours_forward(
    pixels: int, mips: Mips, lookups: Lookups
) -> tuple[Array, tuple[Mips, Lookups]]:
    return _colours(pixels, mips, lookups), (mips, lookups)


def _colours_backward(_: int, saved: tuple[Mips, Lookups], slopes: Array) -> tuple[Mips, Lookups]:
    mips, lookups = saved
    by_throughput = radiance(mips, lookups) * slopes[lookups.pixels]
    # Nothing is the gradient of a constant.
    nothing = jax.tree.map(lambda constant: None, lookups)
    by_radiance = transposed(slopes, lookups, resolution=mips[0].shape[1] - 1)
    return by_radiance, nothing._replace(throughput=by_throughput)


_colours.defvjp(_colours_forward, _colours_backward)


def transposed(slopes: Float[Array, "pixels 3"], lookups: Lookups, *, resolution: int) -> Mips:
    """Returns the transpose of `colours`: what factors of pixels add to the vertices they read."""
    grids = _grids(resolution)
    entries = int(grids[-1, 0] + FACES * (grids[-1, 1] + 1) ** 2)
    table = jax.lax.platform_dependent(
        slopes,
        lookups,
        cpu=functools.partial(_add if lookups.pixels.size < _FEW else _add_native, entries),
        default=functools.partial(_add, entries),
    )
    shapes = [(FACES, side + 1, side + 1, table.shape[1]) for side in sides(resolution)[::-1]]
    parts = jnp.split(table, grids[1:, 0])
    return tuple(part.reshape(shape) for part, shape in zip(parts, shapes, strict=True))


def _read(pixels: int, table: Array, lookups: Lookups) -> Float[Array, "pixels 3"]:
    """Returns the colours of pixels, one tap of all paths at a time."""
    counts = jnp.prod(lookups.taps, axis=-1)
    across = jnp.maximum(lookups.taps[..., 1], 1)

    def add(tap: Array, seen: Array) -> Array:
        corners = _corners(lookups, tap // across, tap % across)
        light = sum(weight[:, None] * table[entry] for entry, weight in corners)
        return seen + jnp.where((tap < counts)[:, None], light, 0.0)

    most = jnp.max(counts, initial=0)
    start = jnp.zeros((counts.size, table.shape[1]), table.dtype)
    seen = _seen_along(lookups, jax.lax.fori_loop(0, most, add, start))
    return jax.ops.segment_sum(_mean(lookups) * seen, lookups.pixels, num_segments=pixels)


def _add(entries: int, slopes: Array, lookups: Lookups) -> Float[Array, "entries channels"]:
    """Returns the transpose of `_read`."""
    slope = _along(lookups, _mean(lookups) * slopes[lookups.pixels])
    counts = jnp.prod(lookups.taps, axis=-1)
    across = jnp.maximum(lookups.taps[..., 1], 1)

    def add(tap: Array, table: Array) -> Array:
        used = jnp.where((tap < counts)[:, None], slope, 0.0)
        for entry, weight in _corners(lookups, tap // across, tap % across):
            table = table.at[entry].add(weight[:, None] * used)
        return table

    table = jnp.zeros((entries, slope.shape[1]), slopes.dtype)
    return jax.lax.fori_loop(0, jnp.max(counts, initial=0), add, table)


def _read_native(pixels: int, table: Array, lookups: Lookups) -> Array:
    """Computes `_read` in one native loop over paths."""

    @native_loop
    def read_all(table: Array, lookups: Lookups) -> Array:
        def read(index: Array, seen: Array) -> Array:
            look = record(lookups, index)

            def add(along: Array, across: Array, total: Array) -> Array:
                corners = _corners(look, along, across)
                return total + sum(weight * record(table, entry) for entry, weight in corners)

            values = _over_taps(look, add, jnp.zeros(table.shape[1], table.dtype))
            light = _mean(look) * _seen_along(look, values)
            return with_record(seen, look.pixels, record(seen, look.pixels) + light)

        start = jnp.zeros((pixels, 3), table.dtype)
        return jax.lax.fori_loop(0, lookups.pixels.shape[0], read, start)

    return read_all(table, lookups)


def _add_native(entries: int, slopes: Array, lookups: Lookups) -> Array:
    """Computes `_add` in one native loop over paths."""

    @native_loop
    def add_all(slopes: Array, lookups: Lookups) -> Array:
        def add(index: Array, table: Array) -> Array:
            look = record(lookups, index)
            slope = _along(look, _mean(look) * record(slopes, look.pixels))

            def spread(along: Array, across: Array, table: Array) -> Array:
                for entry, weight in _corners(look, along, across):
                    table = with_record(table, entry, record(table, entry) + weight * slope)
                return table

            return _over_taps(look, spread, table)

        channels = 3 + 3 * lookups.directions.shape[1]
        start = jnp.zeros((entries, channels), slopes.dtype)
        return jax.lax.fori_loop(0, lookups.pixels.shape[0], add, start)

    return add_all(slopes, lookups)


def _over_taps(look: Lookups, body: Callable[[Array, Array, Array], Array], start: Array) -> Array:
    """Returns the result of a loop over the taps of one path, along both axes."""

    def line(along: Array, carried: Array) -> Array:
        return jax.lax.fori_loop(0, look.taps[1], functools.partial(body, along), carried)

    return jax.lax.fori_loop(0, look.taps[0], line, start)
