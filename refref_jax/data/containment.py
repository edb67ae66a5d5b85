"""Which part of a scene lies inside which (NumPy only).

A point is inside a closed surface where the surface winds around it once. The winding number is
a sum over triangles, so it needs no rays and bears small defects of a mesh.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from refref_jax.data.errors import SceneError
from refref_jax.data.facing_walls import spread_points
from refref_jax.data.meshes import MeshPart
from refref_jax.geometry.corner_normals import face_normals, is_degenerate
from refref_jax.geometry.triangle_meshes import volume
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.media import EMPTY_SLOT, SLOTS

# Points of a part that are tested against each other part: more against a coarse one, where they
# cost little, and where a few of its faces may be cut without their middles being inside.
_FEWEST_PROBES, _MOST_PROBES = 64, 2048
_PROBED_PAIRS = 1 << 21

# How far off a face its probes lie, on both sides, as a share of the part's size. Bodies that are
# closer than that touch.
_GAP = 1e-5

# Triangles times points of one sweep, to bound its memory.
_SWEEP = 1 << 20


class Containment(NamedTuple):
    """How the parts of a scene lie in one another.

    Attributes:
      parents: index of the innermost part around each part, or `NO_PARENT`.
      overlaps: pairs of parts whose surfaces cut each other or coincide.
    """

    parents: tuple[int, ...]
    overlaps: tuple[tuple[int, int], ...]


def find_containment(parts: Sequence[MeshPart]) -> Containment:
    """Finds the tree of containment."""
    count = len(parts)
    volumes = [abs(volume(part.vertices, part.faces)) for part in parts]
    contains = np.zeros((count, count), bool)
    overlaps = set()
    for inner, outer in itertools.permutations(range(count), 2):
        inside = np.abs(winding_number(parts[outer], _probes(parts[inner], parts[outer]))) > 0.5
        contains[outer, inner] = inside.all()
        if inside.any() and not inside.all():
            overlaps.add((min(inner, outer), max(inner, outer)))
    parents = []
    for inner in range(count):
        around = np.flatnonzero(contains[:, inner])
        parents.append(int(min(around, key=volumes.__getitem__)) if around.size else NO_PARENT)
    return Containment(tuple(parents), tuple(sorted(overlaps)))


def parts_around(
    parts: Sequence[MeshPart], points: Float[np.ndarray, "points 3"]
) -> Int[np.ndarray, "points slots"]:
    """Returns the interior list of rays that start at points: the parts that contain each.

    For the rule `priority`, see `optics.media`; the other rules need none.

    Raises:
      SceneError: if a list is too short for the parts around a point.
    """
    inside = np.zeros((len(points), max(len(parts), SLOTS)), bool)
    for number, part in enumerate(parts):
        inside[:, number] = np.abs(winding_number(part, points)) > 0.5
    if np.any(crowded := inside.sum(axis=1) > SLOTS):
        point = int(np.argmax(crowded))
        names = ", ".join(parts[number].name for number in np.flatnonzero(inside[point]))
        raise SceneError(
            f"More than {SLOTS} parts contain the point {points[point].tolist()}: {names}. Move "
            "the camera, or join parts that are of one material."
        )
    order = np.argsort(~inside, axis=1, kind="stable")[:, :SLOTS]
    listed = np.take_along_axis(inside, order, axis=1)
    return np.where(listed, order, EMPTY_SLOT).astype(np.int32)


def winding_number(
    part: MeshPart, points: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, " points"]:
    """Returns how often a surface winds around points: 1 inside, 0 outside a closed one.

    0 without a look at the triangles for points outside the surface's bounding box. Negative
    where the faces point inwards.

    Source: Jacobson et al., Robust Inside-Outside Segmentation using Generalized Winding
    Numbers (2013); van Oosterom and Strackee (1983) for the solid angle.
    """
    low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
    near = np.all((points >= low) & (points <= high), axis=1)
    corners = part.vertices[part.faces]
    total = np.zeros(len(points))
    step = max(1, _SWEEP // max(1, near.sum()))
    for start in range(0, len(corners) if near.any() else 0, step):
        total[near] += _solid_angles(corners[start : start + step], points[near]).sum(axis=1)
    return total / (4.0 * np.pi)


def beside_faces(
    part: MeshPart, faces: Int[np.ndarray, " faces"], side: float
) -> Float[np.ndarray, "faces 3"]:
    """Returns points just off the middle of some faces: in front for side 1, behind for -1."""
    corners = part.vertices[part.faces[faces]]
    step = side * _GAP * np.max(np.ptp(part.vertices, axis=0))
    return corners.mean(axis=1) + step * face_normals(corners)


def _probes(part: MeshPart, other: MeshPart) -> Float[np.ndarray, "probes 3"]:
    """Returns points just inside and outside of a surface, spread evenly over it."""
    count = int(np.clip(_PROBED_PAIRS // len(other.faces), _FEWEST_PROBES, _MOST_PROBES))
    corners = part.vertices[part.faces]
    faces, points = spread_points(corners[~is_degenerate(corners)], count)
    normals = face_normals(corners[~is_degenerate(corners)])[faces]
    step = _GAP * np.max(np.ptp(part.vertices, axis=0)) * normals
    return np.concatenate([points - step, points + step])


def _solid_angles(
    corners: Float[np.ndarray, "faces 3 3"], points: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "points faces"]:
    """Returns the signed solid angle of every triangle seen from every point."""
    # Coordinates come first, so that every product below runs over whole arrays.
    a, b, c = (corners[:, i].T[:, None] - points.T[:, :, None] for i in range(3))
    la, lb, lc = (np.sqrt(_dot(edge, edge)) for edge in (a, b, c))
    triple = _dot(a, np.stack([_minor(b, c, 1, 2), _minor(b, c, 2, 0), _minor(b, c, 0, 1)]))
    dots = la * lb * lc + _dot(a, b) * lc + _dot(b, c) * la + _dot(c, a) * lb
    return 2.0 * np.arctan2(triple, dots)


def _dot(
    a: Float[np.ndarray, "3 points faces"], b: Float[np.ndarray, "3 points faces"]
) -> Float[np.ndarray, "points faces"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _minor(
    a: Float[np.ndarray, "3 points faces"], b: Float[np.ndarray, "3 points faces"], i: int, j: int
) -> Float[np.ndarray, "points faces"]:
    return a[i] * b[j] - a[j] * b[i]
