"""Which pieces of a planar curve are straight (NumPy only).

`straight_pieces` divides a curve into straight lines and arcs of circles at the least cost, by
dynamic programming over all divisions. `corners_of` extends the lines until they meet.

Sources: Bellman, On the Approximation of Curves by Line Segments Using Dynamic Programming (1961),
for the search; Kåsa, A Circle Fitting Procedure and Its Error Analysis (1976), for the arcs. Their
combination is ours.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from refref_jax.reconstruct.revolution import Curve, Profile

# Samples of a curve.
_SAMPLES = 400

# Cost of a line and of an arc, in squared errors of independent samples, which are this far apart,
# as a share of the size.
_LINE, _ARC = 8.0, 12.0
_INDEPENDENT = 0.02

# Shortest line, and longest arc at a pole that a cone's tip may have, as shares of the size.
_SHORTEST, _TIP = 0.012, 0.05

# An arc that turns further than this, in radians, goes around two corners.
_U_TURN = 2.2

# Lines that turn by less, in radians, are one; arcs that turn by less are lines.
_STRAIGHT = 0.05
_LEAST_ARC = 0.3


class Line(NamedTuple):
    """A straight piece of a curve.

    Attributes:
      first: number of its first sample.
      last: number of its last sample.
      point: a point on it.
      along: unit direction, that of the curve.
    """

    first: int
    last: int
    point: Float[np.ndarray, "2"]
    along: Float[np.ndarray, "2"]


def even_samples(profile: Profile) -> Curve:
    """Returns the samples of a profile, in even steps; a closed one ends where it begins."""
    points = profile.points
    if profile.closed:
        points = np.concatenate([points, points[:1]])
    length = np.cumsum(np.linalg.norm(np.diff(points, axis=0, prepend=points[:1]), axis=-1))
    ticks = np.linspace(0.0, length[-1], _SAMPLES + 1)
    return np.stack([np.interp(ticks, length, points[:, i]) for i in (0, 1)], axis=-1)


def straight_pieces(samples: Curve, deviation: float, size: float) -> list[Line]:
    """Returns the straight pieces of a curve; arcs of circles lie between them.

    The division has the least sum of squared distances from lines and arcs, over the squared
    standard deviation, plus a cost of each piece.

    Args:
      samples: points of the curve in even steps.
      deviation: standard deviation of the points from an ideal curve.
      size: diameter of the body.
    """
    line, arc = _squares((samples - samples.mean(axis=0)) / size)
    length = float(np.linalg.norm(np.diff(samples, axis=0), axis=-1).sum()) / size
    unit = length / (len(samples) - 1)
    scale = unit / _INDEPENDENT / (deviation / size) ** 2
    first, last = np.indices(line.shape)
    line = np.where((last - first) * unit >= _SHORTEST, line * scale + _LINE, np.inf)
    arc = np.where(np.isfinite(arc), arc * scale + _ARC, np.inf)
    cost, best = np.zeros(len(samples)), np.zeros(len(samples), np.int64)
    cheapest = np.minimum(line, arc)
    for end in range(1, len(samples)):
        total = cost[:end] + cheapest[:end, end]
        best[end] = np.argmin(total)
        cost[end] = total[best[end]]
    found: list[Line] = []
    end = len(samples) - 1
    while end > 0:
        start = int(best[end])
        if line[start, end] <= arc[start, end]:
            one = _line_through(samples, start, end)
            joins = found and found[-1].first == end
            if joins and abs(_turn(one.along, found[-1].along)) < _STRAIGHT:
                one = _line_through(samples, start, found.pop().last)
            found.append(one)
        end = start
    return found[::-1]


def _line_through(samples: Curve, first: int, last: int) -> Line:
    points = samples[first : last + 1]
    middle = points.mean(axis=0)
    along = np.linalg.svd(points - middle)[2][0]
    return Line(first, last, middle, along * np.sign(along @ (points[-1] - points[0])))


def _squares(points: Curve) -> tuple[np.ndarray, np.ndarray]:
    """Returns sums of squared distances from the best line, and from Kåsa's circle.

    Both are `[first, last]`: of the points from the first to the last. The circle `|p|^2 + a x +
    b y + c = 0` has the least sum of squares of the left side, which is the distance times twice
    the radius. Arcs that hardly turn have infinite sums.
    """
    x, y = points.T
    z = x * x + y * y
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, z * x, z * y, z, z * z])
    sums = np.concatenate([np.zeros((len(terms), 1)), np.cumsum(terms, axis=1)], axis=1)
    one, sx, sy, xx, xy, yy, zx, zy, sz, zz = sums[:, None, 1:] - sums[:, :-1, None]
    count = np.maximum(one, 1.0)
    a, b, c = xx - sx * sx / count, xy - sx * sy / count, yy - sy * sy / count
    line = 0.5 * (a + c) - np.hypot(0.5 * (a - c), b)
    u, v, w = zx - sz * sx / count, zy - sz * sy / count, zz - sz * sz / count
    determinant = np.maximum(a * c - b * b, 1e-14)
    p, q = (b * v - c * u) / determinant, (b * u - a * v) / determinant
    left = w + p * u + q * v
    r = -(sz + p * sx + q * sy) / count
    radius = np.maximum(0.25 * (p * p + q * q) - r, 1e-9)
    step = np.linalg.norm(points[1] - points[0])
    bent = (one - 1.0) * step > _LEAST_ARC * np.sqrt(radius)
    line = np.where(one > 1.0, np.maximum(line, 0.0), np.inf)
    return line, np.where(bent, np.maximum(left / (4.0 * radius), 0.0), np.inf)


class Corners(NamedTuple):
    """Corners of a profile before rounding.

    Attributes:
      points: where its straight pieces meet; an open profile begins and ends on the axis.
      fillets: radii of the corners that are not on the axis.
    """

    points: Curve
    fillets: Float[np.ndarray, " rounded"]


def find_corners(profile: Profile, deviation: float, size: float) -> Corners | None:
    """Returns the corners between the straight pieces of a profile.

    Args:
      profile: profile in the half-plane.
      deviation: standard deviation of the profile from an ideal one.
      size: diameter of the body.

    Returns:
      The corners, or `None` if straight pieces do not meet, or an arc meets the axis.
    """
    samples = even_samples(profile)
    lines = straight_pieces(samples, deviation, size)
    if profile.closed and lines:
        longest = max(lines, key=lambda line: line.last - line.first)
        shift = (longest.first + longest.last) // 2
        samples = np.concatenate([samples[shift:-1], samples[: shift + 1]])
        lines = straight_pieces(samples, deviation, size)
    if len(lines) < 2 + profile.closed:
        return None
    step = float(np.linalg.norm(np.diff(samples, axis=0), axis=-1).mean())
    ends = lines[0].first, len(samples) - 1 - lines[-1].last
    if max(ends) * step > (0.0 if profile.closed else _TIP * size):
        return None
    met = [_meet(samples, *pair, step) for pair in itertools.pairwise(lines)]
    if any(each is None for each in met):
        return None
    corners = [corner for each in met if each is not None for corner in each]
    points, fillets = (np.array(each) for each in zip(*corners, strict=True))
    if profile.closed:
        return Corners(points, fillets)
    poles = [_on_axis(line) for line in (lines[0], lines[-1])]
    points = np.concatenate([[poles[0]], points, [poles[1]]])
    far = np.abs(points[[0, -1]] - samples[[0, -1]]).max() > _TIP * size
    return None if far or points[1:-1, 0].min() <= 0.0 else Corners(points, fillets)


def _on_axis(line: Line) -> Float[np.ndarray, "2"]:
    """Returns where a line meets the axis, far away if it is parallel."""
    along = line.along[0] if abs(line.along[0]) > 1e-9 else 1e-9
    return np.array([0.0, line.point[1] - line.point[0] * line.along[1] / along])


def _meet(
    samples: Curve, before: Line, after: Line, step: float
) -> list[tuple[Float[np.ndarray, "2"], float]] | None:
    """Returns the corner between two lines and its radius, or two if an arc turns back."""
    low, high = before.last, max(after.first, before.last)
    middle, reach = (low + high) // 2, max((high - low) // 8, 1)
    half = samples[min(middle + reach, len(samples) - 1)] - samples[max(middle - reach, 0)]
    half = half / max(float(np.linalg.norm(half)), 1e-300)
    turn = _turn(before.along, half) + _turn(half, after.along)
    if abs(turn) < _STRAIGHT:
        return None
    radius = (high - low) * step / abs(turn)
    if abs(turn) < _U_TURN:
        return [(_crossing(before, after), radius)]
    between = Line(middle, middle, samples[middle], half)
    return [(_crossing(*pair), 0.8 * radius) for pair in ((before, between), (between, after))]


def _turn(before: Float[np.ndarray, "2"], after: Float[np.ndarray, "2"]) -> float:
    """Returns the angle from one direction to another."""
    cross = before[0] * after[1] - before[1] * after[0]
    return float(np.arctan2(cross, before @ after))


def _crossing(one: Line, two: Line) -> Float[np.ndarray, "2"]:
    """Returns where two lines that are not parallel meet."""
    across = np.array([-two.along[1], two.along[0]])
    share = (two.point - one.point) @ across / (one.along @ across)
    return one.point + share * one.along
