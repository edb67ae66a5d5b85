"""Exports the field of a trained run as PLY: a surface or points, with normals and colours.

The density is sampled on a grid. A surface is a level set of the density, computed on its
logarithm, since densities vary by orders of magnitude. It stays open at the borders of the grid.
Inside objects that the model does not sample the density is 0: the field was never trained there.
A field with a surface of its own (`--field=neus`) has a signed value in place of a density.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int, UInt8

from refref_jax.geometry.bvh import LEAF_SIZE
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surfaces import Surfaces, build_surfaces
from refref_jax.geometry.triangle_meshes import unit_vectors, vertex_vectors
from refref_jax.optics.media import Scene
from refref_jax.reconstruct import grids
from refref_jax.reconstruct.grids import Grid
from refref_jax.render import Model, pixels
from refref_jax.render.images import find_first_surface
from refref_jax.render.model import ball_of, look_up, look_up_surface

CHUNK = 1 << 15
"""Number of points per query."""

# A direction that lies in no face or edge of a synthetic object.
_ASKEW = np.array([0.48, 0.6, 0.64], np.float32)

# Densities this many factors of e below or above the level are clamped.
_RANGE = 3.0

# Marching cubes keeps values a tenth of a cell off zero, as if they were distances. A density falls
# by a factor of e over several cells: steeper values reduce the displacement of its surface.
_STEEPNESS = 4.0


class DensitySurface(NamedTuple):
    """Level set of the density, or of the signed value of a field.

    Attributes:
      vertices: positions, world units.
      faces: vertex indices, counter-clockwise seen from the side of lower density.
      normals: unit normals of the vertices, towards lower density.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "vertices 3"]


class SurfacePoints(NamedTuple):
    """Grid points on the outside of dense regions.

    Attributes:
      points: positions, world units.
      normals: unit normals, towards lower density.
    """

    points: Float[np.ndarray, "points 3"]
    normals: Float[np.ndarray, "points 3"]


def sample_density(
    model: Model,
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
    *,
    resolution: int,
    step: Callable[[int, int], None],
) -> Grid:
    """Samples the density in a box.

    Args:
      model: the trained model.
      low: least corner of the box, world units.
      high: greatest corner of the box.
      resolution: number of cells along its longest edge.
      step: callback after each slice, with the number of completed slices and of all.

    Returns:
      Density per world unit at the grid's points, 0 inside objects that are not sampled.
    """
    spacing, axes = _axes(low, high, resolution)
    counts = [len(axis) for axis in axes]
    unknown = np.zeros(counts, bool)
    if model.config.interior != "field":
        unknown = inside_objects(model.scene, axes)
    values = np.zeros(counts, np.float32)
    for i, x in enumerate(axes[0]):
        rows = np.argwhere(~unknown[i])
        points = np.stack([np.full(len(rows), x), axes[1][rows[:, 0]], axes[2][rows[:, 1]]], -1)
        density, _ = look_up_points(model, points, None, width=spacing)
        values[i, rows[:, 0], rows[:, 1]] = density
        step(i + 1, counts[0])
    return Grid(values, low, spacing)


def _axes(
    low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], resolution: int
) -> tuple[float, list[Float[np.ndarray, " ticks"]]]:
    """Returns the spacing of a box's grid, and its coordinates along each axis; world units."""
    spacing = float((high - low).max()) / resolution
    counts = np.maximum(np.rint((high - low) / spacing), 1).astype(np.int64) + 1
    return spacing, [low[i] + spacing * np.arange(counts[i]) for i in range(3)]


def look_up_points(
    model: Model,
    points: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"] | None,
    *,
    width: float,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Returns density per world unit, and sRGB colour along unit view directions.

    Args:
      model: the trained model.
      points: positions, world units.
      directions: unit view directions; `None` if colours are not needed.
      width: edge of the cell around each point, world units.
    """
    seen = _in_chunks(model, points, directions, functools.partial(_chunk, width=width))
    return seen[0], seen[1]


def _in_chunks(
    model: Model,
    points: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"] | None,
    look: Callable[..., tuple[jax.Array, ...]],
) -> list[np.ndarray]:
    """Returns what a compiled function returns for all points, as many at once as it takes."""
    if directions is None:
        directions = np.tile(_ASKEW, (len(points), 1))
    parts = []
    for start in range(0, max(len(points), 1), CHUNK):
        part = slice(start, start + CHUNK)
        count = len(points[part])
        # Padded, to avoid a second compilation.
        filled = [
            np.concatenate([each[part], np.zeros((CHUNK - count, 3))]).astype(np.float32)
            for each in (points, directions)
        ]
        seen = jax.device_get(look(model.params, *filled, config=model.config))
        parts.append([each[:count] for each in seen])
    return [np.concatenate(each) for each in zip(*parts, strict=True)]


@functools.partial(jax.jit, static_argnames="config")
def _surface_chunk(params, points, directions, *, config):
    seen = jax.vmap(look_up_surface, in_axes=(None, None, 0, 0))(params, config, points, directions)
    return seen.distance, seen.normal, jnp.clip(pixels.linear_to_srgb(seen.linear), 0.0, 1.0)


@functools.partial(jax.jit, static_argnames=("config", "width"))
def _chunk(params, points, directions, *, config, width):
    look = functools.partial(look_up, width=width)
    seen = jax.vmap(look, in_axes=(None, None, 0, 0))(params, config, points, directions)
    return seen.density, jnp.clip(pixels.linear_to_srgb(seen.linear), 0.0, 1.0)


def sample_surface(
    model: Model,
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
    *,
    resolution: int,
    step: Callable[[int, int], None],
) -> Grid:
    """Samples the signed value of a field with a surface; arguments as in `sample_density`.

    Returns:
      Signed value in world units, positive on the border of the grid, where it is cut off.

    Raises:
      ValueError: if the field has no surface in the box.
    """
    spacing, axes = _axes(low, high, resolution)
    counts = [len(axis) for axis in axes]
    values = np.zeros(counts, np.float32)
    for i, x in enumerate(axes[0]):
        points = np.stack(np.meshgrid([x], axes[1], axes[2], indexing="ij"), axis=-1)
        found = look_up_surfaces(model, points.reshape(-1, 3), None)
        values[i] = found[0].reshape(values[i].shape)
        step(i + 1, counts[0])
    within = (slice(1, -1),) * 3
    cut = np.maximum(values, spacing)
    cut[within] = values[within]
    if not cut.min() < 0.0:
        raise ValueError(
            f"The field has no surface in the box: its signed value is at least {cut.min():.3g} "
            "world units. Train longer, or give a larger --box."
        )
    return Grid(cut, low, spacing)


def look_up_surfaces(
    model: Model,
    points: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"] | None,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Returns signed value in world units, unit normal, and sRGB colour along view directions.

    Arguments are those of `look_up_points`.
    """
    seen = _in_chunks(model, points, directions, _surface_chunk)
    return seen[0], seen[1], seen[2]


def surface_box(
    model: Model, half: float | None
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Returns the corners of the box in which a field has its surface, world units.

    Args:
      model: model whose field has a surface.
      half: half-extent of the box, around the same centre; by default that of the field's ball.
    """
    ball = ball_of(model.config)
    centre, half = np.array(ball.centre), ball.radius if half is None else half
    return centre - half, centre + half


def inside_objects(
    scene: Scene, axes: Sequence[Float[np.ndarray, " ticks"]]
) -> Bool[np.ndarray, "nx ny nz"]:
    """Returns the mask of grid points inside any part of the scene.

    From inside a closed surface every ray first hits its back side. Three rays are cast for each
    point of a part's box, and the majority counts: at a grazing hit a shading normal may mislead.

    Args:
      scene: scene with the objects.
      axes: coordinates of the grid along x, y and z, ascending.
    """
    inside = np.zeros([len(axis) for axis in axes], bool)
    for surfaces, corners in split_parts(scene):
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        near = tuple(
            slice(*np.searchsorted(axis, (low[i], high[i]))) for i, axis in enumerate(axes)
        )
        ticks = [axis[part] for axis, part in zip(axes, near, strict=True)]
        points = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).astype(np.float32)
        votes = sum(
            _meets_inner_side(surfaces, points, np.roll(_ASKEW, turn)).astype(np.int64)
            for turn in range(3)
        )
        inside[near] |= votes >= 2
    return inside


def split_parts(
    scene: Scene,
) -> Iterator[tuple[Surfaces, Float[np.ndarray, "faces 3 3"]]]:
    """Yields the surfaces of each part, and their triangles, in the order of their numbers."""
    surfaces = jax.device_get(scene.surfaces)
    real = slice(None, -LEAF_SIZE)  # the last slots fill up the last leaf
    triangles, owners = surfaces.bvh.triangles[real], surfaces.parts[real]
    for part in np.unique(owners):
        chosen = owners == part
        normals = surfaces.normals[real][chosen]
        yield build_surfaces(triangles[chosen], normals, owners[chosen]), triangles[chosen]


def _meets_inner_side(
    surfaces: Surfaces, points: Float[np.ndarray, "*n 3"], direction: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "*n"]:
    directions = np.broadcast_to(direction, points.shape)
    rays = Rays(points, directions, np.zeros(points.shape[:-1], np.float32))
    return find_first_surface(surfaces, rays).normals @ direction > 0.0


def with_background(density: Grid, *, level: float) -> Grid:
    """Returns the density with a surface at the border of the grid.

    This is the background cube of a bounded model: light that reaches its faces ends there, as if
    they were opaque, and a field with colours on the cube needs no density there.
    """
    values = np.full_like(density.values, level)
    within = (slice(1, -1),) * 3
    values[within] = density.values[within]
    return density._replace(values=np.maximum(values, density.values))


def with_sphere(
    density: Grid, *, level: float, radius: float, centre: Sequence[float] = (0.0, 0.0, 0.0)
) -> Grid:
    """Returns the density with a surface on a sphere; see `with_background`.

    Args:
      density: density per world unit.
      level: level of the surface.
      radius: radius of the sphere that bounds a spherical model, world units.
      centre: centre of the sphere, world units.
    """
    axes = [
        low + density.spacing * np.arange(count)
        for low, count in zip(density.low - centre, density.values.shape, strict=True)
    ]
    squares = [np.square(axis) for axis in np.meshgrid(*axes, indexing="ij", sparse=True)]
    beyond = (np.sqrt(sum(squares)) - radius) / density.spacing
    # The distance to the sphere, in the units of the logarithm.
    walls = level * np.exp(np.clip(beyond, -2.0 * _RANGE, 2.0 * _RANGE))
    return density._replace(values=np.maximum(walls, density.values).astype(density.values.dtype))


def find_surface(density: Grid, *, level: float) -> DensitySurface:
    """Returns the level set of the density; density and level are per world unit.

    Raises:
      ValueError: if the density never has that level, or scikit-image is not installed.
    """
    thinness = _thinness(density, level)
    return _level_set(density._replace(values=thinness))


def zero_surface(signed: Grid) -> DensitySurface:
    """Returns the surface where a signed value is 0; see `sample_surface`.

    Raises:
      ValueError: if scikit-image is not installed.
    """
    return _level_set(signed)


def _level_set(values: Grid) -> DensitySurface:
    vertices, faces = grids.march(values.values, values.spacing)
    vertices = values.low + vertices
    return DensitySurface(vertices, faces, unit_vectors(vertex_vectors(vertices, faces)))


def find_points(density: Grid, *, level: float) -> SurfacePoints:
    """Returns the grid points at or above a level that have a neighbour below it.

    Raises:
      ValueError: if there is none.
    """
    return outer_points(density._replace(values=_thinness(density, level)))


def outer_points(signed: Grid) -> SurfacePoints:
    """Returns the grid points where a value is at most 0 that have a neighbour where it is not."""
    thinness = signed.values
    dense = thinness <= 0.0
    padded = np.pad(dense, 1, constant_values=True)  # beyond the grid nothing is known
    middle = (slice(1, -1),) * 3
    buried = np.ones_like(dense)
    for axis in range(3):
        for shift in (-1, 1):
            buried &= np.roll(padded, shift, axis)[middle]
    index = np.argwhere(dense & ~buried)
    slopes = np.stack([slope[tuple(index.T)] for slope in np.gradient(thinness)], axis=-1)
    return SurfacePoints(signed.low + signed.spacing * index, unit_vectors(slopes))


def write_surface(path: Path, surface: DensitySurface, colours: UInt8[np.ndarray, "n 3"]) -> None:
    """Writes a surface as PLY, with a normal and an sRGB colour per vertex."""
    mesh = trimesh.Trimesh(
        surface.vertices,
        surface.faces,
        vertex_normals=surface.normals,
        vertex_colors=colours,
        process=False,
    )
    path.write_bytes(mesh.export(file_type="ply", vertex_normal=True))


def write_points(path: Path, points: SurfacePoints, colours: UInt8[np.ndarray, "n 3"]) -> None:
    """Writes points as PLY, with a normal and an sRGB colour each."""
    fields = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    fields += [(name, "u1") for name in ("red", "green", "blue")]
    table = np.zeros(len(points.points), fields)
    columns = np.concatenate([points.points, points.normals], axis=-1)
    for i, (name, _) in enumerate(fields):
        table[name] = columns[:, i] if i < 6 else colours[:, i - 6]
    kinds = {"<f4": "float", "u1": "uchar"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(table)}",
        *(f"property {kinds[kind]} {name}" for name, kind in fields),
        "end_header",
    ]
    path.write_bytes(("\n".join(header) + "\n").encode() + table.tobytes())


def _thinness(density: Grid, level: float) -> np.ndarray:
    """Returns the signed distance of the density below a level, on the steepened logarithm."""
    ratio = np.maximum(density.values.astype(np.float64), np.exp(-_RANGE) * level) / level
    found = -np.minimum(np.log(ratio), _RANGE) * _STEEPNESS * density.spacing
    if not (found.min() <= 0.0 < found.max()):
        raise ValueError(
            f"The density is {'at least' if found.max() <= 0.0 else 'below'} {level:g} per world "
            f"unit in the whole box (least {density.values.min():.3g}, most "
            f"{density.values.max():.3g}). Give a --level in between, or a larger --box for "
            "distant parts of an unbounded scene."
        )
    return found
