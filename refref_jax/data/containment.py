"""Which part of a scene lies inside which (NumPy only).

A point is inside a closed surface where the surface winds around it once. The winding number is
a sum over triangles, so it needs no rays and bears small defects of a mesh.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from refref_jax.data.meshes import MeshPart
from refref_jax.optics.interface_rules import NO_PARENT

# Vertices of a part that are tested against each other part.
_PROBES = 16

# Triangles times points of one sweep, to bound its memory.
_SWEEP = 1 << 20

# A part whose probes agree to this share is inside or outside; else its surface cuts the other.
_AGREEMENT = 0.95


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
    volumes = [abs(signed_volume(part)) for part in parts]
    contains = np.zeros((count, count), bool)
    overlaps = []
    for inner in range(count):
        probes = _probes(parts[inner])
        for outer in range(count):
            if inner == outer:
                continue
            share = np.mean(np.abs(winding_number(parts[outer], probes)) > 0.5)
            if share >= _AGREEMENT:
                contains[outer, inner] = True
            elif share > 1.0 - _AGREEMENT:
                overlaps.append((inner, outer))
    parents = []
    for inner in range(count):
        around = np.flatnonzero(contains[:, inner])
        parents.append(int(min(around, key=volumes.__getitem__)) if around.size else NO_PARENT)
    return Containment(tuple(parents), tuple(overlaps))


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


def signed_volume(part: MeshPart) -> float:
    """Returns the volume inside a closed surface, negative if its faces point inwards."""
    a, b, c = np.moveaxis(part.vertices[part.faces] - part.vertices.mean(axis=0), 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6.0)


def _probes(part: MeshPart) -> Float[np.ndarray, "probes 3"]:
    """Returns centres of faces spread evenly over the list."""
    chosen = np.unique(np.linspace(0, len(part.faces) - 1, _PROBES).astype(np.int64))
    return part.vertices[part.faces[chosen]].mean(axis=1)


def _solid_angles(
    corners: Float[np.ndarray, "faces 3 3"], points: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "points faces"]:
    a, b, c = np.moveaxis(corners[None] - points[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(edge, axis=-1) for edge in (a, b, c))
    triple = np.sum(a * np.cross(b, c), axis=-1)
    dots = (
        la * lb * lc
        + np.sum(a * b, axis=-1) * lc
        + np.sum(b * c, axis=-1) * la
        + np.sum(c * a, axis=-1) * lb
    )
    return 2.0 * np.arctan2(triple, dots)
