"""Signed distances to solids: negative inside, zero on the surface, in world units (NumPy only).

A *field* is a function from points to signed distances. Those of this module are exact, so their
gradient has norm 1 wherever the nearest point is unique, and all of them are 1-Lipschitz (change by
at most 1 per unit). `field_operations` combines them, and preserves the Lipschitz bound.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

Points = Float[np.ndarray, "points 3"]
Distances = Float[np.ndarray, " points"]
Vector = Sequence[float]

# Number of points per block: a block's intermediate arrays fit in a core's cache.
_BLOCK = 1 << 14

# Newton's method for the nearest point of an ellipsoid: number of steps, tolerance of the last one
# (squared world units), and least coordinates as a share of the radii: at the centre of symmetry
# the nearest point is not unique.
_ELLIPSOID_STEPS = 12
_ELLIPSOID_TOLERANCE = 1e-13
_NEAR_CENTRE = 1e-4

# Number of segments of a tube that are evaluated around the nearest joint.
_AROUND_JOINT = (-2, -1, 0, 1)

# Largest change of radius as a share of a segment: beyond it one end would almost contain the
# other.
_STEEPEST = 0.999


class Field(NamedTuple):
    """A signed distance, and a bounding ball of the solid.

    Attributes:
      distance: function from points to signed distances.
      centre: centre of the ball.
      radius: radius of the ball, possibly `inf`. At any point outside the ball, `distance` is at
        least the distance to the ball.
    """

    distance: Callable[[Points], Distances]
    centre: tuple[float, float, float]
    radius: float

    def __call__(self, points: Points) -> Distances:
        """Returns signed distances of points."""
        return self.distance(points)


def evaluate(field: Field, points: Points) -> Distances:
    """Returns signed distances of many points, block by block."""
    starts = range(0, len(points), _BLOCK)
    values = [field(points[start : start + _BLOCK]) for start in starts]
    return np.concatenate(values) if values else np.zeros(0)


def gradient(field: Field, points: Points, *, step: float = 1e-5) -> Points:
    """Returns gradients by central differences over twice a step."""
    shifts = step * np.eye(3)
    slopes = [evaluate(field, points + s) - evaluate(field, points - s) for s in shifts]
    return np.stack(slopes, axis=-1) / (2.0 * step)


def sphere(centre: Vector, radius: float) -> Field:
    """A ball."""
    middle = np.asarray(centre, float)
    return Field(lambda p: np.linalg.norm(p - middle, axis=-1) - radius, _triple(middle), radius)


def ellipsoid(centre: Vector, radii: Vector) -> Field:
    """An ellipsoid along the axes.

    Source: Eberly, Distance from a Point to an Ellipsoid (2013). Newton's method solves the
    reciprocal of the secular equation, as in Moré and Sorensen (1983): it is concave, so that steps
    from the left never pass its root.
    """
    middle, axes = np.asarray(centre, float), np.asarray(radii, float)
    _require(bool(np.all(axes > 0.0)), f"The radii {radii} of an ellipsoid are not all positive.")
    column = axes[:, None]

    def distance(points: Points) -> Distances:
        # Coordinates are the first axis, so that sums run over complete arrays.
        y = np.maximum(np.abs((points - middle).T), _NEAR_CENTRE * column)
        t = np.max(column * y - column**2, axis=0, initial=-np.inf)
        for _ in range(_ELLIPSOID_STEPS):
            shift = t + column**2
            squares = (column * y / shift) ** 2
            total = np.sum(squares, axis=0)
            step = (np.sqrt(total) - 1.0) * total / np.sum(squares / shift, axis=0)
            t += step
            if np.all(np.abs(step) < _ELLIPSOID_TOLERANCE):
                break
        nearest = column**2 * y / (t + column**2)
        return np.copysign(np.sqrt(np.sum((nearest - y) ** 2, axis=0)), t)

    return Field(distance, _triple(middle), float(axes.max()))


def tube(
    curve: Float[np.ndarray, "joints 3"], radii: Float[np.ndarray, " joints"] | float
) -> Field:
    """The union of all balls along a polyline whose radius changes from joint to joint.

    The distance is exact unless the tube bends too sharply for its radius within a few segments;
    see `space_curves` for smooth polylines.

    Raises:
      ValueError: if the radius changes faster than the arc length.
    """
    radius = np.broadcast_to(np.asarray(radii, float), len(curve))
    along = np.diff(curve, axis=0)
    length = np.linalg.norm(along, axis=-1)
    slope = -np.diff(radius) / length
    gentle = bool(np.all(np.abs(slope) < _STEEPEST))
    _require(gentle, "The radius of a tube changes faster than its arc length.")
    axes, skew = along / length[:, None], slope / np.sqrt(1.0 - slope**2)
    tree = KDTree(curve)

    def segment(points: Points, i: Int[np.ndarray, " points"]) -> Distances:
        offset = points - curve[i]
        height = np.einsum("pc,pc->p", offset, axes[i])
        wide = np.sqrt(np.maximum(np.einsum("pc,pc->p", offset, offset) - height**2, 0.0))
        # The nearest position of the rolling ball.
        at = np.clip(height - wide * skew[i], 0.0, length[i])
        return np.hypot(height - at, wide) - radius[i] + slope[i] * at

    def distance(points: Points) -> Distances:
        if len(curve) == 2:
            return segment(points, np.zeros(len(points), np.int64))
        joint = tree.query(points)[1]
        around = [np.clip(joint + step, 0, len(length) - 1) for step in _AROUND_JOINT]
        return np.min([segment(points, i) for i in around], axis=0)

    middle = 0.5 * (curve.min(axis=0) + curve.max(axis=0))
    reach = np.max(np.linalg.norm(curve - middle, axis=-1) + radius)
    return Field(distance, _triple(middle), float(reach))


def box(half_extents: Vector, rounding: float = 0.0) -> Field:
    """A box around the origin, along the axes, with edges rounded inwards."""
    core = np.asarray(half_extents, float) - rounding
    _require(bool(np.all(core >= 0.0)), f"A box of {half_extents} is too small for its rounding.")

    def distance(points: Points) -> Distances:
        beyond = np.abs(points) - core
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
        return outside + np.minimum(np.max(beyond, axis=-1), 0.0) - rounding

    return Field(distance, (0.0, 0.0, 0.0), float(np.linalg.norm(half_extents)))


def torus(radius: float, thickness: float) -> Field:
    """A torus around the z axis: major radius `radius`, minor radius `thickness`."""

    def distance(points: Points) -> Distances:
        away = np.hypot(points[:, 0], points[:, 1]) - radius
        return np.hypot(away, points[:, 2]) - thickness

    return Field(distance, (0.0, 0.0, 0.0), radius + thickness)


def revolution(profile: Float[np.ndarray, "corners 2"]) -> Field:
    """A polygon of (distance from the z axis, z), revolved around that axis.

    Its edges may lie on the axis, but no corner may lie beyond it. Both orientations are allowed.

    Raises:
      ValueError: if a corner lies beyond the axis.
    """
    _require(bool(np.all(profile[:, 0] >= 0.0)), "A profile crosses its axis of revolution.")
    ends = np.roll(profile, -1, axis=0)
    # Edges on the axis are not part of the surface.
    real = (profile[:, 0] > 0.0) | (ends[:, 0] > 0.0)

    def distance(points: Points) -> Distances:
        flat = np.stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]], axis=-1)
        away = _to_segments(flat, profile[real], ends[real])
        return np.where(_in_polygon(flat, profile, ends), -away, away)

    low, high = profile[:, 1].min(), profile[:, 1].max()
    middle = 0.5 * (low + high)
    reach = np.max(np.hypot(profile[:, 0], profile[:, 1] - middle))
    return Field(distance, (0.0, 0.0, float(middle)), float(reach))


def revolution_wall(curve: Float[np.ndarray, "points 2"], thickness: float) -> Field:
    """A wall along an open curve of (distance from the z axis, z), revolved around that axis.

    The wall is the set of points within half a thickness of the curve, so its edge is a half
    circle.
    """

    def distance(points: Points) -> Distances:
        flat = np.stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]], axis=-1)
        return _to_segments(flat, curve[:-1], curve[1:]) - 0.5 * thickness

    middle = 0.5 * (curve[:, 1].min() + curve[:, 1].max())
    reach = np.max(np.hypot(curve[:, 0], curve[:, 1] - middle)) + 0.5 * thickness
    return Field(distance, (0.0, 0.0, float(middle)), float(reach))


def _to_segments(
    points: Float[np.ndarray, "points 2"],
    starts: Float[np.ndarray, "segments 2"],
    ends: Float[np.ndarray, "segments 2"],
) -> Distances:
    nearest = np.full(len(points), np.inf)
    for start, along in zip(starts, ends - starts, strict=True):
        offset = points - start
        share = np.clip(offset @ along / (along @ along), 0.0, 1.0)
        across = offset - share[:, None] * along
        nearest = np.minimum(nearest, np.einsum("pc,pc->p", across, across))
    return np.sqrt(nearest)


def _in_polygon(
    points: Float[np.ndarray, "points 2"],
    starts: Float[np.ndarray, "segments 2"],
    ends: Float[np.ndarray, "segments 2"],
) -> np.ndarray:
    """Returns the points inside a polygon: rays outwards cross it an odd number of times."""
    inside = np.zeros(len(points), bool)
    x, y = points.T
    for (ax, ay), (bx, by) in zip(starts, ends, strict=True):
        if ay != by:
            spans = (ay > y) != (by > y)
            inside ^= spans & (x < ax + (y - ay) / (by - ay) * (bx - ax))
    return inside


def _require(holds: bool, problem: str) -> None:
    if not holds:
        raise ValueError(f"{problem} Give other dimensions.")


def _triple(vector: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z
