"""Fits turned bodies of straight pieces to noisy meshes (NumPy only).

`straight_pieces` divides the smooth profile of a surface of revolution into straight lines and arcs
of circles at the least cost, by dynamic programming over all divisions. `find_corners` extends the
lines until they meet. Least squares then find axis, corners and fillets, and corners that the mesh
does not need go.

Sources: Bellman, On the Approximation of Curves by Line Segments Using Dynamic Programming (1961),
for the search; Kåsa, A Circle Fitting Procedure and Its Error Analysis (1976), for the arcs. Their
combination is ours.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial import KDTree

from refref_jax.geometry.triangle_meshes import Mesh, diameter
from refref_jax.reconstruct.revolution import (
    Axis,
    Curve,
    Fit,
    Profile,
    even,
    fit_axis_and_profile,
)
from refref_jax.reconstruct.shapes import (
    FURTHEST,
    Cloud,
    Unknowns,
    cloud_of,
    frame_along,
    rms,
    tilt,
)
from refref_jax.reconstruct.turned import StraightTurned, rounded

# Samples of a curve.
_CURVE_SAMPLES = 400

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

# Steps of each straight piece and of each arc where a profile is compared with a mesh.
_FINE = 96, 24

# Most corners of a profile.
_MOST_CORNERS = 12

# Deviation of a profile from an ideal one: share of the error of the mesh, and the least, as a
# share of the diameter.
_DEVIATION, _LEAST_DEVIATION = 0.4, 4e-4

# A body is accepted if its error is at most this multiple of that of the smooth profile, or this
# share of the diameter more, and if this share of its profile is straight.
_WORSE, _MORE = 1.2, 3e-4
_STRAIGHT_SHARE = 0.5

# Weight of the first guess against the mesh, its smallest fillet as a share of the diameter, and
# most evaluations.
_RIDGE = 1e-3
_FIRST_FILLET = 0.01
_EVALUATIONS = 25

# Samples of a mesh, at most.
_MESH_SAMPLES = 20_000

# A corner that turns by less (radians) may go. A piece between two turns to the same side, of less
# than this in all, becomes one fillet if it is shorter than the first of two shares of the
# diameter; or than the second, and the error grows by less than this multiple, or this share.
_NO_TURN, _ONE_TURN = 0.15, 2.2
_BEVEL, _SHORT = 0.035, 0.1
_TIMES, _PLUS = 1.02, 5e-5


def fit_turned(
    mesh: Mesh, *, furthest: float = FURTHEST, smooth: Fit | None = None
) -> StraightTurned | None:
    """Fits a turned body of straight pieces: corners of a smooth profile, then least squares.

    The corners are those of `segments.find_corners`. Axis, corners and fillets then have the least
    robust squared distances from the mesh.

    Args:
      mesh: closed mesh, in one piece.
      furthest: largest rms distance of the mesh from the body, as a share of its diameter.
      smooth: result of `revolution.fit_axis_and_profile`, if it is known.

    Returns:
      The body, or `None` if the mesh is further from it, or clearly further than from the smooth
      profile, or if less than half of the profile is straight or it has more than 12 corners.

    Raises:
      ReconstructionError: if the mesh is empty, flat, inside out or not finite, or
        scikit-image is not installed.
    """
    cloud, size = cloud_of(mesh), diameter(mesh.vertices)
    smooth = fit_axis_and_profile(mesh, cloud, size) if smooth is None else smooth
    if smooth is None or smooth.rms > furthest * size:
        return None
    cloud = _some_of(cloud)
    deviation = max(_DEVIATION * smooth.rms, _LEAST_DEVIATION * size)
    corners = find_corners(smooth.profile, deviation, size)
    if corners is None or len(corners.fillets) > _MOST_CORNERS:
        return None
    fillets = np.maximum(corners.fillets, _FIRST_FILLET * size)
    shape = StraightTurned(smooth.axis, corners.points, fillets, size, closed=smooth.profile.closed)
    while bevels := [one for length, one in _simpler(shape, size) if length < _BEVEL * size]:
        shape = bevels[0]
    allowed = min(furthest * size, max(_WORSE * smooth.rms, smooth.rms + _MORE * size))
    shape, error = _adjusted(shape, cloud, size)
    if error <= allowed:
        shape, error = _simplified(shape, error, cloud, size)
    near = error <= allowed and shape.straight_share(shape.start()) >= _STRAIGHT_SHARE
    return shape if near else None


def _some_of(cloud: Cloud) -> Cloud:
    """Returns at most 20,000 of the samples."""
    chosen = np.random.default_rng(0).permutation(len(cloud.points))[:_MESH_SAMPLES]
    areas = cloud.areas[chosen]
    return Cloud(cloud.points[chosen], cloud.normals[chosen], areas / areas.sum())


def _simplified(
    shape: StraightTurned, error: float, cloud: Cloud, size: float
) -> tuple[StraightTurned, float]:
    """Returns the body after corners that the mesh does not need are gone; its error."""
    simpler = _simpler(shape, size)
    while simpler:
        other, others = _adjusted(simpler.pop(0)[1], cloud, size)
        if others < max(_TIMES * error, error + _PLUS * size):
            shape, error, simpler = other, others, _simpler(other, size)
    return shape, error


def _simpler(shape: StraightTurned, size: float) -> list[tuple[float, StraightTurned]]:
    """Returns bodies without one of the corners that hardly turn, or without one short piece.

    A short piece between turns to one side becomes a fillet of the pieces around it. The length of
    the piece (0 for a corner that hardly turns) comes before each body; they are sorted by it.
    """
    corners, fillets = shape.corners(shape.start()), shape.fillets(shape.start())
    turns = rounded(corners, fillets, shape.closed).turns
    if shape.closed:
        turns, first = np.roll(turns, 1), 0
    else:
        turns, fillets, first = (
            np.concatenate([[0.0], turns, [0.0]]),
            np.concatenate([[0.0], fillets, [0.0]]),
            1,
        )
    count, found = len(corners), []
    for corner in range(first, count - first):
        after = (corner + 1) % count
        kept = np.arange(count) != after
        if abs(turns[corner]) < _NO_TURN:
            kept = np.arange(count) != corner
            found.append((0.0, corners[kept], fillets[kept]))
            continue
        if after < first or after >= count - first or turns[corner] * turns[after] <= 0.0:
            continue
        length = float(np.linalg.norm(corners[after] - corners[corner]))
        if length < _SHORT * size and abs(turns[corner] + turns[after]) < _ONE_TURN:
            moved, wider = corners.copy(), fillets.copy()
            moved[corner], wider[corner] = _one_corner(corners[(corner + np.arange(-1, 3)) % count])
            found.append((length, moved[kept], wider[kept]))
    return [
        (
            length,
            StraightTurned(shape.axis, c, f[first : len(f) - first], size, closed=shape.closed),
        )
        for length, c, f in sorted(found, key=lambda each: each[0])
        if len(c) > 2
    ]


def _one_corner(ends: Float[np.ndarray, "4 2"]) -> tuple[Float[np.ndarray, "2"], float]:
    """Returns where the first and the last of three pieces meet, and the fillet of the middle."""
    before, step, after = np.diff(ends, axis=0)
    cross = before[0] * after[1] - before[1] * after[0]
    met = ends[1] + before * (step[0] * after[1] - step[1] * after[0]) / cross
    turn = np.arctan2(abs(cross), before @ after)
    length = np.linalg.norm(ends[1:3] - met, axis=-1).mean()
    return met, float(length / np.tan(0.5 * turn))


def _adjusted(shape: StraightTurned, cloud: Cloud, size: float) -> tuple[StraightTurned, float]:
    """Returns the body after least squares of distances, and its rms distance from the samples."""
    local = (cloud.points - shape.axis.point) @ shape.axis.frame
    root, first = np.sqrt(cloud.areas), shape.start()
    units = np.repeat([1.0, size], [2, len(first) - 2])

    def errors(x: Unknowns) -> Float[np.ndarray, " equations"]:
        apart = _distances(shape, first + units * x, local)[0] / size
        return np.concatenate([root * apart, _RIDGE * x])

    def slopes(x: Unknowns) -> Float[np.ndarray, "equations n"]:
        by = _distances(shape, first + units * x, local)[1] * units / size
        return np.concatenate([root[:, None] * by, _RIDGE * np.eye(len(x))])

    nothing = np.zeros(len(first))
    scale = 1.5 * float(np.median(np.abs(errors(nothing)[: len(root)])))
    found = least_squares(
        errors,
        nothing,
        slopes,
        loss="soft_l1",
        f_scale=max(scale, 1e-9),
        max_nfev=_EVALUATIONS,
    ).x
    x = first + units * found
    axis = Axis(
        shape.axis.point + shape.axis.frame[:, :2] @ x[2:4],
        frame_along(shape.axis.frame @ tilt(x[:2])[0][:, 2]),
    )
    better = StraightTurned(axis, shape.corners(x), shape.fillets(x), size, closed=shape.closed)
    return better, rms(_distances(shape, x, local)[0], cloud.areas)


def _distances(
    shape: StraightTurned, unknowns: Unknowns, local: Float[np.ndarray, "points 3"]
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points n"]]:
    """Returns distances of points from the body, positive outside, and their derivatives.

    A distance is along the normal of the nearest of many points of the profile, so it does not
    change if that point moves along the profile.
    """
    turned = shape.profile(unknowns, *_FINE)
    rotation, *slopes = tilt(unknowns[:2])
    away = local - [*unknowns[2:4], 0.0]
    points = away @ rotation
    radius = np.maximum(np.linalg.norm(points[:, :2], axis=-1), 1e-300)
    flat = np.stack([radius, points[:, 2]], axis=-1)
    nearest = KDTree(turned.points).query(flat)[1]
    normals = turned.normals[nearest]
    around = points[:, :2] / radius[:, None]
    outward = np.concatenate([normals[:, :1] * around, normals[:, 1:]], axis=-1)
    by_tilt = [np.sum(outward * (away @ slope), axis=-1) for slope in slopes]
    by_shift = -(outward @ rotation.T)[:, :2]
    moved = np.sum(turned.normals[..., None] * turned.by_points, axis=1)[nearest]
    apart = np.sum((flat - turned.points[nearest]) * normals, axis=-1)
    return apart, np.concatenate([np.stack(by_tilt, axis=-1), by_shift, -moved], axis=-1)


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
    return even(profile.curve, _CURVE_SAMPLES + 1)


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
      points: points where its straight pieces meet; an open profile begins and ends on the axis.
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
