"""How far a mesh is from another one, and from masks."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from refref_jax.geometry.cameras import Cameras, image_rays
from refref_jax.geometry.corner_normals import unit_vectors
from refref_jax.geometry.surface_build import pack_meshes
from refref_jax.geometry.triangle_meshes import Mesh, diameter
from refref_jax.reconstruct.closest import ClosestSearch
from refref_jax.reconstruct.silhouettes import overlaps
from refref_jax.render.first_surface import find_first_surface

SAMPLES = 20_000
"""Points on each surface."""


class Distance(NamedTuple):
    """How far two surfaces are from each other.

    Attributes:
      chamfer: mean distance from one surface to the other, mean of both ways, as a share of the
        true mesh's diameter (the diagonal of its box).
      furthest: largest distance of either way, as a share of the diameter.
      normal_error: mean angle in degrees between the shading normals at points of the mesh and at
        the closest points of the true one.
      normal_error_99: the angle that 99 of 100 points stay below.
    """

    chamfer: float
    furthest: float
    normal_error: float
    normal_error_99: float


def compare_meshes(mesh: Mesh, truth: Mesh, *, samples: int = SAMPLES, seed: int = 0) -> Distance:
    """Compares a mesh with the true one, at points spread evenly by area over each.

    Args:
      mesh: any.
      truth: what it should be; its size is the unit.
      samples: points on each surface. Distances to the other are exact.
      seed: of the points.
    """
    generator = np.random.default_rng(seed)
    points, normals = _spread(mesh, samples, generator)
    there, _ = _spread(truth, samples, generator)
    forth = ClosestSearch(truth.vertices, truth.faces)(points)
    back = ClosestSearch(mesh.vertices, mesh.faces)(there)
    expected = unit_vectors(np.einsum("nk,nkc->nc", forth.weights, truth.normals[forth.faces]))
    cosine = np.clip(np.sum(normals * expected, axis=-1), -1.0, 1.0)
    angles = np.degrees(np.arccos(cosine))
    size = diameter(truth.vertices)
    return Distance(
        0.5 * float(forth.distances.mean() + back.distances.mean()) / size,
        float(max(forth.distances.max(), back.distances.max())) / size,
        float(angles.mean()),
        float(np.percentile(angles, 99.0)),
    )


def silhouette_overlap(
    mesh: Mesh, masks: Bool[np.ndarray, "views h w"], cameras: Cameras
) -> Float[np.ndarray, " views"]:
    """Returns for each view the pixels in both mask and silhouette over those in either (IoU).

    A pixel is in the silhouette if the ray through its centre meets the mesh, as the data set's
    masks are made. A view in which both are empty counts 1.
    """
    return overlaps(silhouettes(mesh, cameras), masks)


def silhouettes(mesh: Mesh, cameras: Cameras) -> Bool[np.ndarray, "views h w"]:
    """Returns which pixels see a mesh."""
    surfaces = pack_meshes([mesh])
    views: Sequence[int] = range(len(cameras.poses))
    return np.stack(
        [np.isfinite(find_first_surface(surfaces, image_rays(cameras, i)).distances) for i in views]
    )


def _spread(
    mesh: Mesh, count: int, generator: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Returns points spread over a mesh, and their interpolated unit normals."""
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
    )
    # One point in each of equal shares of the area.
    total = np.cumsum(area)
    at = (np.arange(count) + generator.uniform(size=count)) / count * total[-1]
    face = np.minimum(np.searchsorted(total, at), len(area) - 1)
    u, v = generator.uniform(size=(2, count))
    root = np.sqrt(u)
    weights = np.stack([1.0 - root, root * (1.0 - v), root * v], axis=-1)
    points = np.einsum("nk,nkc->nc", weights, corners[face])
    return points, unit_vectors(np.einsum("nk,nkc->nc", weights, mesh.normals[face]))
