"""How far the surface of one part is from another's (NumPy only).

Both surfaces are sampled, so small patches may be missed; a distance is never found too short.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from refref_jax.data.meshes import MeshPart
from refref_jax.geometry.corner_normals import face_normals, is_degenerate

# Samples of a part that look for the other: enough to see a patch of a few per mille of its area.
_SAMPLES = 2000

# Samples that can be found: closer together, so that one lies on every triangle of some width.
_TARGETS = 20_000

# Triangles that are tried for the point nearest to a sample.
_CANDIDATES = 8

# Steps of a sequence that fills a square evenly: powers of the plastic number, the root of
# x^3 = x + 1 (Roberts, The Unreasonable Effectiveness of Quasirandom Sequences, 2018).
_STEPS = 1.324717957244746 ** -np.array([1.0, 2.0])


class SampledSurface(NamedTuple):
    """A surface and points spread evenly over its area.

    Attributes:
      corners: its triangles, without those that have no area.
      normals: unit normals of the triangles.
      faces: triangle of each sample.
      points: the samples.
      tree: over more such points, and the middle of every triangle.
      owners: triangle of each point of the tree.
    """

    corners: Float[np.ndarray, "faces 3 3"]
    normals: Float[np.ndarray, "faces 3"]
    faces: Int[np.ndarray, " samples"]
    points: Float[np.ndarray, "samples 3"]
    tree: cKDTree
    owners: Int[np.ndarray, " owners"]


class Walls(NamedTuple):
    """What lies next to each sample of a surface on another one.

    Attributes:
      distances: to the nearest point there, in world units.
      ahead: cosine between the sample's normal and the way there; 0 where the two coincide.
      alignment: cosine between both normals: 1 if the surfaces look the same way, -1 if they
        look at or away from each other.
    """

    distances: Float[np.ndarray, " samples"]
    ahead: Float[np.ndarray, " samples"]
    alignment: Float[np.ndarray, " samples"]


def sample_surface(part: MeshPart) -> SampledSurface:
    """Samples a part, the same way every time."""
    corners = part.vertices[part.faces]
    corners = corners[~is_degenerate(corners)]
    faces, points = spread_points(corners, _SAMPLES)
    target_faces, targets = spread_points(corners, _TARGETS)
    return SampledSurface(
        corners=corners,
        normals=face_normals(corners),
        faces=faces,
        points=points,
        tree=cKDTree(np.concatenate([corners.mean(axis=1), targets])),
        owners=np.concatenate([np.arange(len(corners)), target_faces]),
    )


def walls_between(surface: SampledSurface, other: SampledSurface) -> Walls:
    """Returns what lies next to each sample of a surface on another one; both have area."""
    _, near = other.tree.query(surface.points, k=_CANDIDATES)
    faces = other.owners[near]
    ways = _closest(other.corners[faces] - surface.points[:, None, None])
    distances = np.linalg.norm(ways, axis=-1)
    best = np.argmin(distances, axis=1)[:, None]
    distances = np.take_along_axis(distances, best, axis=1)[:, 0]
    way = np.take_along_axis(ways, best[..., None], axis=1)[:, 0]
    face = np.take_along_axis(faces, best, axis=1)[:, 0]
    normals = surface.normals[surface.faces]
    along = np.sum(normals * way, axis=-1)
    return Walls(
        distances=distances,
        ahead=np.divide(along, distances, out=np.zeros_like(along), where=distances > 0.0),
        alignment=np.sum(normals * other.normals[face], axis=-1),
    )


def diagonal(parts: Sequence[MeshPart]) -> float:
    """Returns the diagonal of the smallest bounding box among some parts, in world units."""
    return float(min(np.linalg.norm(np.ptp(part.vertices, axis=0)) for part in parts))


def spread_points(
    corners: Float[np.ndarray, "faces 3 3"], count: int
) -> tuple[Int[np.ndarray, " samples"], Float[np.ndarray, "samples 3"]]:
    """Spreads points evenly over an area; none if there are no triangles."""
    a, b, c = np.moveaxis(corners, 1, 0)
    areas = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=-1))
    number = np.arange(count if len(corners) else 0)
    faces = np.searchsorted(areas, (number + 0.5) / count * areas[-1:], side="right")
    faces = np.minimum(faces, len(corners) - 1)
    u, v = np.modf((number[:, None] + 0.5) * _STEPS)[0].T
    beyond = u + v > 1.0
    u, v = np.where(beyond, 1.0 - u, u)[:, None], np.where(beyond, 1.0 - v, v)[:, None]
    return faces, a[faces] + u * (b - a)[faces] + v * (c - a)[faces]


def _closest(corners: Float[np.ndarray, "*shape 3 3"]) -> Float[np.ndarray, "*shape 3"]:
    """Returns the point of each triangle that is closest to the origin."""
    following = np.roll(corners, -1, axis=-2)
    edges = following - corners
    along = -np.sum(corners * edges, axis=-1) / np.sum(edges**2, axis=-1)
    on_edges = corners + np.clip(along, 0.0, 1.0)[..., None] * edges
    nearest = np.argmin(np.sum(on_edges**2, axis=-1), axis=-1)[..., None, None]
    on_edge = np.take_along_axis(on_edges, nearest, axis=-2)[..., 0, :]
    normal = np.cross(edges[..., 0, :], edges[..., 1, :])
    within = np.all(np.sum(np.cross(corners, following) * normal[..., None, :], axis=-1) >= 0.0, -1)
    height = np.sum(corners[..., 0, :] * normal, axis=-1) / np.sum(normal**2, axis=-1)
    return np.where(within[..., None], height[..., None] * normal, on_edge)
