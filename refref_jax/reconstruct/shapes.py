"""Closed surfaces that depend on unknowns, and the free surface among them, on the host.

A shape turns a vector of unknowns into a mesh of fixed connectivity and the exact derivatives of
its vertices and normals, as a Gauss-Newton solver needs them. `families` has the shapes of few
unknowns. The free surface is a mesh deformed along its normals by handles, which are vertices
spread evenly over it.

Sources: Max, Weights for Computing Vertex Normals from Facet Normals (1999), for the normals: they
are exact if the vertices lie on a sphere. The derivatives and the priors are ours.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csr_array, eye_array
from scipy.spatial import KDTree

from refref_jax.geometry.triangle_meshes import (
    Mesh,
    Vertices,
    diameter,
    is_degenerate,
    smooth_groups,
    unit_vectors,
    vertex_vectors,
    volume,
    with_short_edges,
)
from refref_jax.reconstruct import ReconstructionError

Unknowns = Float[np.ndarray, " n"]
Matrix: TypeAlias = csr_array | np.ndarray
Frame = Float[np.ndarray, "3 3"]
AtCorners = Float[np.ndarray, "corners 3"]

LARGEST_STEP = 0.0077
"""A sensible largest step of a length per iteration, as a share of the diameter of the mesh."""

LARGEST_TURN = 0.02
"""A sensible largest step of an angle per iteration, in radians."""

FURTHEST = 0.01
"""Largest rms distance of a mesh from a family that may explain it, as a share of its diameter."""

# Handles per vertex, and neighbours of a handle in the prior.
_NEAREST = 6

# Mean distance between handles, as a share of the diameter, and the least distance between two as
# a share of the mean distance.
_SPACING = 1.0 / 44.0
_APART = 0.82

# Robust weights 1 / (1 + (e / s)^2)^2 have s at this multiple of the median error.
_ROBUST = 1.5

# Cosine of the angle between normals at a crease.
_CREASE = math.cos(math.radians(10.0))

# Longest edge of a mesh that is sampled at its vertices, as a share of the diameter.
_LONGEST = 0.04

# Lengths of the priors are stated for bodies of this diameter, world units.
_STATED_FOR = 2.6


class Posed(NamedTuple):
    """A surface at given unknowns, and its derivatives.

    Attributes:
      vertices: world units.
      faces: counter-clockwise seen from outside.
      normals: unit, outward, shared between corners.
      normal_ids: number of the normal of each corner.
      by_vertices: derivatives of the vertices, `[3 vertices, n]`; row `3 v + axis`.
      by_normals: derivatives of the normals, `[3 normals, n]`; row `3 i + axis`.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "normals 3"]
    normal_ids: Int[np.ndarray, "faces 3"]
    by_vertices: Matrix
    by_normals: Matrix


@runtime_checkable
class Shape(Protocol):
    """A closed surface that depends on unknowns."""

    @property
    def name(self) -> str:
        """Kind of the shape, in words."""

    def start(self) -> Unknowns:
        """Returns the unknowns of the fit to the mesh."""

    def pose(self, unknowns: Unknowns) -> Posed:
        """Returns the surface; its connectivity does not depend on the unknowns."""

    def prior(self, unknowns: Unknowns) -> tuple[Matrix, Unknowns]:
        """Returns the precision matrix and the gradient of the negative log prior."""

    def scales(self) -> Unknowns:
        """Returns a sensible largest step of each unknown, in world units or radians."""


def mesh_of(posed: Posed) -> Mesh:
    """Returns the surface as a mesh, whose normals are per corner."""
    return Mesh(posed.vertices, posed.faces, posed.normals[posed.normal_ids])


def vertex_normals_of(part: Posed) -> Float[np.ndarray, "vertices 3"]:
    """Returns the mean of the corner normals at each vertex."""
    at, each = part.faces.ravel(), part.normals[part.normal_ids.ravel()]
    sums = [np.bincount(at, each[:, axis], len(part.vertices)) for axis in range(3)]
    return unit_vectors(np.stack(sums, axis=-1))


def edges_of(faces: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "edges 2"]:
    """Returns each edge of a closed mesh once."""
    both = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    return both[both[:, 0] < both[:, 1]]


class Creases(NamedTuple):
    """Edges across which the shading normals jump.

    Attributes:
      edges: their vertices.
      faces: the faces on both sides.
    """

    edges: Int[np.ndarray, "creases 2"]
    faces: Int[np.ndarray, "creases 2"]


def creases_of(part: Posed) -> Creases:
    """Returns the edges of a closed mesh whose normals differ by more than 10 degrees."""
    around = [0, 1, 1, 2, 2, 0]
    both, ids = (x[:, around].reshape(-1, 2) for x in (part.faces, part.normal_ids))
    turned = both[:, 0] > both[:, 1]
    both[turned], ids[turned] = both[turned, ::-1], ids[turned, ::-1]
    order = np.lexsort(both.T)
    first, second = order[::2], order[1::2]
    if not np.array_equal(both[first], both[second]):
        raise ReconstructionError("A mesh is not closed, so its outlines are unknown. Close it.")
    cosines = np.sum(part.normals[ids[first]] * part.normals[ids[second]], axis=-1)
    sharp = np.any(cosines < _CREASE, axis=1)
    return Creases(both[first][sharp], np.stack([first, second], axis=-1)[sharp] // 3)


class Cloud(NamedTuple):
    """Samples of a surface.

    Attributes:
      points: world units.
      normals: unit, outward.
      areas: share of the surface that each point stands for; they sum to 1.
    """

    points: Float[np.ndarray, "points 3"]
    normals: Float[np.ndarray, "points 3"]
    areas: Float[np.ndarray, " points"]


def cloud_of(mesh: Mesh) -> Cloud:
    """Returns the vertices of a mesh, with normals averaged by area, as samples of its surface.

    Long edges are divided first, so that a flat face of few vertices has samples inside.

    Raises:
      ReconstructionError: if the mesh is empty, flat, inside out or not finite.
    """
    check(mesh)
    middle, size = mesh.vertices.mean(axis=0), diameter(mesh.vertices)
    small = mesh._replace(vertices=(mesh.vertices - middle) / size)
    vertices, faces, _ = with_short_edges(small, _LONGEST)
    vectors = vertex_vectors(vertices, faces)
    areas = np.linalg.norm(vectors, axis=-1)
    used = areas > 0.0
    points = middle + size * vertices[used]
    return Cloud(points, unit_vectors(vectors[used]), areas[used] / areas.sum())


def check(mesh: Mesh) -> None:
    """Checks that a mesh encloses a body.

    Raises:
      ReconstructionError: if the mesh is empty, flat, inside out or not finite.
    """
    if len(mesh.faces) < 4 or len(mesh.vertices) < 4:
        raise ReconstructionError(
            f"The mesh has {len(mesh.vertices)} vertices and {len(mesh.faces)} faces, so it "
            "encloses nothing. Pass a closed mesh."
        )
    if not np.all(np.isfinite(mesh.vertices)):
        raise ReconstructionError("A vertex of the mesh is not finite. Remove it from the mesh.")
    spread = np.linalg.svd(mesh.vertices - mesh.vertices.mean(axis=0), compute_uv=False)
    if spread[2] <= 1e-9 * spread[0]:
        raise ReconstructionError("The mesh is flat, so it encloses nothing. Pass a closed mesh.")
    if volume(mesh.vertices, mesh.faces) <= 0.0:
        raise ReconstructionError(
            "The faces of the mesh point inwards. Reverse the order of their corners."
        )


def tilt(angles: Float[np.ndarray, "2"]) -> tuple[Frame, Frame, Frame]:
    """Returns the rotation about x by one angle after y by another, and its two derivatives."""
    (c, d), (s, t) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    about_y = np.array([[d, 0.0, t], [0.0, 1.0, 0.0], [-t, 0.0, d]])
    by_x = np.array([[0.0, 0.0, 0.0], [0.0, -s, -c], [0.0, c, -s]])
    by_y = np.array([[-t, 0.0, d], [0.0, 0.0, 0.0], [-d, 0.0, -t]])
    return about_x @ about_y, by_x @ about_y, about_x @ by_y


def frame_along(direction: Float[np.ndarray, "3"]) -> Frame:
    """Returns a right-handed frame whose third column has a direction."""
    third = direction / np.linalg.norm(direction)
    first = np.cross(third, np.eye(3)[np.argmin(np.abs(third))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third], axis=-1)


def robust_weights(errors: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns weights that fade for errors above 1.5 times the median, or a tenth of their rms."""
    scale = max(
        _ROBUST * float(np.median(np.abs(errors))), 0.1 * float(np.sqrt(np.mean(errors**2))), 1e-300
    )
    return (1.0 + (errors / scale) ** 2) ** -2.0


class FreeSurface:
    """A mesh that handles deform along its normals.

    The unknowns are the displacements of the handles in world units, positive outwards. A vertex
    moves along its normal at rest by the weighted mean of its nearest handles. Handles on the other
    side of a thin wall are far: distances include the difference of the normals, times twice the
    mean distance between handles. At rest, shading normals are the means of those of the mesh
    within its smooth groups; they change as Max's do. Their derivatives are exact.

    Attributes:
      name: kind of the shape.
      mesh: mesh at rest.
      handles: vertices that are handles.
      weights: shares of the handles in the displacement of each vertex, `[vertices, handles]`.
    """

    name = "free surface"

    def __init__(
        self,
        mesh: Mesh,
        spacing: float | None = None,
        *,
        roughness: float = 0.002,
        size: float = 0.02,
    ) -> None:
        """Places the handles.

        Args:
          mesh: mesh at rest.
          spacing: mean distance between handles, world units; by default 1/44 of the diameter.
          roughness: standard deviation of a handle minus the mean of its neighbours, in world
            units of a body of diameter 2.6; scaled to that of the mesh.
          size: standard deviation of a displacement, in the same units.

        Raises:
          ReconstructionError: if the mesh is empty, flat, inside out or not finite, or `spacing`
            leaves fewer than 4 handles.
        """
        check(mesh)
        self.mesh = mesh
        self._size = diameter(mesh.vertices)
        spacing = _SPACING * self._size if spacing is None else spacing
        self.directions = unit_vectors(vertex_vectors(mesh.vertices, mesh.faces))
        self.handles = _spread(mesh.vertices, _APART * spacing)
        if len(self.handles) < 4:
            raise ReconstructionError(
                f"spacing={spacing:g} leaves {len(self.handles)} handles. Pass a smaller one."
            )
        places = np.concatenate([mesh.vertices, 2.0 * spacing * self.directions], axis=-1)
        self.weights = _shares(places, self.handles)
        scale = self._size / _STATED_FOR
        uneven = _unevenness(places[self.handles])
        self._precision = csr_array(
            uneven.T @ uneven / (scale * roughness) ** 2
            + eye_array(len(self.handles)) / (scale * size) ** 2
        )
        groups = smooth_groups(mesh.vertices, mesh.faces)
        kept = ~is_degenerate(mesh.vertices[mesh.faces])
        plain = _Corners(mesh.faces, groups, kept, np.zeros((int(groups.max()) + 1, 3)))
        at_rest, _ = _shading_normals(mesh.vertices, self.directions, plain)
        given = unit_vectors(_summed(groups.ravel(), mesh.normals.reshape(-1, 3), len(at_rest)))
        known = np.any(given != 0.0, axis=-1, keepdims=True)
        self._corners = plain._replace(offsets=np.where(known, given - at_rest, 0.0))

    def start(self) -> Unknowns:
        """Returns no displacement."""
        return np.zeros(len(self.handles))

    def pose(self, unknowns: Unknowns) -> Posed:
        """Returns the deformed mesh."""
        shifts = self.weights @ unknowns
        vertices = self.mesh.vertices + shifts[:, None] * self.directions
        normals, slopes = _shading_normals(vertices, self.directions, self._corners)
        return Posed(
            vertices,
            self.mesh.faces,
            normals,
            self._corners.groups,
            csr_array(_along(self.directions) @ self.weights),
            csr_array(slopes @ self.weights),
        )

    def prior(self, unknowns: Unknowns) -> tuple[Matrix, Unknowns]:
        """Returns the prior: displacements are small, and handles move like their neighbours."""
        return self._precision, self._precision @ unknowns

    def scales(self) -> Unknowns:
        """Returns 0.0077 of the diameter."""
        return np.full(len(self.handles), LARGEST_STEP * self._size)


class _Corners(NamedTuple):
    """What does not change when a mesh deforms.

    Attributes:
      faces: corner indices.
      groups: number of the normal of each corner.
      kept: faces that are not degenerate.
      offsets: given normals minus Max's, at rest.
    """

    faces: Int[np.ndarray, "faces 3"]
    groups: Int[np.ndarray, "faces 3"]
    kept: Bool[np.ndarray, " faces"]
    offsets: Float[np.ndarray, "groups 3"]


def _spread(vertices: Vertices, apart: float) -> Int[np.ndarray, " handles"]:
    """Returns vertices no two of which are nearer than a distance; all others are near one."""
    tree = KDTree(vertices)
    free = np.ones(len(vertices), bool)
    chosen = []
    for vertex in np.random.default_rng(0).permutation(len(vertices)):
        if free[vertex]:
            chosen.append(vertex)
            free[tree.query_ball_point(vertices[vertex], apart)] = False
    return np.sort(np.array(chosen, np.int64))


def _shares(
    places: Float[np.ndarray, "vertices 6"], handles: Int[np.ndarray, " handles"]
) -> csr_array:
    """Returns the weights of the nearest handles of each vertex, which sum to 1."""
    count = min(_NEAREST + 1, len(handles))
    away, nearest = KDTree(places[handles]).query(places, k=count)
    # One handle more than has a say, where the weights fade to (almost) nothing.
    reach = 1.001 * away[:, -1:]
    shares = (1.0 - (away / reach) ** 2)[:, : max(count - 1, 1)] ** 2
    shares /= shares.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(places)), shares.shape[1])
    at = (rows, nearest[:, : shares.shape[1]].ravel())
    return csr_array(coo_array((shares.ravel(), at), shape=(len(places), len(handles))))


def _unevenness(places: Float[np.ndarray, "handles 6"]) -> csr_array:
    """Returns the matrix that maps displacements to handle minus mean of its neighbours."""
    count = min(_NEAREST, len(places) - 1)
    around = KDTree(places).query(places, k=count + 1)[1][:, 1:]
    rows = np.repeat(np.arange(len(places)), count)
    shape = (len(places), len(places))
    mean = coo_array((np.full(rows.size, 1.0 / count), (rows, around.ravel())), shape=shape)
    return csr_array(eye_array(len(places)) - mean)


def _along(directions: Vertices) -> csr_array:
    """Returns the matrix `[3 vertices, vertices]` from displacements to vertices."""
    count = len(directions)
    columns = np.repeat(np.arange(count), 3)
    return csr_array((directions.ravel(), columns, np.arange(3 * count + 1)))


def _shading_normals(
    vertices: Vertices, directions: Vertices, corners: _Corners
) -> tuple[Float[np.ndarray, "groups 3"], csr_array]:
    """Returns the normals, and their derivatives `[3 groups, vertices]` by displacements."""
    faces, groups = corners.faces[corners.kept], corners.groups[corners.kept]
    sums = np.zeros_like(corners.offsets)
    slopes, rows, columns = [], [], []
    for corner in range(3):
        around = [faces[:, (corner + step) % 3] for step in range(3)]
        moving = [directions[each] for each in around]
        vectors, by_vertices = _max_vectors([vertices[each] for each in around], moving)
        sums += _summed(groups[:, corner], vectors, len(sums))
        slopes += by_vertices
        rows += [groups[:, corner]] * 3
        columns += around
    row = np.concatenate(rows)
    normals, slope = _made_unit(sums, np.concatenate(slopes), row)
    normals, slope = _made_unit(normals + corners.offsets, slope, row)
    at = (3 * row[:, None] + np.arange(3)).ravel(), np.repeat(np.concatenate(columns), 3)
    return normals, csr_array(coo_array((slope.ravel(), at), shape=(normals.size, len(vertices))))


def _max_vectors(
    corners: Sequence[AtCorners], directions: Sequence[AtCorners]
) -> tuple[AtCorners, list[AtCorners]]:
    """Returns each face's share of Max's normal at its first corner, and its derivatives.

    With edges a and b of a corner, they are `m = a x b / (|a|^2 |b|^2)`, and
    `dm = (da x b + a x db) / (|a|^2 |b|^2) - 2 m (a da / |a|^2 + b db / |b|^2)`.

    Args:
      corners: the three corners of each face.
      directions: directions in which they move.
    """
    (p, q, r), (dp, dq, dr) = corners, directions
    a, b = q - p, r - p
    aa, bb = np.sum(a**2, axis=-1, keepdims=True), np.sum(b**2, axis=-1, keepdims=True)
    m = np.cross(a, b) / (aa * bb)

    def slope(turned: AtCorners, along: AtCorners) -> AtCorners:
        return turned / (aa * bb) - 2.0 * np.sum(along, axis=-1, keepdims=True) * m

    of_p = slope(np.cross(dp, a - b), -(a / aa + b / bb) * dp)
    return m, [of_p, slope(np.cross(dq, b), a * dq / aa), slope(np.cross(a, dr), b * dr / bb)]


def _made_unit(
    sums: Vertices, slopes: AtCorners, row: Int[np.ndarray, " corners"]
) -> tuple[Vertices, AtCorners]:
    """Returns `n = s / |s|` of each row, and derivatives: `(I - n n^T) ds / |s|`; 0 stays 0."""
    length = np.linalg.norm(sums, axis=-1, keepdims=True)
    inverse = np.divide(1.0, length, out=np.zeros_like(length), where=length > 0.0)
    normals = sums * inverse
    slopes = slopes * inverse[row]
    return normals, slopes - np.sum(slopes * normals[row], axis=-1, keepdims=True) * normals[row]


def _summed(at: Int[np.ndarray, " corners"], values: AtCorners, count: int) -> Vertices:
    return np.stack([np.bincount(at, values[:, i], count) for i in range(3)], axis=-1)


def independent_prior(
    deviations: Float[np.ndarray, " n"], away: Float[np.ndarray, " n"]
) -> tuple[np.ndarray, Unknowns]:
    """Returns the prior of independent unknowns: precision matrix and gradient.

    Args:
      deviations: standard deviation of each unknown.
      away: unknowns minus their means.
    """
    return np.diag(deviations**-2.0), away / deviations**2


def rms(values: np.ndarray, weights: np.ndarray) -> float:
    """Returns the root of the weighted mean square."""
    return float(np.sqrt(np.sum(weights * values**2) / np.sum(weights)))


class FixedShape:
    """A mesh without unknowns, as for a search of its index alone.

    Attributes:
      name: kind of the shape.
      mesh: the mesh.
    """

    name = "as it is"

    def __init__(self, mesh: Mesh) -> None:
        """Takes the mesh."""
        self.mesh = mesh

    def start(self) -> Unknowns:
        """Returns no unknowns."""
        return np.zeros(0)

    def pose(self, unknowns: Unknowns) -> Posed:
        """Returns the mesh; each corner has its own normal."""
        del unknowns
        mesh = self.mesh
        ids = np.arange(3 * len(mesh.faces)).reshape(-1, 3)
        normals = mesh.normals.reshape(-1, 3)
        nothing = csr_array((3 * len(mesh.vertices), 0)), csr_array((3 * len(normals), 0))
        return Posed(mesh.vertices, mesh.faces, normals, ids, *nothing)

    def prior(self, unknowns: Unknowns) -> tuple[Matrix, Unknowns]:
        """Returns nothing."""
        del unknowns
        return np.zeros((0, 0)), np.zeros(0)

    def scales(self) -> Unknowns:
        """Returns nothing."""
        return np.zeros(0)
