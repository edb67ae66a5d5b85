"""Exports a backdrop: as a textured mesh, as six images, or as a panorama.

The textures hold one texel per vertex of the finest grid. A texel's value holds at its middle, so
the texture coordinates of a face begin and end half a texel inside its image. A level of light
above 1 is lost in 8-bit images, but not in EXR files.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from PIL import Image

from refref_jax.data import image_files
from refref_jax.geometry.rays import Rays
from refref_jax.optics import light_paths
from refref_jax.render import backdrop, pixels
from refref_jax.render.model import Model, surface_of
from refref_jax.sampling.scene_bounds import Domain

# Cells along each edge of a face of a sphere's mesh.
_CURVED = 32

# An environment is infinitely far away: its mesh is a sphere of this many times the scene's radius.
_FAR = 10.0

# Number of pixels that is black in a picture of the coverage.
_LEAST = 1e-2


def check(model: Model, run: Path) -> None:
    """Checks that a model has a backdrop.

    Raises:
      ValueError: if it has fields.
    """
    if model.config.backdrop is None:
        raise ValueError(
            f"{run} has a field, not a backdrop. Use --what=mesh or --what=points, or train with "
            "--far_field=backdrop."
        )


def faces(model: Model) -> Float[np.ndarray, "6 side side 3"]:
    """Returns the linear RGB radiance at the vertices of each face, its mean over directions.

    Faces are in the order -x, +x, -y, +y, -z, +z. On a face of axis `a`, columns go along axis
    `a + 1` and rows along axis `a + 2`, both modulo 3, from the negative to the positive end.
    """
    return np.asarray(backdrop.mipmap(surface_of(model.params), model.config.space)[0][..., :3])


def as_sheet(grid: Float[np.ndarray, "6 side side n"]) -> Float[np.ndarray, "h w n"]:
    """Returns the faces as one image: a row per axis, the negative side on the left."""
    return np.concatenate([np.concatenate([grid[n], grid[n + 1]], axis=1) for n in (0, 2, 4)])


def as_heat(coverage: Float[np.ndarray, "6 side side"]) -> Float[np.ndarray, "h w 3"]:
    """Returns how many pixels see each vertex as a sheet of colours, those never seen in magenta.

    Brightness is logarithmic, from a hundredth of a pixel (black) to the largest number (white).
    """
    sheet = as_sheet(coverage[..., None])
    most = max(float(np.max(coverage)), 1.0)
    bright = np.log(np.maximum(sheet, _LEAST) / _LEAST) / np.log(most / _LEAST)
    return np.where(sheet > 0.0, np.clip(bright, 0.0, 1.0), np.array([1.0, 0.0, 1.0]))


def as_srgb(linear: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Returns sRGB in `[0, 1]`; brighter light is clipped."""
    return np.clip(np.asarray(pixels.linear_to_srgb(jax.device_put(linear))), 0.0, 1.0)


def panorama(model: Model, *, height: int) -> Float[np.ndarray, "h w 3"]:
    """Returns what is seen from the centre of the scene in all directions, as linear RGB.

    The projection is equirectangular, like Blender's: +z is at the top, +x in the middle, and +y to
    its left.

    Args:
      model: model with a backdrop.
      height: number of rows; there are twice as many columns.
    """
    domain = model.config.domain
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    azimuth = np.pi * (1.0 - (np.arange(2 * height) + 0.5) / height)
    elevation, azimuth = np.meshgrid(elevation, azimuth, indexing="ij")
    level = np.cos(elevation)
    towards = (level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation))
    rays = _from_centre(domain, np.stack(towards, axis=-1).reshape(-1, 3))
    return np.asarray(_look(model, domain, rays)).reshape(height, 2 * height, 3)


def _from_centre(domain: Domain, directions: Float[np.ndarray, "rays 3"]) -> Rays:
    origins = np.broadcast_to(np.asarray(domain.centre), directions.shape)
    radii = np.zeros(len(directions))
    return Rays(*(np.asarray(x, np.float32) for x in (origins, directions, radii)))


def _look(model: Model, domain: Domain, rays: Rays) -> Float[np.ndarray, "rays 3"]:
    """Returns the linear RGB radiance that straight rays see."""
    grids = backdrop.mipmap(surface_of(model.params), model.config.space)
    numbers = jnp.arange(rays.radii.size, dtype=jnp.int32)
    lookups = backdrop.locate(
        domain,
        light_paths.straight_ends(rays),
        numbers,
        resolution=grids[0].shape[1] - 1,
        most_taps=1,
        axes=grids[0].shape[3] // 3 - 1,
    )
    return backdrop.radiance(grids, lookups)


def write_textured_mesh(path: Path, model: Model) -> None:
    """Writes the surface as GLB, seen from inside: a cube, or a sphere of curved faces.

    The light that a face emits is its texture; an environment is put on a distant sphere.
    """
    domain, grid = model.config.domain, faces(model)
    scene = trimesh.Scene()
    for number, values in enumerate(grid):
        name = f"{'-+'[number % 2]}{'xyz'[number // 2]}"
        texture = image_files.to_bytes(as_srgb(values[::-1]))
        scene.add_geometry(face_mesh(domain, number, texture), geom_name=name, node_name=name)
    path.write_bytes(scene.export(file_type="glb"))


def face_mesh(domain: Domain, number: int, texture: UInt8[np.ndarray, "h w 3"]) -> trimesh.Trimesh:
    """Returns one face with its texture, whose normals point inwards.

    Args:
      domain: bounds of the scene.
      number: index of the face (`faces`).
      texture: 8-bit sRGB, the last row of the grid at the top.
    """
    cells = 1 if domain.space == "bounded" else _CURVED
    row, column = np.mgrid[: cells + 1, : cells + 1].reshape(2, -1) / cells
    axis, positive = divmod(number, 2)
    place = 2.0 * np.stack([column, row], axis=-1) - 1.0
    if domain.space != "bounded":
        place = np.tan(0.25 * np.pi * place)
    points = np.empty((len(place), 3))
    points[:, axis] = 2.0 * positive - 1.0
    points[:, (axis + 1) % 3], points[:, (axis + 2) % 3] = place.T
    if domain.space != "bounded":
        points /= np.linalg.norm(points, axis=-1, keepdims=True)
    radius = domain.radius * (_FAR if domain.space == "unbounded" else 1.0)
    first = np.arange(cells * (cells + 1)).reshape(cells, cells + 1)[:, :-1].reshape(-1, 1)
    corners = first + np.array([[0, 1, cells + 2, 0, cells + 2, cells + 1]])
    triangles = corners.reshape(-1, 3)
    side = texture.shape[0]
    coordinates = (0.5 + (side - 1) * np.stack([column, row], axis=-1)) / side
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[0, 0, 0, 255],
        emissiveTexture=Image.fromarray(texture),
        emissiveFactor=[1.0, 1.0, 1.0],
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )
    return trimesh.Trimesh(
        np.asarray(domain.centre) + radius * points,
        triangles[:, ::-1] if positive else triangles,
        visual=trimesh.visual.TextureVisuals(uv=coordinates, material=material),
        process=False,
    )
