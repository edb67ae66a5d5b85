"""Surfaces of revolution: profiles, their axis, and the sweep around it (NumPy only).

A *profile* is a curve in the half-plane (r, z) of a radius and a height along the axis. It runs so
that the body is on its left: counter-clockwise, or from the lowest point of the axis to the
highest. It may consist of several curves, and need not be smooth: each segment has normals of its
own at both ends. `sweep` turns what belongs to a profile, and its derivatives, into space;
`lathe` connects it.

Source: Pottmann and Randrup, Rotational and Helical Surface Approximation for Reverse Engineering
(1998), for the axis. The profile is ours.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.spatial import KDTree
from trimesh import Trimesh

from refref_jax.geometry.triangle_meshes import Mesh, diameter, slice_faces
from refref_jax.reconstruct.grids import import_skimage
from refref_jax.reconstruct.shapes import Cloud, Frame, check, frame_along, robust_weights

Curve = Float[np.ndarray, "points 2"]

# Rounds of robust weights, of the axis against the profile, and of the profile's corrections.
_AXIS_ROUNDS = 12
_CORRECTIONS = 3

# Rms distance of a fit that begins with the axis of inertia, as a share of that of the other one,
# below which it takes its place.
_BETTER = 0.99

# Cells of the section along the diameter, and slices through a cell.
_CELLS = 300
_SLICES = 3

# Empty cells around a section, and pieces of each cut through a face.
_MARGIN, _PIECES = 4, 4

# Points of a profile while it is fitted, as a share of the diameter.
_STEP = 1.0 / 600.0

# Standard deviation of the smoothing along the profile: multiple of the error of the mesh,
# between these shares of the diameter.
_SMOOTHING = 6.0
_LEAST_SMOOTHING, _MOST_SMOOTHING = 0.0035, 0.017

# Smoothing of the curvature that decides where a profile has points and knots, in its even steps.
_CURVATURE_STEPS = 4.0

# Points of the mesh further from the profile than this share of the diameter do not correct it.
_REACH = 0.05


class Axis(NamedTuple):
    """A line in space.

    Attributes:
      point: a point on it, world units.
      frame: columns are two directions across the axis, and the one along it; right-handed.
    """

    point: Float[np.ndarray, "3"]
    frame: Float[np.ndarray, "3 3"]


class Lathe(NamedTuple):
    """How the points of profiles, swept around the axis, make up a closed surface.

    Attributes:
      rows: rows of the swept points `[points azimuths]` that are vertices; a pole has one.
      faces: counter-clockwise seen from outside.
      normal_ids: row of the swept normals at each corner.
    """

    rows: Int[np.ndarray, " vertices"]
    faces: Int[np.ndarray, "faces 3"]
    normal_ids: Int[np.ndarray, "faces 3"]


def lathe(
    poles: Bool[np.ndarray, " points"],
    segments: Int[np.ndarray, "segments 2"],
    ends: Int[np.ndarray, "segments 2"],
    azimuths: int,
) -> Lathe:
    """Connects the swept points of profiles.

    Args:
      poles: points that lie on the axis.
      segments: the two points of each segment, in the direction of the profile.
      ends: numbers of the normals at the two ends of each segment. The ends that meet at a point
        have the same one where the surface is smooth, and different ones at a crease.
      azimuths: number of half-planes.
    """
    kept = ~poles[:, None] | (np.arange(azimuths) == 0)
    rows = np.flatnonzero(kept)
    numbers = (
        np.where(poles[:, None], 0, np.arange(azimuths)) + azimuths * np.arange(len(poles))[:, None]
    )
    numbers = np.searchsorted(rows, numbers)
    here, there = np.arange(azimuths), (np.arange(azimuths) + 1) % azimuths
    (first, second), (begin, end) = segments.T, azimuths * ends.T
    square = np.stack([numbers[first], numbers[second], numbers[first], numbers[second]])
    square = np.stack([square[0][:, here], square[2][:, there], square[3][:, there], square[1]])
    begin, end = begin[:, None], end[:, None]
    normal = np.stack([begin + here, begin + there, end + there, end + here])
    lower, upper = ~poles[first], ~poles[second]
    parts = [([0, 1, 2], lower), ([0, 2, 3], upper)]
    faces, ids = (
        np.concatenate(
            [np.moveaxis(of[corners][:, some], 0, -1).reshape(-1, 3) for corners, some in parts]
        )
        for of in (square, normal)
    )
    return Lathe(rows, faces, ids)


def sweep(
    values: Float[np.ndarray, "k 2"],
    slopes: Float[np.ndarray, "k 2 m"],
    frame: Frame,
    azimuths: int,
) -> tuple[Float[np.ndarray, "ka 3"], Float[np.ndarray, "ka 3 m"]]:
    """Turns points or directions of the half-plane around the axis; also their derivatives.

    Args:
      values: radius and height of each.
      slopes: derivatives by m unknowns.
      frame: directions across and along the axis, as columns.
      azimuths: number of half-planes.

    Returns:
      Values in space relative to the axis, `azimuths` for each of the k, and their derivatives.
    """
    angle = 2.0 * np.pi / azimuths * np.arange(azimuths)
    around = np.cos(angle)[:, None] * frame[:, 0] + np.sin(angle)[:, None] * frame[:, 1]
    along = frame[:, 2]
    swept = values[:, None, :1] * around + values[:, None, 1:] * along
    moved = slopes[:, None, None, 0] * around[:, :, None]
    moved += slopes[:, None, None, 1] * along[:, None]
    return swept.reshape(-1, 3), moved.reshape(len(swept) * azimuths, 3, -1)


def find_axis(cloud: Cloud) -> Axis:
    """Returns the line that most normals of a surface meet.

    The normal n at p meets the axis of direction a and moment b if `n . b + (p x n) . a = 0`. The
    sum of squares, with |a| = 1, is least for an eigenvector; weights are by area and robust. The
    direction points to the side of the largest coordinate. For a ball, every line through the
    centre is an axis.
    """
    middle = cloud.areas @ cloud.points
    size = np.sqrt(cloud.areas @ np.sum((cloud.points - middle) ** 2, axis=-1))
    points = (cloud.points - middle) / size
    rows = np.concatenate([np.cross(points, cloud.normals), cloud.normals], axis=-1)
    weights = cloud.areas
    for _ in range(_AXIS_ROUNDS):
        moments = (rows * weights[:, None]).T @ rows
        shift = -np.linalg.lstsq(moments[3:, 3:], moments[3:, :3], rcond=1e-9)[0]
        direction = np.linalg.eigh(moments[:3, :3] + moments[:3, 3:] @ shift)[1][:, 0]
        moment = shift @ direction
        error = rows @ np.concatenate([direction, moment])
        weights = cloud.areas * robust_weights(error)
    return _axis_along(middle + size * np.cross(direction, moment), direction)


def axis_of_inertia(mesh: Mesh) -> Axis:
    """Returns the principal axis of a body whose other two moments of inertia are most alike.

    That of a prism or star with at least three like sides is its axis, which the normals of its
    sides may miss. The direction points to the side of the largest coordinate.

    Raises:
      ReconstructionError: if the mesh is empty, flat, inside out or not finite.
    """
    check(mesh)
    middle, size = mesh.vertices.mean(axis=0), diameter(mesh.vertices)
    body = Trimesh((mesh.vertices - middle) / size, mesh.faces, process=False)
    moments, directions = np.linalg.eigh(body.moment_inertia)
    low, high = np.diff(moments)
    direction = directions[:, 0 if low > high else 2]
    return _axis_along(middle + size * body.center_mass, direction)


def _axis_along(point: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]) -> Axis:
    """Returns the axis through a point, which points to the side of its largest coordinate."""
    return Axis(point, frame_along(direction * np.sign(direction[np.argmax(np.abs(direction))])))


class Profile(NamedTuple):
    """The profile of a body, in even steps.

    Attributes:
      points: radius and height, world units; a closed curve does not repeat its first point.
      closed: whether the curve is closed; otherwise it begins and ends on the axis.
    """

    points: Float[np.ndarray, "points 2"]
    closed: bool

    @property
    def curve(self) -> Curve:
        """The points; a closed profile returns to its first."""
        return np.concatenate([self.points, self.points[:1]]) if self.closed else self.points


class Fit(NamedTuple):
    """A surface of revolution fitted to a mesh.

    Attributes:
      axis: its axis; heights of the profile are relative to its point.
      profile: its profile.
      rms: root mean square distance of the mesh from it, world units.
    """

    axis: Axis
    profile: Profile
    rms: float


def fit_axis_and_profile(mesh: Mesh, cloud: Cloud, size: float, *, rounds: int = 3) -> Fit | None:
    """Fits a surface of revolution: the axis and the profile in turn.

    A point of the half-plane is inside if more than half of its circle is inside the mesh. The
    contour is smoothed along its length over six times the error of the mesh, but at least 0.35 %
    and at most 1.7 % of the size, and then moved to the robust mean of the mesh over as much.
    Rounded rims of a smaller radius become as round as that.

    Args:
      mesh: closed mesh.
      cloud: samples of it.
      size: diameter of the mesh, world units.
      rounds: number of times that the axis is found; each but the first corrects it. The first one
        is the line that most normals meet, or the axis of inertia.

    Returns:
      The fit, however bad; `None` if no circle around the axis is mostly inside the mesh.

    Raises:
      ReconstructionError: if scikit-image is not installed.
    """
    starts = find_axis(cloud), axis_of_inertia(mesh)
    by_normals, by_inertia = (_fit_from(axis, mesh, cloud, size, rounds) for axis in starts)
    if by_normals is None or by_inertia is None:
        return by_normals or by_inertia
    return by_inertia if by_inertia.rms < _BETTER * by_normals.rms else by_normals


def _fit_from(axis: Axis, mesh: Mesh, cloud: Cloud, size: float, rounds: int) -> Fit | None:
    """Returns the fit that begins with an axis."""
    smoothing = _LEAST_SMOOTHING * size
    for last in range(rounds - 1, -1, -1):
        contour = outline(section(mesh, axis, size))
        if contour is None:
            return None
        profile = _smooth(contour, smoothing, size)
        for _ in range(_CORRECTIONS):
            matched = _match(profile, axis, cloud, size)
            profile = _corrected(profile, matched, smoothing, size)
        matched = _match(profile, axis, cloud, size)
        if last:
            axis = _corrected_axis(axis, matched, size)
            error = float(np.median(np.abs(matched.errors))) * 1.48
            least, most = _LEAST_SMOOTHING * size, _MOST_SMOOTHING * size
            smoothing = float(np.clip(_SMOOTHING * error, least, most))
    return Fit(axis, profile, float(np.sqrt(cloud.areas @ matched.distances**2)))


class Section(NamedTuple):
    """Which share of each circle around the axis is inside a mesh.

    Attributes:
      shares: shares at the centres of cells, by height and radius.
      bottom: height of the lower side of the first row.
      cell: side of a cell; the first column begins on the axis.
    """

    shares: Float[np.ndarray, "rows columns"]
    bottom: float
    cell: float


def section(mesh: Mesh, axis: Axis, size: float) -> Section:
    """Measures the share of each circle around an axis that is inside a closed mesh.

    A circle of radius r is inside as far as the contours of the mesh at its height, counted by the
    angle they turn around the axis, lie beyond r.

    Args:
      mesh: closed mesh.
      axis: axis of the circles.
      size: diameter of the mesh.
    """
    cell = size / _CELLS
    local = (mesh.vertices - axis.point) @ axis.frame
    bottom = float(local[:, 2].min()) - _MARGIN * cell
    rows = int((local[:, 2].max() - bottom) / cell) + _MARGIN
    columns = int(np.linalg.norm(local[:, :2], axis=-1).max() / cell) + _MARGIN
    start, end, level = slice_faces(local, mesh.faces, bottom, cell / _SLICES)
    row = level // _SLICES
    total = np.zeros(rows * (columns + 1))
    for piece in range(_PIECES):
        one, two = (start + (piece + i) / _PIECES * (end - start) for i in (0, 1))
        angle = np.arctan2(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0], np.sum(one * two, axis=1))
        radius = np.linalg.norm(0.5 * (one + two), axis=-1) / cell
        column = radius.astype(np.int64)
        at, share = row * (columns + 1) + column, radius - column
        turns = angle / (2.0 * np.pi * _SLICES)
        # A cell that a contour crosses counts as far as it reaches, all those before it fully.
        total += np.bincount(at + 1, turns * share, total.size)
        total += np.bincount(at, turns * (1.0 - share), total.size)
    shares = np.cumsum(total.reshape(rows, columns + 1)[:, ::-1], axis=1)[:, ::-1]
    return Section(shares[:, 1:], bottom, cell)


def outline(section: Section) -> Profile | None:
    """Returns the contour at one half that encloses the largest body, if there is one.

    Raises:
      ReconstructionError: if scikit-image is not installed.
    """
    measure = import_skimage()
    # The mirror image beyond the axis makes the filter blind to it.
    both = np.concatenate([section.shares[:, ::-1], section.shares], axis=1)
    shares = gaussian_filter(both, 1.0)[:, section.shares.shape[1] - 1 :]
    found = []
    for contour in measure.find_contours(shares, 0.5):
        curve = contour[:, ::-1] + [-0.5, 0.5]
        closed = bool(np.all(contour[0] == contour[-1]))
        if closed:
            curve = curve[:-1]
        else:
            inside = curve[curve[:, 0] > 0.0]
            ends = [[0.0, inside[0, 1]]], [[0.0, inside[-1, 1]]]
            curve = np.concatenate([ends[0], inside, ends[1]])
        found.append((_swept_volume(curve, closed), curve, closed))
    if not found:
        return None
    content, curve, closed = max(found, key=lambda item: abs(item[0]))
    curve = section.cell * curve + [0.0, section.bottom]
    return Profile(curve if content > 0.0 else curve[::-1], closed)


def _swept_volume(curve: Curve, closed: bool) -> float:
    """Returns the volume of the body of a profile over pi, negative if it runs backwards."""
    after = np.roll(curve, -1, axis=0) if closed else curve[1:]
    before = curve if closed else curve[:-1]
    (r, z), (s, t) = before.T, after.T
    return float(np.sum((r * r + r * s + s * s) * (t - z))) / 3.0


def _loop(points: Curve, closed: bool) -> Float[np.ndarray, "loop 2"]:
    """Returns a closed curve: an open profile continues with its mirror image."""
    return points if closed else np.concatenate([points, points[-2:0:-1] * [-1.0, 1.0]])


def lengths(points: Curve) -> Float[np.ndarray, " points"]:
    """Returns the lengths along a curve, which grow even where points coincide."""
    steps = np.linalg.norm(np.diff(points, axis=0, prepend=points[:1]), axis=-1)
    least = np.append(0.0, np.full(len(points) - 1, 1e-9 * steps.sum()))
    return np.cumsum(np.maximum(steps, least))


def even(points: Curve, count: int) -> Float[np.ndarray, "count 2"]:
    """Returns a curve in even steps."""
    length = lengths(points)
    ticks = np.linspace(0.0, length[-1], count)
    return np.stack([np.interp(ticks, length, points[:, i]) for i in (0, 1)], axis=-1)


def even_profile(profile: Profile, size: float) -> Profile:
    """Returns a profile in even steps, which depend on the diameter of the body."""
    points = profile.curve
    steps = max(int(lengths(points)[-1] / (_STEP * size)), 16)
    found = even(points, steps + 1)
    return Profile(found[:-1] if profile.closed else found, profile.closed)


def _smooth(profile: Profile, deviation: float, size: float) -> Profile:
    """Returns a profile smoothed along its length by a Gaussian; the poles stay on the axis."""
    steps = even_profile(profile, size)
    loop = _loop(steps.points, steps.closed)
    smooth = gaussian_filter1d(loop, deviation / (_STEP * size), axis=0, mode="wrap")
    points = smooth[: len(steps.points)]
    if not steps.closed:
        points[[0, -1], 0] = 0.0
    return Profile(points, steps.closed)


def turn_right(along: np.ndarray) -> np.ndarray:
    """Returns directions of the half-plane turned by a right angle, outwards from a profile."""
    return np.stack([along[:, 1], -along[:, 0]], axis=1)


def profile_normals(profile: Profile) -> Curve:
    """Returns the outward unit normals of a profile by central differences."""
    loop = _loop(profile.points, profile.closed)
    along = (np.roll(loop, -1, axis=0) - np.roll(loop, 1, axis=0))[: len(profile.points)]
    normals = turn_right(along)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-300)


class _Match(NamedTuple):
    """Points of a mesh and where they belong on a profile.

    Attributes:
      local: points in the frame of the axis.
      nearest: nearest point of the profile.
      normals: its normal in the frame of the axis, in the half-plane of the point.
      errors: distance from the profile along that normal, positive outside.
      weights: area times robust weight; zero where the normals disagree or the profile is far.
      distances: distance from the profile.
    """

    local: Float[np.ndarray, "points 3"]
    nearest: Int[np.ndarray, " points"]
    normals: Float[np.ndarray, "points 3"]
    errors: Float[np.ndarray, " points"]
    weights: Float[np.ndarray, " points"]
    distances: Float[np.ndarray, " points"]


def _match(profile: Profile, axis: Axis, cloud: Cloud, size: float) -> _Match:
    local, turned = (cloud.points - axis.point) @ axis.frame, cloud.normals @ axis.frame
    radius = np.linalg.norm(local[:, :2], axis=-1)
    outward = local[:, :2] / np.maximum(radius, 1e-300)[:, None]
    flat = np.stack([radius, local[:, 2]], axis=-1)
    distance, nearest = KDTree(profile.points).query(flat)
    normal = profile_normals(profile)[nearest]
    normals = np.concatenate([normal[:, :1] * outward, normal[:, 1:]], axis=-1)
    errors = np.sum((flat - profile.points[nearest]) * normal, axis=-1)
    near = (distance < _REACH * size) & (np.sum(turned * normals, axis=-1) > 0.3)
    weights = np.where(near, cloud.areas * robust_weights(errors), 0.0)
    return _Match(
        local, nearest, normals, errors, weights, np.where(near, np.abs(errors), distance)
    )


def _corrected(profile: Profile, match: _Match, deviation: float, size: float) -> Profile:
    """Returns a profile moved along its normals to the weighted mean of the mesh around."""
    count = len(profile.points)
    mode = "wrap" if profile.closed else "reflect"
    total, weight = (
        gaussian_filter1d(
            np.bincount(match.nearest, of, count), deviation / (_STEP * size), mode=mode
        )
        for of in (match.weights * match.errors, match.weights)
    )
    shift = total / (weight + 1e-6 * weight.mean() + 1e-300)
    points = profile.points + shift[:, None] * profile_normals(profile)
    if not profile.closed:
        points[[0, -1], 0] = 0.0
    return even_profile(Profile(points, profile.closed), size)


def _corrected_axis(axis: Axis, match: _Match, size: float) -> Axis:
    """Returns the axis after a robust linear fit of the errors.

    A turn w about the point of the axis and a shift t move a point p of normal n outwards by
    `w . (p x n) + t . n`. A small ridge keeps the tilt of a ball as it is.
    """
    turns = np.cross(match.local, match.normals)[:, :2] / size
    rows = np.concatenate([turns, match.normals[:, :2]], axis=-1)
    areas = match.weights / robust_weights(match.errors)
    step = np.zeros(4)
    for _ in range(_AXIS_ROUNDS):
        weights = areas * robust_weights(match.errors - rows @ step)
        moments = (rows * weights[:, None]).T @ rows
        moments += 1e-4 * np.trace(moments) * np.eye(4)
        step = np.linalg.lstsq(moments, rows.T @ (weights * match.errors), rcond=1e-12)[0]
    turn, shift = np.clip(step[:2] / size, -0.1, 0.1), step[2:]
    direction = axis.frame @ [turn[1], -turn[0], 1.0]
    return Axis(axis.point + axis.frame[:, :2] @ shift, frame_along(direction))


def profile_places(profile: Profile, count: int) -> tuple[Float[np.ndarray, " count"], float]:
    """Returns lengths along a profile, half of them even and half where it turns; its length."""
    length = lengths(profile.curve)
    normals = profile_normals(profile)
    if profile.closed:
        normals = np.concatenate([normals, normals[:1]])
    before, after = normals[:-1], normals[1:]
    angle = np.arctan2(
        before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], np.sum(before * after, axis=-1)
    )
    mode = "wrap" if profile.closed else "reflect"
    turn = np.abs(gaussian_filter1d(angle, _CURVATURE_STEPS, mode=mode))
    turn = gaussian_filter1d(turn, _CURVATURE_STEPS, mode=mode)
    share = np.diff(length) / length[-1] + turn / turn.sum()
    total = np.concatenate([[0.0], np.cumsum(share)])
    ticks = np.linspace(0.0, total[-1], count + profile.closed)
    at = np.interp(ticks, total, length)
    return at[:count], float(length[-1])
