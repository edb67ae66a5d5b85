"""Spheres of air, or of another medium, inside a solid object, as unknowns of a fit.

`ObjectWithBubbles` is a `gauss_newton.Model`: an object, and spheres inside it. A sphere that would
reach through the surface, or into an earlier one, is held inside: its centre moves away from the
nearest obstacle until the smallest bubble has room, and its radius shrinks until it fits.
`bubble_search` finds out where bubbles are.

What this cannot represent: bubbles that are not spherical; those that touch each other or the
surface (a small gap is left); bubbles in vessels. Where two obstacles are near the centre at the
same time, only the nearer one counts.

Source: ours.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float
from trimesh.triangles import closest_point, points_to_barycentric

from refref_jax.geometry.triangle_meshes import diameter, face_normals, unit_vectors
from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.optics.media import INDEX_OF_AIR
from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.contents import Solid
from refref_jax.reconstruct.families import Sphere
from refref_jax.reconstruct.gauss_newton import Candidate, Matrix
from refref_jax.reconstruct.model_selection import ObjectModel
from refref_jax.reconstruct.shapes import Posed, mesh_of

# Least radius of a bubble, and least distance from the surface and from other bubbles, as shares
# of the diameter of the object.
_LEAST, _GAP = 0.003, 0.001

# Standard deviations of the priors, and largest changes in a step, of centre and radius, as shares
# of the radius.
_DEVIATIONS, _STEPS = (1.0, 1.0, 1.0, 0.7), 0.25

# Subdivisions of the icosahedron that is the mesh of a bubble.
_SUBDIVISIONS = 4


class Bubble(NamedTuple):
    """A spherical bubble.

    Attributes:
      centre: position of its centre, world units.
      radius: radius, world units.
    """

    centre: Float[np.ndarray, "3"]
    radius: float


class _Held(NamedTuple):
    """Centre and radius of a bubble within its limits, and their derivatives."""

    values: Float[np.ndarray, "4"]
    by: scipy.sparse.csr_array


class Depth(NamedTuple):
    """How far a point is from the nearest obstacle.

    Attributes:
      distance: distance, world units; negative beyond the obstacle.
      away: unit direction in which it grows.
      by_obstacle: derivatives of the depth by the unknowns of the obstacle.
      curvature: derivatives of the direction as the point moves across it, per world unit.
      other: derivatives of the place of the obstacle, for the same.
    """

    distance: float
    away: Float[np.ndarray, "3"]
    by_obstacle: scipy.sparse.csr_array
    curvature: float = 0.0
    other: scipy.sparse.csr_array | None = None


class ObjectWithBubbles:
    """A solid object with spheres of another medium inside.

    The unknowns are those of the object, then centre and radius of each bubble, world units.

    Example:
      >>> model = ObjectWithBubbles(trial.model, trial.fit.x, [Bubble(np.zeros(3), 0.1)])
      >>> fit = gauss_newton.fit(model, model.start(), surface, pixels)
      >>> model.bubbles(fit.x)[0].radius

    Attributes:
      solid: model of the object, of one part.
      own: number of its unknowns.
      index: index of refraction in the bubbles.
    """

    def __init__(
        self,
        solid: ObjectModel,
        x: Float[np.ndarray, " own"],
        bubbles: Sequence[Bubble],
        *,
        index: float = INDEX_OF_AIR,
    ) -> None:
        """Takes the object at rest, and the bubbles at rest.

        Raises:
          ReconstructionError: if a radius is not positive, or a centre is not inside the object.
        """
        self.solid, self.own, self.index = solid, len(x), index
        self._at_rest = tuple(bubbles)
        self._rest = np.concatenate([x, *(np.append(each.centre, each.radius) for each in bubbles)])
        self._unit_sphere = Sphere(np.zeros(3), 1.0, subdivisions=_SUBDIVISIONS)
        outer = solid.pose(x).parts[0]
        self._size = diameter(outer.vertices)
        for each in bubbles:
            if not each.radius > 0.0 or not depth_inside(each.centre, outer).distance > 0.0:
                raise ReconstructionError(
                    f"A bubble of radius {each.radius:g} at {each.centre} is not inside the "
                    "object. Pass a centre inside and a positive radius."
                )

    def start(self) -> Float[np.ndarray, " unknowns"]:
        """Returns the unknowns at rest."""
        return self._rest.copy()

    def pose(self, x: Float[np.ndarray, " unknowns"]) -> Candidate:
        """Returns the object and the bubbles within their limits."""
        at_rest = self.solid.pose(x[: self.own])
        outer = at_rest.parts[0]
        outer = outer._replace(
            by_vertices=_widened(outer.by_vertices, len(x)),
            by_normals=_widened(outer.by_normals, len(x)),
        )
        held = [self._posed(each) for each in self._limited_bubbles(x, outer)]
        count = 1 + len(held)
        tint = np.asarray(at_rest.interfaces.tint, np.float64)[0].tolist()
        interfaces = nested(
            [self.solid.index_of(x[: self.own])] + [self.index] * (count - 1),
            [NO_PARENT] + [0] * (count - 1),
            tints=[tint] + [[1.0, 1.0, 1.0]] * (count - 1),
        )
        tinted = 3 * count if at_rest.by_tints.shape[0] else 0
        return Candidate(
            (outer, *held),
            interfaces,
            _widened(at_rest.by_indices, len(x), rows=count),
            _widened(at_rest.by_tints, len(x), rows=tinted),
        )

    def _posed(self, held: _Held) -> Posed:
        posed = self._unit_sphere.pose(held.values)
        by_vertices = scipy.sparse.csr_array(posed.by_vertices) @ held.by
        nothing = scipy.sparse.csr_array((3 * len(posed.normals), held.by.shape[1]))
        return posed._replace(by_vertices=by_vertices, by_normals=nothing)

    def _limited_bubbles(self, x: Float[np.ndarray, " unknowns"], outer: Posed) -> list[_Held]:
        """Returns the bubbles within their limits, apart from the surface and from earlier ones."""
        least, gap = _LEAST * self._size, _GAP * self._size
        found: list[_Held] = []
        for first in range(self.own, len(x), 4):
            by = scipy.sparse.eye_array(len(x)).tocsr()[first : first + 4]
            depths = [depth_inside(x[first : first + 3], outer)]
            depths += [_depth_beside(x[first : first + 3], each) for each in found]
            tightest = min(depths, key=lambda depth: depth.distance)
            found.append(_limited(x[first : first + 4], by, tightest, least, gap))
        return found

    def bubbles(self, x: Float[np.ndarray, " unknowns"]) -> tuple[Bubble, ...]:
        """Returns the bubbles within their limits."""
        outer = self.solid.pose(x[: self.own]).parts[0]
        outer = outer._replace(by_vertices=_widened(outer.by_vertices, len(x)))
        held = self._limited_bubbles(x, outer)
        return tuple(Bubble(each.values[:3], float(each.values[3])) for each in held)

    def index_of(self, x: Float[np.ndarray, " unknowns"]) -> float:
        """Returns the index of refraction of the glass."""
        return self.solid.index_of(x[: self.own])

    def solids(self, x: Float[np.ndarray, " unknowns"]) -> list[Solid]:
        """Returns the parts, as those of an ordinary scene; `glass` contains the bubbles."""
        candidate = self.pose(x)
        red, green, blue = np.asarray(candidate.interfaces.tint, np.float64)[0].tolist()
        outer, *bubbles = (mesh_of(part) for part in candidate.parts)
        glass = Solid("glass", outer, self.index_of(x), NO_PARENT, (red, green, blue))
        return [glass] + [
            Solid(f"bubble{number}", bubble, self.index, 0, (1.0, 1.0, 1.0))
            for number, bubble in enumerate(bubbles, 1)
        ]

    def prior(
        self, x: Float[np.ndarray, " unknowns"]
    ) -> tuple[Float[np.ndarray, "unknowns unknowns"], Float[np.ndarray, " unknowns"]]:
        """Returns the prior of the object, and that of bubbles near those at rest."""
        precision, pull = self.solid.prior(x[: self.own])
        whole = np.zeros((len(x), len(x)))
        whole[: self.own, : self.own] = precision
        deviations = [each.radius * np.array(_DEVIATIONS) for each in self._at_rest]
        weights = np.concatenate([np.zeros(0), *deviations]) ** -2.0
        rows = np.arange(self.own, len(x))
        whole[rows, rows] = weights
        return whole, np.concatenate([pull, weights * (x - self._rest)[self.own :]])

    def scales(self) -> Float[np.ndarray, " unknowns"]:
        """Returns the scales of the object, and a quarter of the radius of each bubble."""
        radii = np.array([each.radius for each in self._at_rest])
        return np.concatenate([self.solid.scales(), np.repeat(_STEPS * radii, 4)])


def _widened(matrix: Matrix, columns: int, *, rows: int | None = None) -> scipy.sparse.csr_array:
    """Returns a matrix with zeros to the right, and below."""
    found = scipy.sparse.coo_array(matrix)
    shape = (found.shape[0] if rows is None else rows, columns)
    return scipy.sparse.csr_array((found.data, (found.row, found.col)), shape=shape)


def depth_inside(point: Float[np.ndarray, "3"], outer: Posed) -> Depth:
    """Returns how deep a point is inside a surface.

    Args:
      point: a point, world units.
      outer: a closed surface, and its derivatives by some unknowns.

    Returns:
      The depth and its derivatives by the same unknowns. The direction is that away from the
      closest point; its turn is left out.
    """
    corners = outer.vertices[outer.faces]
    near = np.linalg.norm(outer.vertices - point, axis=-1)[outer.faces].min(axis=1)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max()
    some = np.flatnonzero(near <= near.min() + longest)
    on = closest_point(corners[some], np.broadcast_to(point, (len(some), 3)))
    distance = np.linalg.norm(on - point, axis=-1)
    nearest = np.flatnonzero(distance <= distance.min() + 1e-9 * longest)
    outward = unit_vectors(face_normals(corners[some[nearest]]).sum(axis=0)[None])[0]
    best = nearest[0]
    side = 1.0 if (point - on[best]) @ outward <= 0.0 else -1.0
    away = side * (point - on[best])
    length = float(np.linalg.norm(away))
    away = away / length if length > 1e-9 * longest else -outward
    shares = points_to_barycentric(corners[some[best]][None], on[best][None])[0]
    rows = 3 * outer.faces[some[best]][:, None] + np.arange(3)
    weights = -(shares[:, None] * away)
    by_vertices = scipy.sparse.csr_array(outer.by_vertices)[rows.ravel()]
    by = scipy.sparse.csr_array(weights.reshape(1, -1)) @ by_vertices
    return Depth(side * length, away, by)


def _depth_beside(point: Float[np.ndarray, "3"], other: _Held) -> Depth:
    """Returns how far a point is outside another bubble."""
    away = point - other.values[:3]
    length = float(np.linalg.norm(away))
    away = away / length if length > 0.0 else np.array([1.0, 0.0, 0.0])
    row = scipy.sparse.csr_array(np.append(-away, -1.0)[None])
    curvature = 1.0 / length if length > 0.0 else 0.0
    return Depth(length - float(other.values[3]), away, row @ other.by, curvature, other.by[:3])


def _limited(
    values: Float[np.ndarray, "4"],
    by: scipy.sparse.csr_array,
    depth: Depth,
    least: float,
    gap: float,
) -> _Held:
    """Returns a bubble that leaves a gap to an obstacle and has at least some radius."""
    centre, radius, away = values[:3], float(values[3]), depth.away[:, None]
    by_centre, by_radius = by[:3], by[3:]
    by_depth = scipy.sparse.csr_array(away.T) @ by_centre + depth.by_obstacle
    most, missing = depth.distance - gap, least + gap - depth.distance
    if missing > 0.0:
        centre = centre + missing * depth.away
        if depth.other is not None:
            across = scipy.sparse.csr_array(np.eye(3) - away @ away.T)
            by_centre = by_centre + missing * depth.curvature * (across @ (by[:3] - depth.other))
        by_centre = by_centre - scipy.sparse.csr_array(away) @ by_depth
        most, by_depth = least, 0.0 * by_depth
    if radius > most:
        radius, by_radius = most, by_depth
    elif radius < least:
        radius, by_radius = least, 0.0 * by_radius
    whole = scipy.sparse.vstack([by_centre, by_radius]).tocsr()
    return _Held(np.append(centre, radius), whole)
