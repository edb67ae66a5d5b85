"""Examines the meshes of a scene before anything is traced (NumPy only).

Each part by itself; `lint_pairs` looks at how parts lie to each other, and `rule_advice` says
which interface rule that asks for.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from refref_jax.data.containment import Containment, beside_faces, winding_number
from refref_jax.data.findings import Finding
from refref_jax.data.lint_pairs import lint_pairs
from refref_jax.data.meshes import MeshPart
from refref_jax.geometry.corner_normals import is_degenerate

# -1 in front of an inverted closed piece; a lone open sheet gives -1/2.
_WOUND_BACKWARDS = -0.75


def lint(parts: Sequence[MeshPart], containment: Containment) -> list[Finding]:
    """Reports on every part (closed, outward, without waste), and on how they lie to each other."""
    findings = []
    for part in parts:
        findings += _edges(part)
        findings += _faces(part)
        findings += _bodies(part)
    return findings + lint_pairs(parts, containment)


def _bodies(part: MeshPart) -> list[Finding]:
    """Reports pieces whose faces point inwards; those of a cavity do so rightly."""
    faces = _largest_faces(part)
    # In front of an inverted piece the surface winds around the other way; in a cavity not at all.
    winding = winding_number(part, beside_faces(part, faces, 1.0))
    inverted = int(np.sum(winding < _WOUND_BACKWARDS))
    if not inverted:
        return []
    return [
        Finding(
            "error",
            part.name,
            f"the faces of {inverted} of its {len(faces)} pieces point inwards, so inside and "
            "outside are exchanged. Flip those faces and export it again.",
        )
    ]


def _largest_faces(part: MeshPart) -> Int[np.ndarray, " pieces"]:
    """Returns the largest face of each connected piece."""
    first, second = part.faces[:, [0, 1, 0]].ravel(), part.faces[:, [1, 2, 2]].ravel()
    count = len(part.vertices)
    graph = coo_array((np.ones(first.size, bool), (first, second)), shape=(count, count))
    pieces = connected_components(graph, directed=False)[1][part.faces[:, 0]]
    a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
    by_area = np.argsort(np.linalg.norm(np.cross(b - a, c - a), axis=-1), kind="stable")
    return np.array(list(dict(zip(pieces[by_area], by_area, strict=True)).values()), np.int64)


def _edges(part: MeshPart) -> list[Finding]:
    """Reports edges that a closed, consistently oriented surface does not have."""
    directed = part.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    directed = directed[directed[:, 0] != directed[:, 1]]
    _, inverse, uses = np.unique(
        np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    findings = []
    if open_edges := int(np.sum(uses % 2)):
        findings.append(
            Finding(
                "warning",
                part.name,
                f"is not watertight: {open_edges} edges are open. Light that slips through loses "
                "track of its medium; close the holes.",
            )
        )
    forward = np.where(directed[:, 0] < directed[:, 1], 1, -1)
    balance = np.bincount(inverse.reshape(-1), forward)
    if unbalanced := int(np.sum((balance != 0) & (uses % 2 == 0))):
        findings.append(
            Finding(
                "error",
                part.name,
                f"is not oriented consistently: faces disagree across {unbalanced} edges. "
                "Recalculate its normals to the outside.",
            )
        )
    return findings


def _faces(part: MeshPart) -> list[Finding]:
    """Reports faces that carry no surface, or carry it twice."""
    findings = []
    if degenerate := int(np.sum(is_degenerate(part.vertices[part.faces]))):
        findings.append(
            Finding("note", part.name, f"has {degenerate} degenerate faces, which are ignored.")
        )
    duplicates = len(part.faces) - len(np.unique(np.sort(part.faces, axis=1), axis=0))
    if duplicates:
        findings.append(
            Finding(
                "error",
                part.name,
                f"has {duplicates} duplicate faces: light would cross the surface twice at one "
                "point. Remove them.",
            )
        )
    return findings
