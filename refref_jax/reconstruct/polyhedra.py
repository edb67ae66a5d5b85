"""Convex polyhedra: found in noisy meshes, with planes as unknowns (NumPy only).

A convex body has one face per outward normal, so the faces of a mesh are grouped by their normals
alone. Only normals that are much more frequent than those around them are those of a flat face: a
ball, or the side of a cylinder, has none. The planes are then fitted to the vertices nearest to
them.

Source: ours.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import HalfspaceIntersection, KDTree, QhullError

from refref_jax.geometry.triangle_meshes import (
    Mesh,
    diameter,
    face_normals,
    face_vectors,
    is_watertight,
    neighbours,
    unit_vectors,
)
from refref_jax.reconstruct.shapes import (
    FURTHEST,
    LARGEST_STEP,
    LARGEST_TURN,
    Matrix,
    Posed,
    Unknowns,
    check,
    frame_along,
    independent_prior,
    mesh_of,
    rms,
    robust_weights,
    tilt,
)

Planes = Float[np.ndarray, "planes 4"]

MOST = 60
"""Largest number of planes."""

# Standard deviations of the prior: angles in radians, offsets as a share of the diameter.
_ANGLE, _LENGTH = 0.02, 0.01

# Rounds of averaging normals between neighbouring faces that agree.
_AVERAGED = 30

# Directions among which normals are counted. A normal is that of a flat face if the area with
# normals within the first angle is at least this share of that within the second.
_DIRECTIONS = 6000
_NEAR, _AROUND = np.radians(3.0), np.radians(9.0)
_PEAKED = 0.5

# Least area of a face, and least area of all faces found, as shares of the surface.
_LEAST = 0.003
_COVERED = 0.8

# Rounds of assigning faces to planes and fitting these; least agreement of the normals.
_FITS = 5
_AGREES = 0.8

# Largest distance of a corner from the mesh, as a share of the diameter.
_REACHED = 0.05

# Largest angle by which faces that are taken to be parallel or perpendicular are not, the share of
# the largest singular value below which their derivatives depend on each other, and what may be
# left of the angle, radians.
_RIGHT, _DEPENDENT = np.radians(3.0), 1e-2
_EXACT = 1e-6

# Corners nearer to each other than this share of the diameter are one.
_SAME = 0.01


class Polyhedron:
    """A convex polyhedron.

    The unknowns are, for each plane, two angles that tilt its normal and the distance from the
    middle of the mesh. A corner is the point nearest to its planes, of which there may be more than
    three; then faces are not quite flat, but their normals are those of the planes.

    Attributes:
      name: kind of the shape.
      middle: point from which distances are measured, world units.
      planes: unit normals and distances of the fit.
    """

    name = "polyhedron"

    def __init__(
        self,
        middle: Float[np.ndarray, "3"],
        planes: Planes,
        touching: list[list[int]],
        polygons: list[list[int]],
    ) -> None:
        """Takes the planes and their connectivity.

        Args:
          middle: point inside, world units.
          planes: unit normals and distances from it.
          touching: planes that meet at each corner.
          polygons: corners of the face of each plane, counter-clockwise seen from outside.
        """
        self.middle, self.planes = middle, planes
        self._frames = np.stack([frame_along(normal) for normal in planes[:, :3]])
        rows = np.repeat(np.arange(len(touching)), [len(some) for some in touching])
        self._corner, self._plane = rows, np.concatenate(touching).astype(np.int64)
        fans = [[(of[0], of[i], of[i + 1]) for i in range(1, len(of) - 1)] for of in polygons]
        self._faces = np.concatenate(fans).astype(np.int64)
        owner = np.repeat(np.arange(len(planes)), [len(fan) for fan in fans])
        self._normal_ids = np.repeat(owner[:, None], 3, axis=1)

    @property
    def faces(self) -> Int[np.ndarray, "faces 3"]:
        """Returns the triangles."""
        return self._faces

    def start(self) -> Unknowns:
        """Returns the fit: no tilt, and the distances of the planes."""
        start = np.zeros((len(self.planes), 3))
        start[:, 2] = self.planes[:, 3]
        return start.ravel()

    def pose(self, unknowns: Unknowns) -> Posed:
        """Returns the polyhedron.

        With `A = sum n n^T` and `b = sum n d` over the planes of a corner, it is `v = A^-1 b`, and
        `dv = A^-1 sum (dn (d - n . v) + n (dd - dn . v))`.
        """
        given = unknowns.reshape(-1, 3)
        rotations = [np.stack(of) for of in zip(*(tilt(a) for a in given[:, :2]), strict=True)]
        normals, *turned = (self._frames @ rotation[..., 2:] for rotation in rotations)
        normals, slopes = normals[..., 0], np.concatenate(turned, axis=-1)
        count, at, of = int(self._corner.max()) + 1, self._corner, self._plane
        n, dn, d = normals[of], slopes[of], given[of, 2]
        matrix, side = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(matrix, at, n[:, :, None] * n[:, None])
        np.add.at(side, at, n * d[:, None])
        inverse = np.linalg.inv(matrix)
        corners = (inverse @ side[..., None])[..., 0]
        gap = d - np.sum(n * corners[at], axis=-1)
        moved = (
            dn * gap[:, None, None]
            - n[..., None] * np.einsum("pk,pkj->pj", corners[at], dn)[:, None]
        )
        moved = inverse[at] @ np.concatenate([moved, n[..., None]], axis=-1)
        planes = np.arange(len(normals))
        by_normals = np.concatenate([slopes, np.zeros((len(planes), 3, 1))], axis=-1)
        return Posed(
            self.middle + corners,
            self._faces,
            normals,
            self._normal_ids,
            _blocks(at, of, moved, (count, len(planes))),
            _blocks(planes, planes, by_normals, (len(planes), len(planes))),
        )

    def prior(self, unknowns: Unknowns) -> tuple[Matrix, Unknowns]:
        """Returns the prior: near the fit, within 0.02 radians and 1 % of the diameter."""
        size = diameter(self.pose(self.start()).vertices)
        deviations = np.tile([_ANGLE, _ANGLE, _LENGTH * size], len(self.planes))
        return independent_prior(deviations, unknowns - self.start())

    def scales(self) -> Unknowns:
        """Returns 0.02 radians and 0.77 % of the diameter."""
        size = diameter(self.pose(self.start()).vertices)
        return np.tile([LARGEST_TURN, LARGEST_TURN, LARGEST_STEP * size], len(self.planes))


class RightAngledPolyhedron:
    """A convex polyhedron, some of whose faces are parallel or at right angles, such as a box.

    The unknowns are the coordinates of the planes in the null space of the derivatives of these
    angles, in units of `Polyhedron.scales`. The angles stay as they are to first order: tilts of
    half a degree change them by a few thousandths of a degree.

    Attributes:
      name: kind of the shape.
    """

    name = "polyhedron with right angles"

    def __init__(
        self, planes: Polyhedron, origin: Unknowns, basis: Float[np.ndarray, "n m"]
    ) -> None:
        """Takes a polyhedron, its unknowns where the angles are right, and the null space."""
        self._planes, self._origin, self._basis = planes, origin, basis

    @property
    def faces(self) -> Int[np.ndarray, "faces 3"]:
        """Returns the triangles."""
        return self._planes.faces

    def start(self) -> Unknowns:
        """Returns zeros: the polyhedron that is nearest to the fit."""
        return np.zeros(self._basis.shape[1])

    def pose(self, unknowns: Unknowns) -> Posed:
        """Returns the polyhedron."""
        found = self._planes.pose(self._origin + self._basis @ unknowns)
        by_vertices, by_normals = found.by_vertices @ self._basis, found.by_normals @ self._basis
        return found._replace(by_vertices=by_vertices, by_normals=by_normals)

    def prior(self, unknowns: Unknowns) -> tuple[Matrix, Unknowns]:
        """Returns the prior: planes near those of the start, as `Polyhedron.prior` states it."""
        precision, _ = self._planes.prior(self._origin)
        here = self._basis.T @ precision @ self._basis
        return here, here @ unknowns

    def scales(self) -> Unknowns:
        """Returns ones."""
        return np.ones(self._basis.shape[1])


def with_right_angles(polyhedron: Polyhedron) -> RightAngledPolyhedron | None:
    """Makes faces that are nearly parallel or perpendicular exactly so.

    Args:
      polyhedron: polyhedron near the object.

    Returns:
      `None` if no two faces are within 3 degrees of either, or if all such angles together need a
      plane to turn by more than that, as those of a frustum do.
    """
    normals = polyhedron.planes[:, :3]
    agree = np.triu(normals @ normals.T, k=1)
    opposite = np.argwhere(agree < -np.cos(_RIGHT))
    upright = np.argwhere(np.triu(np.abs(agree) < np.sin(_RIGHT), k=1))
    if not len(opposite) + len(upright):
        return None
    x, scales = polyhedron.start(), polyhedron.scales()
    for _ in range(_FITS):
        errors, slopes = _angles(polyhedron.pose(x), opposite, upright)
        x = x - scales * (np.linalg.pinv(slopes * scales, rcond=_DEPENDENT) @ errors)
    found = polyhedron.pose(x)
    errors, slopes = _angles(found, opposite, upright)
    turned = np.sum(found.normals * normals, axis=-1) < np.cos(_RIGHT)
    inverted = np.sum(mesh_of(found).normals[:, 0] * face_vectors(*found[:2]), axis=-1) <= 0.0
    if np.abs(errors).max() > _EXACT or np.any(turned) or np.any(inverted):
        return None
    _, sizes, rows = np.linalg.svd(slopes * scales)
    rank = np.count_nonzero(sizes > _DEPENDENT * sizes[0])
    return RightAngledPolyhedron(polyhedron, x, scales[:, None] * rows[rank:].T)


def _angles(
    posed: Posed, opposite: Int[np.ndarray, "pairs 2"], upright: Int[np.ndarray, "others 2"]
) -> tuple[Float[np.ndarray, " errors"], Float[np.ndarray, "errors n"]]:
    """Returns sines of angles that shall be 180 degrees, cosines of right ones, and derivatives."""
    count = len(posed.normals)
    n, dn = posed.normals, csr_array(posed.by_normals).toarray().reshape(count, 3, -1)
    (a, b), (c, d) = opposite.T, upright.T
    turned = np.cross(dn[a], n[b][..., None], axis=1) + np.cross(n[a][..., None], dn[b], axis=1)
    leant = np.einsum("pk,pkj->pj", n[d], dn[c]) + np.einsum("pk,pkj->pj", n[c], dn[d])
    errors = np.concatenate([np.cross(n[a], n[b]).ravel(), np.sum(n[c] * n[d], axis=-1)])
    return errors, np.concatenate([turned.reshape(-1, dn.shape[-1]), leant])


def _blocks(
    rows: Int[np.ndarray, " n"],
    columns: Int[np.ndarray, " n"],
    values: Float[np.ndarray, "n 3 3"],
    shape: tuple[int, int],
) -> csr_array:
    """Returns a sparse matrix of blocks of 3 by 3."""
    three = np.arange(3)
    row = np.broadcast_to(3 * rows[:, None, None] + three[:, None], values.shape)
    column = np.broadcast_to(3 * columns[:, None, None] + three, values.shape)
    at = row.ravel(), column.ravel()
    return csr_array(coo_array((values.ravel(), at), shape=(3 * shape[0], 3 * shape[1])))


def fit_polyhedron(mesh: Mesh, *, furthest: float = FURTHEST) -> Polyhedron | None:
    """Fits a convex polyhedron to a mesh that has few large flat faces.

    Args:
      mesh: closed mesh.
      furthest: largest rms distance of the mesh from the polyhedron, as a share of its diameter.

    Returns:
      The polyhedron, or `None` if the mesh is further from it, is not convex, or has curved parts
      or more than 60 faces.

    Raises:
      ReconstructionError: if the mesh is empty, flat, inside out or not finite.
    """
    check(mesh)
    size = diameter(mesh.vertices)
    areas = np.linalg.norm(face_vectors(mesh.vertices, mesh.faces), axis=-1)
    centroids = mesh.vertices[mesh.faces].mean(axis=1)
    middle = areas @ centroids / areas.sum()
    normals = _averaged_normals(mesh, areas)
    peaks = _peaks(normals, areas / areas.sum())
    if peaks is None:
        return None
    points = (mesh.vertices[mesh.faces] - middle) / size
    planes = _fit_planes(peaks, points, normals, areas / areas.sum())
    outside = np.max(points.reshape(-1, 3) @ planes[:, :3].T - planes[:, 3], axis=-1)
    if rms(outside, np.repeat(areas, 3)) > furthest:
        return None
    connected = _connect(planes)
    if connected is None:
        return None
    planes[:, 3] *= size
    found = Polyhedron(middle, planes, *connected)
    away = KDTree(points.reshape(-1, 3)).query((found.pose(found.start()).vertices - middle) / size)
    if not is_watertight(found.faces) or away[0].max() > _REACHED:
        return None
    return found


def _averaged_normals(
    mesh: Mesh, areas: Float[np.ndarray, " faces"]
) -> Float[np.ndarray, "faces 3"]:
    """Returns unit normals of faces, averaged with those of neighbours unless these differ."""
    normals = face_normals(mesh.vertices[mesh.faces])
    first, second, _ = neighbours(mesh.faces)
    for _ in range(_AVERAGED):
        alike = np.maximum(np.sum(normals[first] * normals[second], axis=-1), 0.0) ** 8
        sums = areas[:, None] * normals
        for here, there in ((first, second), (second, first)):
            values = (alike * areas[there])[:, None] * normals[there]
            sums += np.stack(
                [np.bincount(here, values[:, i], len(normals)) for i in range(3)], axis=-1
            )
        normals = unit_vectors(sums)
    return normals


def _peaks(
    normals: Float[np.ndarray, "faces 3"], areas: Float[np.ndarray, " faces"]
) -> Float[np.ndarray, "planes 3"] | None:
    """Returns the normals of flat faces, or `None` if they cover too little of the surface."""
    number = np.arange(_DIRECTIONS) + 0.5
    height, turn = 1.0 - 2.0 * number / _DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * number
    radius = np.sqrt(1.0 - height**2)
    tree = KDTree(np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=-1))
    cell = tree.query(normals)[1]
    left, faces = np.bincount(cell, areas, _DIRECTIONS), KDTree(normals)
    found: list[np.ndarray] = []
    covered = 0.0
    close = tree.query_ball_point(tree.data, _NEAR)
    while len(found) <= MOST:
        density = np.array([left[some].sum() for some in close])
        direction = tree.data[np.argmax(density)]
        # The counted directions are coarse: begin with a wider cone.
        for angle in (2.0 * _NEAR, _NEAR, _NEAR):
            some = faces.query_ball_point(direction, angle)
            direction = unit_vectors(areas[some] @ normals[some]) if some else direction
        near, around = (areas[faces.query_ball_point(direction, a)].sum() for a in (_NEAR, _AROUND))
        if density.max() < _LEAST:
            break
        if near >= _PEAKED * around:
            found.append(direction)
            covered += around
        left[tree.query_ball_point(direction, _AROUND)] = 0.0
    return np.array(found) if 4 <= len(found) <= MOST and covered >= _COVERED else None


def _fit_planes(
    peaks: Float[np.ndarray, "planes 3"],
    points: Float[np.ndarray, "faces 3 3"],
    normals: Float[np.ndarray, "faces 3"],
    areas: Float[np.ndarray, " faces"],
) -> Planes:
    """Returns planes through the faces nearest to them; offsets start at the median."""
    agrees = normals @ peaks.T
    owner = np.argmax(agrees, axis=1)
    middle = points.mean(axis=1)
    offsets = [np.median(middle[owner == i] @ peak) for i, peak in enumerate(peaks)]
    planes = np.append(peaks, np.array(offsets)[:, None], axis=1)
    for _ in range(_FITS):
        away = np.abs(middle @ planes[:, :3].T - planes[:, 3])
        away[normals @ planes[:, :3].T < _AGREES] = np.inf
        owner = np.where(np.isfinite(away.min(axis=1)), np.argmin(away, axis=1), -1)
        for i in range(len(planes)):
            some = owner == i
            if some.sum() >= 1:
                planes[i] = _fit_plane(planes[i], points[some].reshape(-1, 3), areas[some])
    return planes


def _fit_plane(
    plane: Float[np.ndarray, "4"],
    points: Float[np.ndarray, "points 3"],
    areas: Float[np.ndarray, " faces"],
) -> Float[np.ndarray, "4"]:
    """Returns the plane through points by total least squares with robust weights."""
    weights = np.repeat(areas, 3) * robust_weights(points @ plane[:3] - plane[3])
    centre = weights @ points / weights.sum()
    away = points - centre
    normal = np.linalg.eigh((away * weights[:, None]).T @ away)[1][:, 0]
    normal *= np.sign(normal @ plane[:3])
    return np.append(normal, normal @ centre)


def _connect(planes: Planes) -> tuple[list[list[int]], list[list[int]]] | None:
    """Returns the planes of each corner and the corners of each plane, or `None` if open."""
    try:
        sides = HalfspaceIntersection(planes * [1.0, 1.0, 1.0, -1.0], np.zeros(3))
    except QhullError:
        return None
    points = sides.intersections
    if not np.all(np.isfinite(points)) or np.abs(points).max() > 2.0:
        return None
    pairs = KDTree(points).query_pairs(_SAME, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), bool), tuple(pairs.T)), shape=(len(points),) * 2)
    count, corner = connected_components(graph, directed=False)
    touching: list[set[int]] = [set() for _ in range(count)]
    for where, facet in zip(corner, sides.dual_facets, strict=True):
        touching[where].update(facet)
    middles = np.stack([points[corner == i].mean(axis=0) for i in range(count)])
    polygons = []
    for i, plane in enumerate(planes):
        mine = [j for j in range(count) if i in touching[j]]
        if len(mine) < 3:
            return None
        flat = (middles[mine] - middles[mine].mean(axis=0)) @ frame_along(plane[:3])
        polygons.append([mine[j] for j in np.argsort(np.arctan2(flat[:, 1], flat[:, 0]))])
    return [sorted(some) for some in touching], polygons
