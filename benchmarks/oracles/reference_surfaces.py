"""Triangle meshes and their closest hits in float64 NumPy, for the reference tracer."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh

# Embree works in float32: it starts this far off the surface, relative to the coordinates.
_EMBREE_OFFSET = 2e-6


# How far beyond its edges a triangle is still met, as a barycentric coordinate: no ray slips
# between two triangles.
_EDGE = 1e-12


class Surfaces(NamedTuple):
    """Triangles of all parts, and what each part is made of.

    Attributes:
      corners: [triangles, 3, 3].
      normals: outward unit shading normals at the corners, [triangles, 3, 3].
      parts: part of each triangle.
      inside, outside: index of refraction on either side of each part.
      tints: factor on every reflection and every crossing of a part, [parts, 3].
    """

    corners: np.ndarray
    normals: np.ndarray
    parts: np.ndarray
    inside: np.ndarray
    outside: np.ndarray
    tints: np.ndarray


class Part(NamedTuple):
    """A closed mesh and its material."""

    vertices: np.ndarray
    faces: np.ndarray
    smooth: bool
    inside: float
    outside: float = 1.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)


class Hits(NamedTuple):
    """Closest hits; a miss has `t = inf` and triangle -1."""

    t: np.ndarray
    triangles: np.ndarray
    barycentrics: np.ndarray


def read_surfaces(scene: Path) -> Surfaces:
    """Reads the parts that `scene.json` names."""
    parts = []
    for part in json.loads((scene / "scene.json").read_text())["parts"]:
        mesh = trimesh.load(scene / part["mesh"], process=False)
        sides = (part["ior_inside"], part["ior_outside"], part["colour_per_interface"])
        parts.append(Part(mesh.vertices, mesh.faces, part["smooth_normals"], *sides))
    return join(parts)


def join(parts: list[Part]) -> Surfaces:
    """Joins parts into one soup of triangles."""
    corners = [np.asarray(part.vertices, float)[part.faces] for part in parts]
    return Surfaces(
        np.concatenate(corners),
        np.concatenate(
            [(_smooth if part.smooth else _flat)(c) for part, c in zip(parts, corners, strict=True)]
        ),
        np.repeat(np.arange(len(parts)), [len(c) for c in corners]),
        np.array([part.inside for part in parts], float),
        np.array([part.outside for part in parts], float),
        np.array([part.tint for part in parts], float),
    )


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.sqrt(np.einsum("...i,...i->...", vectors, vectors))[..., None]


def face_normals(corners: np.ndarray) -> np.ndarray:
    """Returns the unit normals of triangles, counter-clockwise seen from outside."""
    return unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def _flat(corners: np.ndarray) -> np.ndarray:
    return np.repeat(face_normals(corners)[:, None], 3, axis=1)


def _smooth(corners: np.ndarray) -> np.ndarray:
    """Returns the mean of the normals around a vertex, with Max's weights.

    Unlike the library's, they do not keep large flat pieces flat.
    """
    along = np.roll(corners, -1, axis=1) - corners
    back = np.roll(corners, 1, axis=1) - corners
    areas = np.linalg.norm(np.cross(along, back), axis=-1)
    weights = areas / np.sum(along**2, axis=-1) / np.sum(back**2, axis=-1)
    _, vertices = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    sums = np.zeros((vertices.max() + 1, 3))
    weighted = weights[..., None] * face_normals(corners)[:, None]
    np.add.at(sums, vertices.ravel(), weighted.reshape(-1, 3))
    return unit(sums[vertices.ravel()]).reshape(corners.shape)


def in_plane(corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple:
    """Returns where rays meet the planes of triangles: distance, and weights of two corners."""
    a = corners[..., 0, :]
    first, second = corners[..., 1, :] - a, corners[..., 2, :] - a
    normal = np.cross(first, second)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.sum((a - origins) * normal, -1) / np.sum(directions * normal, -1)
        point = origins + t[..., None] * directions - a
        size = np.sum(normal * normal, -1)
        u = np.sum(np.cross(point, second) * normal, -1) / size
        v = np.sum(np.cross(first, point) * normal, -1) / size
    return t, np.stack([u, v], axis=-1)


class BruteForce:
    """Tests every triangle in float64; for small meshes."""

    def __init__(self, surfaces: Surfaces):
        """Keeps the triangles."""
        self._corners = surfaces.corners

    def __call__(
        self, origins: np.ndarray, directions: np.ndarray, exclude_primitive: np.ndarray
    ) -> Hits:
        """Returns the closest hits of rays, never on the triangle that they leave (-1: none)."""
        t, uv = in_plane(self._corners[None], origins[:, None], directions[:, None])
        within = (uv.min(-1) >= -_EDGE) & (uv.sum(-1) <= 1.0 + _EDGE)
        inside = within & (t > 0.0)
        inside &= np.arange(len(self._corners)) != exclude_primitive[:, None]
        t = np.where(inside, t, np.inf)
        best = np.argmin(t, axis=1)
        rays = np.arange(len(t))
        hit = np.isfinite(t[rays, best])
        return Hits(t[rays, best], np.where(hit, best, -1), uv[rays, best])


class Embree:
    """Finds triangles with Embree in float32, and where they are hit in float64."""

    def __init__(self, surfaces: Surfaces):
        """Builds Embree's tree."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._corners = surfaces.corners
        self._normals = face_normals(surfaces.corners)
        self.scene = EmbreeScene(robust=True)
        TriangleMesh(self.scene, surfaces.corners.astype(np.float32))

    def off_surface(
        self, origins: np.ndarray, directions: np.ndarray, exclude_primitive: np.ndarray
    ) -> np.ndarray:
        """Returns origins just off the triangles that rays leave, on the rays' side."""
        normals = self._normals[exclude_primitive]
        side = np.sign(np.einsum("ij,ij->i", normals, directions)).astype(origins.dtype)
        step = np.where(exclude_primitive < 0, 0.0, _EMBREE_OFFSET * np.abs(origins).max(-1) * side)
        return origins + step.astype(origins.dtype)[:, None] * normals

    def __call__(
        self, origins: np.ndarray, directions: np.ndarray, exclude_primitive: np.ndarray
    ) -> Hits:
        """Returns the closest hits of rays, never on the triangle that they leave (-1: none)."""
        count = len(origins)
        hits = Hits(np.full(count, np.inf), np.full(count, -1), np.zeros((count, 2)))
        starts, waiting = self.off_surface(origins, directions, exclude_primitive), np.arange(count)
        while len(waiting):
            found = self.scene.run(
                starts[waiting].astype(np.float32), directions[waiting].astype(np.float32), output=1
            )
            met = found["primID"] >= 0
            waiting, slots, near = waiting[met], found["primID"][met], found["tfar"][met]
            t, uv = in_plane(self._corners[slots], origins[waiting], directions[waiting])
            real = (slots != exclude_primitive[waiting]) & (t > 0.0)
            for kept, value in zip(hits, (t, slots, uv), strict=True):
                kept[waiting[real]] = value[real]
            # A hit that float64 does not confirm is passed, and the ray cast on from behind it.
            waiting, near = waiting[~real], near[~real]
            past = near + 2.0 * _EMBREE_OFFSET * np.abs(starts[waiting]).max(-1)
            starts[waiting] += past[:, None] * directions[waiting]
        return hits
