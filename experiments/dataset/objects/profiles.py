"""Profile curves in the half plane of a turned object (NumPy and SciPy only).

A point is (r, z): its distance from the axis, and its height. A *curve* is a dense polyline. A
*profile* is a curve from the axis to the axis with the object on its left, so that an outer one
goes from the bottom outwards and up; one that ends where it begins is a ring around the axis
instead. A *fillet* is an arc that replaces a corner, tangent to both of its sides.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d

Curve = Float[np.ndarray, "points 2"]
Corner = tuple[float, float] | tuple[float, float, float]

# Resolution of curves before they are resampled: arcs, and splines in world units.
_ARC_STEP = np.radians(2.0)
_SPLINE_STEP = 0.004

# Step at which a curve's curvature is evaluated, and window of its average, in steps.
_LOOK_STEP = 0.001
_LOOK_WINDOW = 9

# Largest growth of the spacing per unit of length, so that neighbours are similar: a long edge next
# to a fillet would carry the fillet's normals far into a flat.
_GROWTH = 0.4

# Least spacing: a sharp left turn in a curve is spread over the window.
_FINEST = 0.002


class Sampling(NamedTuple):
    """Resolution of a turned object.

    Attributes:
      edge: longest edge along a profile, in world units.
      turn: largest turn of a profile in one edge, in radians.
      segments: number of edges around the axis.
    """

    edge: float
    turn: float
    segments: int


def sampling(detail: float, *, segments: int = 96) -> Sampling:
    """Returns the sampling of a detail; the number of triangles grows with its square.

    Args:
      detail: level of detail; 1 is the one that is rendered.
      segments: number of segments around the axis at detail 1; never reduced below 16.
    """
    return Sampling(
        edge=0.08 / detail,
        turn=min(np.radians(10.0) / detail, np.radians(30.0)),
        segments=max(16, 4 * round(segments * detail / 4.0)),
    )


def filleted(*corners: Corner) -> Curve:
    """Returns a polyline with rounded corners.

    Args:
      corners: tuples (r, z) or (r, z, radius of the fillet), in world units.

    Raises:
      ValueError: if a fillet is too long for the adjacent sides.
    """
    points = np.array([corner[:2] for corner in corners], np.float64)
    radii = np.array([corner[2] if len(corner) == 3 else 0.0 for corner in corners])
    sides = np.diff(points, axis=0)
    lengths = np.linalg.norm(sides, axis=1)
    ways = sides / lengths[:, None]
    turns = np.zeros(len(points))
    turns[1:-1] = np.arctan2(
        ways[:-1, 0] * ways[1:, 1] - ways[:-1, 1] * ways[1:, 0],
        np.sum(ways[:-1] * ways[1:], axis=1),
    )
    used = radii * np.abs(np.tan(turns / 2.0))
    if np.any(crowded := used[:-1] + used[1:] > lengths * (1.0 + 1e-9)):
        side = int(np.argmax(crowded))
        raise ValueError(
            f"The fillets at {corners[side]} and {corners[side + 1]} overlap. Make them smaller, "
            "or move the corners apart."
        )
    pieces = [points[:1]]
    for i in range(1, len(points) - 1):
        pieces.append(_fillet(points[i], ways[i - 1], turns[i], radii[i]))
    return joined(*pieces, points[-1:])


def smooth(points: Sequence[tuple[float, float]] | Curve, *, ends: str = "axis") -> Curve:
    """Returns a smooth curve through points: a cubic spline over their chord length.

    Args:
      points: points (r, z), in world units.
      ends: boundary condition: `axis` to meet the axis perpendicularly at ends on it, `upright` to
        be parallel to the axis at ends off it as well.
    """
    knots = np.asarray(points, np.float64)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    conditions = [_end(knots[0], 1.0, ends), _end(knots[-1], -1.0, ends)]
    count = max(2, int(np.ceil(along[-1] / _SPLINE_STEP)))
    curve = CubicSpline(along, knots, bc_type=tuple(conditions))(np.linspace(0, along[-1], count))
    curve[[0, -1]] = knots[[0, -1]]
    return curve


def arc(centre: tuple[float, float], radius: float, first: float, last: float) -> Curve:
    """Returns an arc; angles in degrees from the outward direction, upwards positive."""
    count = max(2, int(np.ceil(abs(np.radians(last - first)) / (0.5 * _ARC_STEP))) + 1)
    angles = np.radians(np.linspace(first, last, count))
    curve = np.stack([np.cos(angles), np.sin(angles)], axis=1) * radius + np.asarray(centre)
    curve[np.abs(curve[:, 0]) < 1e-12, 0] = 0.0
    return curve


def joined(*curves: Curve) -> Curve:
    """Returns curves one after the other, without repeated points."""
    points = np.concatenate(curves)
    apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9
    return points[np.concatenate([[True], apart])]


def resampled(curve: Curve, cut: Sampling) -> Curve:
    """Returns a curve with edge lengths adapted to its curvature; both ends are kept.

    An edge turns by at most `cut.turn`, is at most `cut.edge` long, and not much longer than the
    previous one.
    """
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    looks = np.linspace(0.0, along[-1], max(8, int(np.ceil(along[-1] / _LOOK_STEP))) + 1)
    spacing = _spacing(_at(curve, along, looks), looks, cut)
    cost = cumulative_trapezoid(1.0 / spacing, looks, initial=0.0)
    count = max(4, int(np.ceil(cost[-1])))
    chosen = np.interp(np.linspace(0.0, cost[-1], count + 1), cost, looks)
    points = _at(curve, along, chosen)
    points[[0, -1]] = curve[[0, -1]]
    return points


def _spacing(
    points: Curve, looks: Float[np.ndarray, " points"], cut: Sampling
) -> Float[np.ndarray, " points"]:
    """Returns the length of an edge at each point."""
    step = looks[1] - looks[0]
    sides = np.diff(points, axis=0)
    turning = np.abs(np.diff(np.unwrap(np.arctan2(sides[:, 1], sides[:, 0])))) / step
    turning = np.concatenate([turning[:1], turning, turning[-1:]])
    bending = uniform_filter1d(turning, _LOOK_WINDOW, mode="nearest")
    spacing = np.minimum(cut.edge, cut.turn / np.maximum(bending, 1e-9))
    spacing = np.maximum(spacing, _FINEST)
    for _ in range(2):  # forwards and backwards
        spacing = np.minimum.accumulate(spacing - _GROWTH * looks) + _GROWTH * looks
        spacing = spacing[::-1]
    return spacing


def _at(
    curve: Curve, along: Float[np.ndarray, " points"], where: Float[np.ndarray, " samples"]
) -> Float[np.ndarray, "samples 2"]:
    return np.stack([np.interp(where, along, curve[:, axis]) for axis in range(2)], axis=1)


def _fillet(
    corner: Float[np.ndarray, "2"], way: Float[np.ndarray, "2"], turn: float, radius: float
) -> Curve:
    """Returns the arc that replaces a corner; without a fillet, the corner itself."""
    if radius == 0.0 or turn == 0.0:
        return corner[None]
    start = corner - radius * abs(np.tan(turn / 2.0)) * way
    sign = np.sign(turn)
    normal = sign * np.array([-way[1], way[0]])
    angles = np.linspace(0.0, abs(turn), max(2, int(np.ceil(abs(turn) / _ARC_STEP)) + 1))[:, None]
    return start + radius * (np.sin(angles) * way + (1.0 - np.cos(angles)) * normal)


def _end(point: Float[np.ndarray, "2"], sign: float, ends: str) -> tuple[int, tuple[float, float]]:
    """Returns the boundary condition of a spline: its derivative's order and value."""
    if point[0] == 0.0:
        return 1, (sign, 0.0)
    return (1, (0.0, 1.0)) if ends == "upright" else (2, (0.0, 0.0))
