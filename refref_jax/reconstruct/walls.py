"""Walls of vessels: profiles that move along their normals, and pieces of them (NumPy only).

A `Wall` is a profile from the lowest point of the axis to the highest (`revolution`), moved along
its normals at rest by a cubic spline of offsets. `curve` returns it at given offsets with exact
derivatives; `piece` samples part of it, between ends that may move too, as the wall below the level
of a liquid does. `inset` returns the wall inside another one, at a distance from it.

Source: ours.
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree

from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.revolution import (
    Curve,
    Profile,
    Section,
    even,
    lengths,
    outline,
    profile_normals,
    turn_right,
)
from refref_jax.reconstruct.turned import Outline, Point, Stretch, Turned

# Points of a profile while it is prepared, and cells along the diameter while it is inset.
_STEPS, _CELLS = 600, 300

# Empty cells around a section.
_MARGIN = 4

# Number of profiles whose depths are kept.
_KEPT = 8

# Smoothing of a profile that was inset, and of the turns that attract points, in steps.
_SMOOTHING, _TURNS = 3.0, 4.0

# Steepest slope of the bottom of a body, and share of its radius that a hollow takes.
_LEVEL_SLOPE, _HOLLOW = 0.35, 0.92

# Knots of a profile without ridges, their least height as a share of the diameter, and rounds.
_BASE_KNOTS, _RIDGE, _RIDGE_ROUNDS = 24, 0.0005, 12

# Least share of the normal along the axis where a wall has turned to the top of its object.
_FACING_UP = 0.6

# Circles of a horizontal surface, with its rim and its middle.
_RINGS = 4

# Length of the longest loop that is cut off, as a share of that of the profile.
_LONGEST_LOOP = 0.1

# Smallest slope of the height along a wall that still moves the point at a given height.
_FLAT = 0.1


class Moved(NamedTuple):
    """A wall at given offsets.

    Attributes:
      points: points of its spline.
      by_points: their derivatives by m unknowns.
    """

    points: Float[np.ndarray, "points 2"]
    by_points: Float[np.ndarray, "points 2 m"]


class Limits(NamedTuple):
    """How far the points of a wall may move along their normals, with derivatives.

    Attributes:
      inward: least offset, negative.
      outward: largest offset, positive.
      by_outward: derivatives of the largest offset by m unknowns.
      width: distance from the limits at which they begin to be felt.
    """

    inward: Float[np.ndarray, " points"]
    outward: Float[np.ndarray, " points"]
    by_outward: Float[np.ndarray, "points m"]
    width: Float[np.ndarray, " points"]


class Wall:
    """A profile that begins and ends on the axis, and moves along its normals.

    Attributes:
      at: lengths along the profile at rest of the points of its spline.
      length: length of the profile at rest.
      points: positions of these points at rest: radius and height.
      directions: outward unit normals at rest.
      knots: lengths along the profile at rest of the knots of the offsets.
      hats: offset of each point by that of each knot.
    """

    def __init__(self, profile: Profile, *, points: int = 160, knots: int = 36) -> None:
        """Takes a profile that is not closed, and the sizes of the splines."""
        dense = even(profile.points, _STEPS)
        length = lengths(dense)
        self.length = float(length[-1])
        self.at = places(dense, points)
        self.knots = places(dense, knots)
        self.points = np.stack(
            [
                CubicSpline(length, dense[:, 0], bc_type="natural")(self.at),
                CubicSpline(length, dense[:, 1], bc_type="clamped")(self.at),
            ],
            axis=-1,
        )
        self.points[[0, -1], 0] = 0.0
        one = np.eye(points)
        self._radii = CubicSpline(self.at, one, bc_type="natural")
        self._heights = CubicSpline(self.at, one, bc_type="clamped")
        self.hats = CubicSpline(self.knots, np.eye(knots), bc_type="clamped")(self.at)
        self.directions = self.normals(self.points)

    def normals(self, points: Curve) -> Curve:
        """Returns the outward unit normals of the spline through points."""
        along = np.stack(
            [self._radii(self.at, 1) @ points[:, 0], self._heights(self.at, 1) @ points[:, 1]], -1
        )
        return turn_right(along) / np.linalg.norm(along, axis=-1, keepdims=True)

    def curve(
        self,
        offsets: Float[np.ndarray, " knots"],
        by_offsets: Float[np.ndarray, "knots m"],
        limits: Limits | None = None,
    ) -> Moved:
        """Returns the wall at given offsets of the knots, outwards.

        Args:
          offsets: offsets, world units.
          by_offsets: their derivatives by the unknowns.
          limits: limits that the offsets fade into.
        """
        moves, slopes = self.hats @ offsets, self.hats @ by_offsets
        if limits is not None:
            moves, share = _below(moves, limits.outward, limits.width)
            slopes = share[:, None] * slopes + (1.0 - share)[:, None] * limits.by_outward
            moves, share = _below(-moves, -limits.inward, limits.width)
            moves, slopes = -moves, share[:, None] * slopes
        points = self.points + moves[:, None] * self.directions
        return Moved(points, self.directions[:, :, None] * slopes[:, None])

    def piece(
        self,
        moved: Moved,
        at: Float[np.ndarray, " k"],
        by_at: Float[np.ndarray, "k m"],
    ) -> Turned:
        """Returns points and normals of a wall at some lengths, which depend on the unknowns too.

        Args:
          moved: the wall.
          at: lengths along the wall at rest.
          by_at: their derivatives.
        """
        values, first, second = (self._sample(moved, at, order) for order in range(3))
        points, along, bend = values[0], first[0], second[0]
        by_points = values[1] + along[:, :, None] * by_at[:, None]
        by_along = first[1] + bend[:, :, None] * by_at[:, None]
        size = np.linalg.norm(along, axis=-1)[:, None]
        normals, turned = turn_right(along) / size, turn_right(by_along) / size[..., None]
        away = np.sum(normals[..., None] * turned, axis=1)[:, None]
        return Turned(points, by_points, normals, turned - normals[..., None] * away)

    def _sample(
        self, moved: Moved, at: Float[np.ndarray, " k"], order: int
    ) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k 2 m"]]:
        """Returns derivatives of some order along the wall, and theirs by the unknowns."""
        matrices = [spline(at, order) for spline in (self._radii, self._heights)]
        points = np.stack([m @ moved.points[:, i] for i, m in enumerate(matrices)], axis=-1)
        slopes = np.stack([m @ moved.by_points[:, i] for i, m in enumerate(matrices)], axis=1)
        return points, slopes

    def reach(
        self, moved: Moved, height: float, by_height: Float[np.ndarray, " m"]
    ) -> tuple[float, Float[np.ndarray, " m"]]:
        """Returns the length at which a wall, going up from its lowest point, passes a height.

        Args:
          moved: the wall.
          height: height, which is clipped to those that the wall reaches.
          by_height: derivatives of the height.

        Returns:
          The length along the wall at rest, and its derivatives.
        """
        ticks = np.linspace(0.0, self.length, 2 * _STEPS)
        heights = self._heights(ticks) @ moved.points[:, 1]
        lowest = int(np.argmin(heights))
        above = np.flatnonzero(heights[lowest:] > height)
        last = lowest + int(above[0]) if len(above) else len(ticks) - 1
        at = float(ticks[max(last, 1)])
        for _ in range(4):
            value, slope = (
                float((self._heights(np.array([at]), order) @ moved.points[:, 1])[0])
                for order in (0, 1)
            )
            step = (height - value) / max(slope, _FLAT)
            at = float(np.clip(at + step, 0.0, self.length))
        by_value = self._heights(np.array([at])) @ moved.by_points[:, 1]
        return at, (by_height - by_value[0]) / max(slope, _FLAT)


End = tuple[float | None, Float[np.ndarray, " m"]]
"""Length along a wall at rest and its derivatives; `None` is the whole length."""


def between(
    wall: Wall, moved: Moved, shares: Float[np.ndarray, " k"], begin: End, end: End
) -> Stretch:
    """Returns a stretch of a wall between two lengths.

    Args:
      wall: the wall.
      moved: the same at some offsets.
      shares: places of the points, from 0 to 1.
      begin: first length.
      end: last length.
    """
    first, last = (wall.length if each[0] is None else each[0] for each in (begin, end))
    at = first + shares * (last - first)
    by_at = begin[1] + shares[:, None] * (end[1] - begin[1])
    return Stretch(wall.piece(moved, at, by_at))


def shares(
    at: Float[np.ndarray, " n"], begin: float, end: float, count: int
) -> Float[np.ndarray, " count"]:
    """Returns points from 0 to 1, as dense as those of a wall between two lengths."""
    steps = np.arange(len(at))
    first, last = (float(np.interp(each, at, steps)) for each in (begin, end))
    found: np.ndarray = np.interp(np.linspace(first, last, count), steps, at)
    return (found - begin) / max(end - begin, 1e-12)


def without_loops(outline: Outline) -> Outline:
    """Returns a profile without the short loops in which it crosses itself.

    A wall folds into such loops where it moves along its normals by more than the radius of a bend.
    Their surfaces are inside out, and what remains has a crease there.
    """
    points, at, ends, begin = outline.turned.points, list[float](), [], 0
    loops = _find_loops(points)
    if not loops:
        return outline
    for first, last, share in loops:
        at += [*range(begin, first + 1), first + share]
        before, after = outline.ends[first, 0], outline.ends[last, 1]
        ends += [outline.ends[begin:first], np.array([[before, before], [after, after]])]
        begin = last + 1
    kept = np.array([*at, *range(begin, len(points))])
    row = np.minimum(kept.astype(int), len(points) - 2)

    def interpolated(values: np.ndarray) -> np.ndarray:
        share = (kept - row).reshape(-1, *(1,) * (values.ndim - 1))
        return values[row] + share * (values[row + 1] - values[row])

    moved = outline.turned._replace(
        points=interpolated(points), by_points=interpolated(outline.turned.by_points)
    )
    steps = np.arange(len(kept) - 1)
    segments = np.stack([steps, steps + 1], axis=-1)
    poles = interpolated(outline.poles.astype(float)) == 1.0
    return Outline(moved, poles, segments, np.concatenate([*ends, outline.ends[begin:]]))


def _find_loops(points: Curve) -> list[tuple[int, int, float]]:
    """Returns the segments that cross at each loop, and where on the first; no loop has another."""
    start, along = points[:-1], np.diff(points, axis=0)
    length = lengths(points)

    def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]

    away = start[None] - start[:, None]
    area = cross(along[:, None], along[None])
    area = np.where(area == 0.0, np.nan, area)
    shares = [cross(away, each) / area for each in (along[None], along[:, None])]
    meets = np.logical_and.reduce([(share > 0.0) & (share < 1.0) for share in shares])
    near = length[None, :-1] - length[1:, None] < _LONGEST_LOOP * length[-1]
    first, last = np.nonzero(np.triu(meets & near, 2))
    found: list[tuple[int, int, float]] = []
    for i in np.unique(first):
        if not found or i > found[-1][1]:
            j = int(last[first == i].max())
            found.append((int(i), j, float(shares[0][i, j])))
    return found


def disc(rim: Point, height: float, by_height: Float[np.ndarray, " m"]) -> Stretch:
    """Returns a horizontal surface that faces up, from the rim to the axis.

    Args:
      rim: point of the rim, and its derivatives.
      height: its height.
      by_height: derivatives of the height.
    """
    scale = np.linspace(1.0, 0.0, _RINGS)
    points = np.stack([scale * rim[0][0], np.full(_RINGS, height)], axis=-1)
    by_points = np.stack(
        [scale[:, None] * rim[1][0], np.broadcast_to(by_height, (_RINGS, len(by_height)))], axis=1
    )
    up = np.broadcast_to([0.0, 1.0], points.shape)
    return Stretch(Turned(points, by_points, up, np.zeros(by_points.shape)))


def bridge(before: Stretch, after: Stretch) -> Stretch:
    """Returns the straight stretch between two others, which continues the second one."""
    (point, by_point), (there, by_there) = before.last(), after.first()
    normal, by_normal = after.turned.normals[0], after.turned.by_normals[0]
    return Stretch(
        Turned(
            np.stack([point, there]),
            np.stack([by_point, by_there]),
            np.stack([normal, normal]),
            np.stack([by_normal, by_normal]),
        )
    )


def places(points: Curve, count: int) -> Float[np.ndarray, " count"]:
    """Returns lengths along a curve, half of them even and half where it turns."""
    length = lengths(points)
    along = np.diff(points, axis=0)
    angle = np.unwrap(np.arctan2(along[:, 1], along[:, 0]))
    turn = np.abs(gaussian_filter1d(np.diff(angle, prepend=angle[:1]), _TURNS, mode="nearest"))
    turn = gaussian_filter1d(turn, _TURNS, mode="nearest")
    share = np.diff(length) / length[-1] + turn / max(turn.sum(), 1e-12)
    total = np.concatenate([[0.0], np.cumsum(share)])
    return np.interp(np.linspace(0.0, total[-1], count), total, length)


def inset(
    profile: Profile, distance: float, size: float, *, base: float = 0.0, lid: float = 0.0
) -> Profile | None:
    """Returns the curve at a distance inside a profile that encloses the largest area.

    It is the contour of the distance from the profile, so it has no loops where the profile bends
    more sharply than the distance, or is narrow.

    Args:
      profile: profile that begins and ends on the axis.
      distance: distance, world units.
      size: diameter of the object.
      base: least height above the lower end on the axis, world units; 0 sets none.
      lid: least depth below the upper end; 0 sets none.

    Returns:
      The curve; `None` if nothing is further inside.

    Raises:
      ReconstructionError: if the profile is closed, or scikit-image is not installed.
    """
    if profile.closed:
        raise ReconstructionError("A ring has no inside that the axis meets. Pass a vessel.")
    depth, heights = _depths(profile.points.astype(np.float64).tobytes(), size)
    depth = depth - distance
    if base > 0.0:
        depth = np.minimum(depth, heights - profile.points[0, 1] - base)
    if lid > 0.0:
        depth = np.minimum(depth, profile.points[-1, 1] - lid - heights)
    cell = size / _CELLS
    shares = np.clip(0.5 + depth / (8.0 * cell), 0.0, 1.0)
    if shares.max() < 0.6:
        return None
    found = outline(Section(shares, heights[0, 0] - 0.5 * cell, cell))
    if found is None or found.closed:
        return None
    points = even(found.points, _STEPS)
    loop = np.concatenate([points, points[-2:0:-1] * [-1.0, 1.0]])
    points = gaussian_filter1d(loop, _SMOOTHING, axis=0, mode="wrap")[: len(points)]
    points[[0, -1], 0] = 0.0
    return Profile(points, closed=False)


@functools.lru_cache(maxsize=_KEPT)
def _depths(
    points: bytes, size: float
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "rows 1"]]:
    """Returns depths inside a profile at the centres of cells, and the height of each row.

    Many vessels with one outer wall share them: they are most of the work of `inset`.

    Args:
      points: points of the profile, as bytes.
      size: diameter of the object.
    """
    cell = size / _CELLS
    dense = even(np.frombuffer(points).reshape(-1, 2), 4 * _STEPS)
    bottom = float(dense[:, 1].min()) - _MARGIN * cell
    rows = int((dense[:, 1].max() - bottom) / cell) + 2 * _MARGIN
    columns = int(dense[:, 0].max() / cell) + 2 * _MARGIN
    row, column = np.mgrid[:rows, :columns]
    centres = np.stack([(column + 0.5) * cell, bottom + (row + 0.5) * cell], axis=-1)
    away, nearest = KDTree(dense).query(centres)
    normals = profile_normals(Profile(dense, closed=False))
    within = np.sum((centres - dense[nearest]) * normals[nearest], axis=-1) < 0.0
    return np.where(within, away, -away), centres[:, :1, 1].copy()


def with_open_top(profile: Profile, height: float) -> Profile:
    """Returns a profile whose rim continues straight up, as that of a vessel before it was cut off.

    Args:
      profile: profile that begins and ends on the axis.
      height: height of the added part, world units.
    """
    points = even(profile.points, _STEPS)
    normals = profile_normals(Profile(points, closed=False))
    last = int(np.flatnonzero(normals[:, 1] < _FACING_UP)[-1])
    rim, top = points[last, 0], points[:, 1].max() + height
    added = np.array([[rim, top], [0.0, top]])
    return Profile(np.concatenate([points[: last + 1], added]), closed=False)


def without_ridges(profile: Profile, size: float) -> Profile:
    """Returns a profile without narrow parts that stand out, such as rings and threads.

    It is a spline of few knots that gives little weight to points outside of it.

    Args:
      profile: profile that begins and ends on the axis.
      size: diameter of the object.
    """
    points = even(profile.points, _STEPS)
    normals = profile_normals(Profile(points, closed=False))
    length = lengths(points)
    at = np.linspace(0.0, length[-1], _BASE_KNOTS)
    one = np.eye(_BASE_KNOTS)
    radii = CubicSpline(at, one[:, 1:-1], bc_type="natural")(length)  # zero at both ends
    heights = CubicSpline(at, one, bc_type="clamped")(length)
    weights = np.ones(len(points))
    for _ in range(_RIDGE_ROUNDS):
        fitted = [
            matrix @ np.linalg.solve((matrix.T * weights) @ matrix, matrix.T @ (weights * values))
            for matrix, values in zip((radii, heights), points.T, strict=True)
        ]
        found = np.stack(fitted, axis=-1)
        above = np.sum((points - found) * normals, axis=-1) / (_RIDGE * size)
        weights = 1.0 / (1.0 + np.maximum(above, 0.0) ** 2)
    found[[0, -1], 0] = 0.0
    return Profile(found, closed=False)


def with_punt(profile: Profile, height: float) -> Profile:
    """Returns a profile with a hollow under its bottom, shaped like a dome.

    Masks do not show such a hollow: every line of sight into it also meets the rim around it.

    Args:
      profile: profile that begins and ends on the axis.
      height: height of the hollow on the axis, world units.
    """
    points = profile.points.copy()
    steep = np.diff(points[:, 1]) > _LEVEL_SLOPE * np.diff(points[:, 0])
    last = int(np.argmax(steep)) if steep.any() else len(points) - 1
    reach = _HOLLOW * points[last, 0]
    if reach <= 0.0:
        return profile
    share = np.minimum(points[: last + 1, 0] / reach, 1.0)
    points[: last + 1, 1] += height * (1.0 - share**2)
    return Profile(points, profile.closed)


def _below(
    values: Float[np.ndarray, " n"],
    limits: Float[np.ndarray, " n"],
    width: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Returns values that fade into limits, and their slopes; those by the limits are the rest."""
    away = (limits - values) / width
    return limits - width * np.logaddexp(0.0, away), 0.5 * (1.0 + np.tanh(0.5 * away))
