"""Whether a surface bounds a convex body (NumPy only).

A ray that has left a convex body never meets it again, which spares casting it.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, KDTree, QhullError

from refref_jax.data.meshes import MeshPart
from refref_jax.geometry.corner_normals import is_degenerate
from refref_jax.geometry.triangle_meshes import is_watertight, volume

TOLERANCE = 1e-5
"""How deep below its convex hull a surface may lie, as a share of its diagonal.

Far above the rounding of single precision, and far below a dent that anyone would model.
"""

# A surface that lies on its hull and covers it once encloses the same volume.
_VOLUME_TOLERANCE = 1e-3

# Facets of the hull that are looked at first, nearest ones, and points times facets of one sweep.
_NEAREST = 8
_SWEEP = 1 << 21


def is_convex(part: MeshPart) -> bool:
    """Returns whether a part is one closed convex body with outward faces.

    All vertices and the middles of all faces must lie on the convex hull within `TOLERANCE`. Depth
    below a hull is a concave function, so between them a face lies at most three times as deep:
    there is no reflex edge.
    """
    faces = part.faces[~is_degenerate(part.vertices[part.faces])]
    if len(faces) == 0 or not is_watertight(faces):
        return False
    try:
        hull = ConvexHull(part.vertices)
    except QhullError:  # a flat part, or fewer than four points
        return False
    if not np.isclose(volume(part.vertices, part.faces), hull.volume, rtol=_VOLUME_TOLERANCE):
        return False
    corners = part.vertices[faces]
    points = np.concatenate([corners.reshape(-1, 3), corners.mean(axis=1)])
    tolerance = TOLERANCE * np.linalg.norm(np.ptp(part.vertices, axis=0))
    return _lie_on(hull, np.unique(points, axis=0), tolerance)


def encloses(outer: MeshPart, inner: MeshPart) -> bool:
    """Returns whether no vertex of a part lies outside of another one's convex hull."""
    hull = ConvexHull(np.concatenate([outer.vertices, inner.vertices]))
    return bool(np.all(hull.vertices < len(outer.vertices)))


def _lie_on(hull: ConvexHull, points: Float[np.ndarray, "points 3"], tolerance: float) -> bool:
    """Returns whether all points of a body lie on its hull: near the plane of one of its facets."""
    planes = np.asarray(hull.equations)
    middles = hull.points[hull.simplices].mean(axis=1)
    nearest = KDTree(middles).query(points, k=[*range(1, min(_NEAREST, len(planes)) + 1)])[1]
    depth = np.einsum("pkc,pc->pk", planes[nearest][..., :3], points) + planes[nearest][..., 3]
    rest = points[~_any_near(depth, tolerance)]
    step = max(1, _SWEEP // len(planes))
    for first in range(0, len(rest), step):
        depth = rest[first : first + step] @ planes[:, :3].T + planes[:, 3]
        if not np.all(_any_near(depth, tolerance)):
            return False
    return True


def _any_near(
    depth: Float[np.ndarray, "points planes"], tolerance: float
) -> Bool[np.ndarray, " points"]:
    return np.any(depth >= -tolerance, axis=1)
