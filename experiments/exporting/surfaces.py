"""Surfaces and points of a density grid, and the files they are written to (NumPy only).

A surface of the density is where it crosses a level. It is looked for in the logarithm, since
densities grow by factors, and stays open at the borders of the grid.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8

from refref_jax.geometry.corner_normals import unit_vectors
from refref_jax.reconstruct import isosurface
from refref_jax.reconstruct.grids import Grid
from refref_jax.reconstruct.triangles import vertex_vectors

# A density this many factors of e from the level is as good as none, or as opaque as any.
_RANGE = 3.0

# Marching cubes keeps values a tenth of a cell off zero, as if they were distances. A density falls
# by a factor of e in several cells: made steeper, its surface is moved less by that.
_STEEPNESS = 4.0


class DensitySurface(NamedTuple):
    """Where the density crosses a level.

    Attributes:
      vertices: world units.
      faces: counter-clockwise seen from where the density is lower.
      normals: of the vertices, unit, towards lower density.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "vertices 3"]


class SurfacePoints(NamedTuple):
    """Points of a grid on the near side of what is dense.

    Attributes:
      points: world units.
      normals: unit, towards lower density.
    """

    points: Float[np.ndarray, "points 3"]
    normals: Float[np.ndarray, "points 3"]


def with_walls(density: Grid, *, level: float) -> Grid:
    """Returns the density with a surface in the border of the grid.

    For the cube of a bounded model: whatever light reaches its faces is seen there, as if they were
    opaque, and a field that knows walls on them has no need of a density.
    """
    values = np.full_like(density.values, level)
    within = (slice(1, -1),) * 3
    values[within] = density.values[within]
    return density._replace(values=np.maximum(values, density.values))


def with_sphere(density: Grid, *, level: float, radius: float) -> Grid:
    """Returns the density with a surface on a sphere around the origin, as `with_walls` has it.

    Args:
      density: per world unit.
      level: of the surface.
      radius: of the sphere, on which a spherical model ends, world units.
    """
    axes = [
        low + density.spacing * np.arange(count)
        for low, count in zip(density.low, density.values.shape, strict=True)
    ]
    squares = [np.square(axis) for axis in np.meshgrid(*axes, indexing="ij", sparse=True)]
    beyond = (np.sqrt(sum(squares)) - radius) / density.spacing
    # In the logarithm, in which surfaces are looked for, the distance to the sphere.
    walls = level * np.exp(np.clip(beyond, -2.0 * _RANGE, 2.0 * _RANGE))
    return density._replace(values=np.maximum(walls, density.values).astype(density.values.dtype))


def find_surface(density: Grid, *, level: float) -> DensitySurface:
    """Returns the surface on which the density has a level, both per world unit.

    Raises:
      ValueError: if it has that level nowhere, or scikit-image is not installed.
    """
    thinness = _thinness(density, level)
    vertices, faces = isosurface.march(thinness, density.spacing)
    vertices = density.low + vertices
    return DensitySurface(vertices, faces, unit_vectors(vertex_vectors(vertices, faces)))


def find_points(density: Grid, *, level: float) -> SurfacePoints:
    """Returns the grid's points that have at least a level, and a neighbour with less.

    Raises:
      ValueError: if there is none.
    """
    thinness = _thinness(density, level)
    dense = thinness <= 0.0
    padded = np.pad(dense, 1, constant_values=True)  # beyond the grid nothing is known
    middle = (slice(1, -1),) * 3
    buried = np.ones_like(dense)
    for axis in range(3):
        for shift in (-1, 1):
            buried &= np.roll(padded, shift, axis)[middle]
    index = np.argwhere(dense & ~buried)
    slopes = np.stack([slope[tuple(index.T)] for slope in np.gradient(thinness)], axis=-1)
    return SurfacePoints(density.low + density.spacing * index, unit_vectors(slopes))


def write_surface(path: Path, surface: DensitySurface, colours: UInt8[np.ndarray, "n 3"]) -> None:
    """Writes a surface as PLY, with a normal and an sRGB colour a vertex."""
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
    """Returns how far the density is below a level, as a steep kind of distance."""
    ratio = np.maximum(density.values.astype(np.float64), np.exp(-_RANGE) * level) / level
    found = -np.minimum(np.log(ratio), _RANGE) * _STEEPNESS * density.spacing
    if not (found.min() <= 0.0 < found.max()):
        raise ValueError(
            f"The density is {'at least' if found.max() <= 0.0 else 'below'} {level:g} per world "
            f"unit in the whole box (least {density.values.min():.3g}, most "
            f"{density.values.max():.3g}). Give a --level in between, or another --box: what is "
            "far in an unbounded scene lies beyond it."
        )
    return found
