"""A trained run's density on a grid, and its colours at points.

Inside the bodies there is no density where the model samples nothing there: what the field holds
there was never learned.
"""

import functools
from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from refref_jax.geometry.bvh import LEAF_SIZE
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surface_build import build_surfaces
from refref_jax.geometry.surfaces import Surfaces
from refref_jax.optics.scene import Scene
from refref_jax.reconstruct.grids import Grid
from refref_jax.render import Model, colour
from refref_jax.render.field_points import look_up
from refref_jax.render.first_surface import find_first_surface

CHUNK = 1 << 15
"""Points looked up at once."""

# A direction that lies in no face or edge of a made body.
_ASKEW = np.array([0.48, 0.6, 0.64], np.float32)


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
      low: the box's least corner, world units.
      high: its greatest corner.
      resolution: cells along its longest edge.
      step: is called after each slice, with the number of those done and of all.

    Returns:
      Density per world unit at the grid's points, 0 inside bodies that are not sampled.
    """
    spacing = float((high - low).max()) / resolution
    counts = np.maximum(np.rint((high - low) / spacing), 1).astype(np.int64) + 1
    axes = [low[i] + spacing * np.arange(counts[i]) for i in range(3)]
    unknown = np.zeros(counts, bool)
    if model.config.interior != "field":
        unknown = inside_bodies(model.geometry, axes)
    values = np.zeros(counts, np.float32)
    for i, x in enumerate(axes[0]):
        rows = np.argwhere(~unknown[i])
        points = np.stack([np.full(len(rows), x), axes[1][rows[:, 0]], axes[2][rows[:, 1]]], -1)
        density, _ = look_up_points(model, points, None, width=spacing)
        values[i, rows[:, 0], rows[:, 1]] = density
        step(i + 1, int(counts[0]))
    return Grid(values, low, spacing)


def look_up_points(
    model: Model,
    points: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"] | None,
    *,
    width: float,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Returns density per world unit, and sRGB colour as it is seen along unit directions.

    Args:
      model: the trained model.
      points: world units.
      directions: of view; `None` where colours do not matter.
      width: edge of the cell that a point stands for, world units.
    """
    if directions is None:
        directions = np.tile(_ASKEW, (len(points), 1))
    densities, colours = [np.zeros(0, np.float32)], [np.zeros((0, 3), np.float32)]
    for start in range(0, len(points), CHUNK):
        part = slice(start, start + CHUNK)
        count = len(points[part])
        # Filled up, so that nothing is compiled twice.
        filled = [
            np.pad(each[part].astype(np.float32), ((0, CHUNK - count), (0, 0)), mode="edge")
            for each in (points, directions)
        ]
        density, rgb = jax.device_get(_chunk(model.params, *filled, model.config, width))
        densities.append(density[:count])
        colours.append(rgb[:count])
    return np.concatenate(densities), np.concatenate(colours)


@functools.partial(jax.jit, static_argnums=(3, 4))
def _chunk(params, points, directions, config, width):
    look = functools.partial(look_up, width=width)
    seen = jax.vmap(look, in_axes=(None, None, 0, 0))(params, config, points, directions)
    return seen.density, jnp.clip(colour.linear_to_srgb(seen.linear), 0.0, 1.0)


def inside_bodies(
    geometry: Scene, axes: Sequence[Float[np.ndarray, " ticks"]]
) -> Bool[np.ndarray, "nx ny nz"]:
    """Returns which points of a grid lie inside any part of the geometry.

    From within a closed surface every ray first meets its inner side. Three rays are cast for each
    point of a part's box, and the majority counts: at a grazing hit a shading normal may mislead.

    Args:
      geometry: the bodies.
      axes: coordinates of the grid along x, y and z, ascending.
    """
    inside = np.zeros([len(axis) for axis in axes], bool)
    for surfaces, corners in split_parts(geometry):
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
    geometry: Scene,
) -> Iterator[tuple[Surfaces, Float[np.ndarray, "faces 3 3"]]]:
    """Yields the surfaces of each part, and their triangles, in the order of their numbers."""
    surfaces = jax.device_get(geometry.surfaces)
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
