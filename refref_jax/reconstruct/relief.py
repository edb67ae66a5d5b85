"""How the outside of a vessel differs from a surface of revolution (NumPy only).

Many vessels are turned only in part: a foot with six sides, a spout in a lip, flutes in a wall. A
`Relief` stretches every horizontal section of space away from the axis, by a factor that depends on
height and azimuth. It applies to all surfaces of a vessel, so that their profiles stay the unknowns
of a fit, and walls keep their thickness. A relief is measured in a mesh (`measure_relief`), fitted
to the outlines of masks (`fitted_to_outlines`), and its offsets are unknowns of a fit to light.

What this cannot represent: sections that a ray from the axis leaves more than once, such as those
of handles; insides that are round where the outside is not, at the same height.

Source: ours.
"""

import copy
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import RectBivariateSpline
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import csr_array, diags_array, eye_array, kron, sparray

from refref_jax.geometry.triangle_meshes import Mesh, diameter, slice_faces
from refref_jax.reconstruct.gauss_newton import Rows
from refref_jax.reconstruct.revolution import Axis
from refref_jax.reconstruct.shapes import Posed

# Sections, azimuths, and the standard deviation of the smoothing along the axis, in sections.
_SECTIONS, _AZIMUTHS, _SMOOTHING = 120, 96, 1.0

# Slices through a section.
_SLICES = 3

# Standard deviation of the radii of a section that is noise of a mesh from masks, as a share of the
# diameter.
_NOISE = 0.001

KNOTS = (24, 32)
"""Numbers of heights and azimuths of the offsets that are fitted to light."""

LARGEST_STEP = 0.01
"""A sensible largest step of an offset of the factor."""

# Standard deviations of their prior: offsets, and their second differences along the axis and
# around it.
_OFFSET, _ALONG, _AROUND = 0.02, 0.003, 0.006

# Offsets of a fit to outlines: their number, and their standard deviation. Multiples of the scales
# in each round; scale of the changes of curvature around the axis, and of second differences along
# it; weight of both.
_FINE_KNOTS, _FINE_OFFSET = (60, 96), 0.02
_SCALES = (100.0, 30.0, 10.0, 10.0, 3.0, 3.0, 1.0, 1.0, 1.0)
_TURN, _RISE, _SHARE = 0.05, 0.0005, 0.25

# Azimuths that are repeated on both sides, so that a spline is periodic.
_REPEATED = 8


class Stretched(NamedTuple):
    """Points after they were stretched.

    Attributes:
      points: points in the frame of the axis, world units.
      jacobian: their derivatives by the points before.
    """

    points: Float[np.ndarray, "points 3"]
    jacobian: Float[np.ndarray, "points 3 3"]


Offsets = Float[np.ndarray, "heights azimuths"]


class _Hats(NamedTuple):
    """Values of the splines of the unknowns at points, and their derivatives.

    Attributes:
      columns: unknowns of the splines that are not zero.
      values: their values.
      by_height: their derivatives by height.
      by_azimuth: their derivatives by azimuth.
    """

    columns: Int[np.ndarray, "points 16"]
    values: Float[np.ndarray, "points 16"]
    by_height: Float[np.ndarray, "points 16"]
    by_azimuth: Float[np.ndarray, "points 16"]

    def sum(self, offsets: Offsets) -> tuple[np.ndarray, ...]:
        """Returns the offset of the factor at each point, and its derivatives."""
        at = offsets.ravel()[self.columns]
        return tuple(np.sum(each * at, axis=1) for each in self[1:])


class Relief:
    """A factor on distances from an axis, 1 + `factors`, as a function of height and azimuth.

    The unknowns of a fit are offsets of the factor, coefficients of a cubic B-spline of heights and
    azimuths.

    Attributes:
      low: height of the first row above the point of the axis, world units.
      step: distance between rows.
      factors: excess of the factor, by height and azimuth.
    """

    def __init__(
        self, low: float, step: float, factors: Float[np.ndarray, "heights azimuths"]
    ) -> None:
        """Takes the factors, at even heights and azimuths."""
        self.low, self.step, self.factors = low, step, factors
        self._offsets: Offsets | None = None
        rows, columns = factors.shape
        self._high = low + step * (rows - 1)
        around = np.arange(-_REPEATED, columns + _REPEATED)
        self._spline = RectBivariateSpline(
            low + step * np.arange(rows),
            2.0 * np.pi / columns * around,
            factors[:, around % columns],
        )

    def with_offsets(self, offsets: Offsets) -> "Relief":
        """Returns the relief with offsets of its factor."""
        found = copy.copy(self)
        found._offsets = offsets
        return found

    def stretch(self, points: Float[np.ndarray, "points 3"]) -> Stretched:
        """Stretches points in the frame of the axis, and returns the derivatives."""
        height, azimuth = self._place(points)
        factor = self._factor(points)
        by_height = self._spline.ev(height, azimuth, dx=1) * (height == points[:, 2])
        by_azimuth = self._spline.ev(height, azimuth, dy=1)
        if self._offsets is not None:
            _, more_by_height, more_by_azimuth = self._hats(points, self._offsets).sum(
                self._offsets
            )
            by_height, by_azimuth = by_height + more_by_height, by_azimuth + more_by_azimuth
        flat = points * [1.0, 1.0, 0.0]
        square = np.maximum(np.sum(flat**2, axis=-1), 1e-300)
        around = np.stack([-points[:, 1], points[:, 0], np.zeros(len(points))], axis=-1)
        slope = (by_azimuth / square)[:, None] * around + by_height[:, None] * [0.0, 0.0, 1.0]
        jacobian = flat[:, :, None] * slope[:, None, :]
        jacobian += factor[:, None, None] * np.diag([1.0, 1.0, 0.0]) + np.diag([0.0, 0.0, 1.0])
        return Stretched(factor[:, None] * flat + points * [0.0, 0.0, 1.0], jacobian)

    def shrink(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Inverts `stretch`."""
        factor = self._factor(points)
        return points / np.stack([factor, factor, np.ones_like(factor)], axis=-1)

    def at_knots(self, knots: tuple[int, int]) -> Offsets:
        """Returns the excess of the factor at the knots of offsets; of the ends beyond these."""
        heights, azimuths = knots
        pace = (self._high - self.low) / (heights - 3)
        height = np.clip(self.low + pace * (np.arange(heights) - 1.0), self.low, self._high)
        azimuth = 2.0 * np.pi / azimuths * (np.arange(azimuths) - 1.0) % (2.0 * np.pi)
        places = np.meshgrid(height, azimuth, indexing="ij")
        found: np.ndarray = self._spline.ev(*places)
        return found

    def raised(self, offsets: Offsets) -> "Relief":
        """Returns the relief with offsets of its factor."""
        rows, columns = self.factors.shape
        height, azimuth = np.meshgrid(
            self.low + self.step * np.arange(rows),
            2.0 * np.pi / columns * np.arange(columns),
            indexing="ij",
        )
        points = np.stack([np.cos(azimuth), np.sin(azimuth), height], axis=-1).reshape(-1, 3)
        more = self._hats(points, offsets).sum(offsets)[0].reshape(rows, columns)
        return Relief(self.low, self.step, self.factors + more)

    def slopes(
        self,
        points: Float[np.ndarray, "points 3"],
        normals: Float[np.ndarray, "normals 3"],
        at_normals: Int[np.ndarray, " normals"],
        offsets: Offsets,
    ) -> tuple[csr_array, csr_array]:
        """Returns the derivatives of stretched points and of their unit normals by offsets.

        Args:
          points: points before they are stretched, in the frame of the axis.
          normals: normals before the points are stretched, likewise.
          at_normals: point of each normal.
          offsets: offsets of the factor.
        """
        hats, flat = self._hats(points, offsets), points * [1.0, 1.0, 0.0]
        by_points = hats.values[:, None, :] * flat[:, :, None]
        inverse = np.linalg.inv(self.with_offsets(offsets).stretch(points).jacobian)[
            at_normals
        ].swapaxes(1, 2)
        turned = np.einsum("nij,nj->ni", inverse, normals)
        length = np.linalg.norm(turned, axis=-1)[:, None]
        unit, flat = turned / length, flat[at_normals]
        square = np.maximum(np.sum(flat**2, axis=-1), 1e-300)
        around = np.stack([-flat[:, 1], flat[:, 0], np.zeros(len(flat))], axis=-1) / square[:, None]
        inward = -np.sum(flat * turned, axis=-1)[:, None]

        def change(direction: np.ndarray) -> np.ndarray:
            moved = np.einsum("nij,nj->ni", inverse, direction) / length
            return moved - unit * np.sum(unit * moved, axis=-1)[:, None]

        by_value, by_azimuth = change(-turned * [1.0, 1.0, 0.0]), change(inward * around)
        by_height = change(inward * [0.0, 0.0, 1.0])
        at = _Hats(*(each[at_normals] for each in hats))
        by_normals = by_value[:, :, None] * at.values[:, None, :]
        by_normals += by_azimuth[:, :, None] * at.by_azimuth[:, None, :]
        by_normals += by_height[:, :, None] * at.by_height[:, None, :]
        return (
            _spread(by_points, hats.columns, offsets.size),
            _spread(by_normals, at.columns, offsets.size),
        )

    def _hats(self, points: Float[np.ndarray, "points 3"], offsets: Offsets) -> _Hats:
        """Returns the splines of offsets at points in the frame of the axis."""
        heights, azimuths = offsets.shape
        height, azimuth = self._place(points)
        pace, turn = (self._high - self.low) / (heights - 3), 2.0 * np.pi / azimuths
        row, along, rise = _cubic((height - self.low) / pace, heights - 4)
        column, around, swing = _cubic(azimuth / turn, azimuths - 1)
        rise = rise / pace * (height == points[:, 2])[:, None]
        number = np.arange(4)
        rows, columns = row[:, None] + number, (column[:, None] + number) % azimuths

        def both(one: np.ndarray, other: np.ndarray) -> np.ndarray:
            return (one[:, :, None] * other[:, None, :]).reshape(len(points), 16)

        at = (azimuths * rows[:, :, None] + columns[:, None, :]).reshape(len(points), 16)
        return _Hats(at, both(along, around), both(rise, around), both(along, swing / turn))

    def _factor(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
        """Returns the factor at points, with its offsets."""
        found: np.ndarray = 1.0 + self._spline.ev(*self._place(points))
        if self._offsets is None:
            return found
        more: np.ndarray = self._hats(points, self._offsets).sum(self._offsets)[0]
        return found + more

    def _place(self, points: Float[np.ndarray, "points 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Returns heights, within those of the relief, and azimuths."""
        height = np.clip(points[:, 2], self.low, self._high)
        return height, np.arctan2(points[:, 1], points[:, 0]) % (2.0 * np.pi)


def _spread(
    values: Float[np.ndarray, "n 3 16"], columns: Int[np.ndarray, "n 16"], count: int
) -> csr_array:
    """Returns derivatives by the unknowns as a sparse matrix, `[3 n, unknowns]`."""
    rows = np.arange(0, values.size + 1, 16)
    at = np.repeat(columns, 3, axis=0).ravel()
    return csr_array((values.ravel(), at, rows), shape=(3 * len(columns), count))


def _cubic(
    at: Float[np.ndarray, " n"], last: int
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 4"], Float[np.ndarray, "n 4"]]:
    """Returns the cell of each place, the four cubic B-splines that are there, and their slopes."""
    cell = np.clip(np.floor(at), 0, last).astype(np.int64)
    t = at - cell
    s = 1.0 - t
    values = [s**3, 3.0 * t**3 - 6.0 * t**2 + 4.0, 3.0 * s**3 - 6.0 * s**2 + 4.0, t**3]
    slopes = [-(s**2), 3.0 * t**2 - 4.0 * t, 4.0 * s - 3.0 * s**2, t**2]
    return cell, np.stack(values, axis=-1) / 6.0, np.stack(slopes, axis=-1) / 2.0


def precision() -> Float[np.ndarray, "unknowns unknowns"]:
    """Returns the precision matrix of the unknowns: small offsets, and smaller bends."""
    heights, azimuths = (np.eye(count) for count in KNOTS)
    along, around = np.diff(heights, 2, axis=0) / _ALONG, bends_around(KNOTS[1]) / _AROUND
    found: np.ndarray = np.kron(along.T @ along, azimuths) + np.kron(heights, around.T @ around)
    return found + np.eye(len(found)) / _OFFSET**2


def fitted_to_outlines(
    relief: Relief, pose: Callable[[Relief, Offsets], Posed], outlines: Callable[[Posed], Rows]
) -> Relief:
    """Fits a relief to outlines.

    Most sections that people make consist of straight lines and arcs. So the curvature around the
    axis changes at few places: its differences have a Cauchy distribution, whose scale becomes
    smaller in every round, and so do the second differences along the axis.

    Args:
      relief: relief to begin with.
      pose: function from a relief and offsets to the surface, whose last unknowns they are.
      outlines: equations of the outlines of a surface.
    """
    flat = Relief(relief.low, relief.step, np.zeros_like(relief.factors))
    start = offsets = relief.at_knots(_FINE_KNOTS)
    count = offsets.size
    for scale in _SCALES:
        rows = outlines(pose(flat, offsets))
        by = csr_array(rows.derivatives)[:, -count:]
        weighted = diags_array(rows.weights) @ by
        matrix = by.T @ weighted + eye_array(count) / _FINE_OFFSET**2
        gradient = weighted.T @ rows.errors + (offsets - start).ravel() / _FINE_OFFSET**2
        for values, slopes, width in _differences(1.0 + offsets):
            ratio = values / (scale * width)
            weights = _SHARE * 2.0 / (1.0 + ratio**2)
            slopes = slopes / (scale * width)
            matrix = matrix + slopes.T @ (diags_array(weights) @ slopes)
            gradient = gradient + slopes.T @ (weights * ratio)
        offsets = offsets - _solve_banded(matrix, gradient).reshape(offsets.shape)
    return flat.raised(offsets)


def _solve_banded(matrix: sparray, right: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Solves positive definite equations of unknowns that depend on those of a few rows near them.

    For 60 rows of 96 unknowns this takes a fifth of the time of a sparse factorisation.
    """
    entries = matrix.tocsr().tocoo()
    above = entries.col >= entries.row
    row, column, value = entries.row[above], entries.col[above], entries.data[above]
    width = int((column - row).max())
    band = np.zeros((width + 1, len(right)))
    band[width + row - column, column] = value
    found: np.ndarray = solveh_banded(band, right)
    return found


def _differences(factors: Offsets) -> list[tuple[np.ndarray, csr_array, float]]:
    """Returns changes of curvature around the axis, and second differences along it.

    Each comes with its derivatives by the factors, and its scale. With w = 1 / factor, w + w'' is 0
    along a straight line, and constant along a circle around the axis.
    """
    heights, azimuths = factors.shape
    turn, one = 2.0 * np.pi / azimuths, np.eye(azimuths)
    curvature = bends_around(azimuths) / turn**2 + one
    change = csr_array(np.roll(curvature, -1, axis=0) - curvature)
    around = kron(eye_array(heights), change).tocsr()
    inverse = 1.0 / factors.ravel()
    along = kron(csr_array(np.diff(np.eye(heights), 2, axis=0)), eye_array(azimuths)).tocsr()
    return [
        (around @ inverse, around @ diags_array(-(inverse**2)), _TURN),
        (along @ factors.ravel(), along, _RISE),
    ]


def bends_around(count: int) -> Float[np.ndarray, "n n"]:
    """Returns the second differences of periodic values, one in each row."""
    one = np.eye(count)
    return np.roll(one, 1, axis=0) - 2.0 * one + np.roll(one, -1, axis=0)


def measure_relief(mesh: Mesh, axis: Axis) -> Relief | None:
    """Measures how far the outermost radii of a mesh are from those of a body of revolution.

    Sections whose radii vary by no more than the noise of masks count as round.

    Args:
      mesh: closed mesh.
      axis: axis of the body of revolution.

    Returns:
      The relief; `None` if all sections are round.
    """
    radii, low, step = _outermost(mesh, axis)
    known = np.flatnonzero(np.all(np.isfinite(radii), axis=1))
    if not len(known):
        return None
    nearest = known[np.argmin(np.abs(np.arange(len(radii))[:, None] - known), axis=1)]
    radii = radii[nearest]
    middle = np.median(radii, axis=1, keepdims=True)
    # Along the normal: where a surface is nearly level, small errors move its radius by much.
    rise = np.gradient(middle[:, 0], step)[:, None]
    spread = radii.std(axis=1, keepdims=True) / np.hypot(1.0, rise)
    noise = _NOISE * diameter(mesh.vertices)
    kept = np.maximum(1.0 - (noise / np.maximum(spread, 1e-300)) ** 2, 0.0)
    factors = gaussian_filter1d(kept * (radii / middle - 1.0), _SMOOTHING, axis=0, mode="nearest")
    return Relief(low, step, factors) if factors.any() else None


def _outermost(
    mesh: Mesh, axis: Axis
) -> tuple[Float[np.ndarray, "heights azimuths"], float, float]:
    """Returns the outermost radii of sections, NaN where there are none; and their heights."""
    local = (mesh.vertices - axis.point) @ axis.frame
    low, high = local[:, 2].min(), local[:, 2].max()
    step = (high - low) / _SECTIONS
    start, end, level = slice_faces(local, mesh.faces, low, step / _SLICES)
    row = level // _SLICES
    first, count = _azimuths_between(start, end)
    piece = np.repeat(np.arange(len(row)), count)
    number = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count) + first[piece]
    angle = 2.0 * np.pi / _AZIMUTHS * number
    one, along = start[piece], (end - start)[piece]
    across = np.cos(angle) * along[:, 1] - np.sin(angle) * along[:, 0]
    radius = (one[:, 0] * along[:, 1] - one[:, 1] * along[:, 0]) / across
    found = np.full((_SECTIONS, _AZIMUTHS), -np.inf)
    inside = (row[piece] >= 0) & (row[piece] < _SECTIONS)
    np.maximum.at(found, (row[piece][inside], number[inside] % _AZIMUTHS), radius[inside])
    return np.where(np.isfinite(found), found, np.nan), float(low + 0.5 * step), float(step)


def _azimuths_between(
    start: Float[np.ndarray, "cuts 2"], end: Float[np.ndarray, "cuts 2"]
) -> tuple[Int[np.ndarray, " cuts"], Int[np.ndarray, " cuts"]]:
    """Returns the first azimuth that each cut meets on its way around the axis, and how many.

    Cuts end before an azimuth at their end, which the next one meets: those towards the axis meet
    none.
    """
    turn = np.arctan2(
        start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0], np.sum(start * end, axis=-1)
    )
    unit = _AZIMUTHS / (2.0 * np.pi)
    begin = unit * np.arctan2(start[:, 1], start[:, 0])
    first = np.ceil(begin).astype(np.int64)
    end_before = np.ceil(begin + unit * turn).astype(np.int64)
    return first, np.maximum(end_before - first, 0)
