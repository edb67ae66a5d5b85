"""How the outside of a vessel differs from a surface of revolution (NumPy only).

Many vessels are turned only in part: a foot with six sides, a spout in a lip, flutes in a wall. A
`Relief` stretches every horizontal section of space away from the axis, by a factor that depends on
height and azimuth. It applies to all surfaces of a vessel, so that their profiles stay the unknowns
of a fit, and walls keep their thickness.

What this cannot represent: sections that a ray from the axis leaves more than once, such as those
of handles; insides that are round where the outside is not, at the same height.

Source: ours.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter1d

from refref_jax.geometry.triangle_meshes import Mesh, diameter
from refref_jax.reconstruct.revolution import Axis, slice_faces

# Sections, azimuths, and the standard deviation of the smoothing along the axis, in sections.
_SECTIONS, _AZIMUTHS, _SMOOTHING = 120, 96, 1.0

# Standard deviation of the radii of a section that is noise of a mesh from masks, as a share of the
# diameter.
_NOISE = 0.001

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


class Relief:
    """A factor on distances from an axis, 1 + `factors`, as a function of height and azimuth.

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
        rows, columns = factors.shape
        self._high = low + step * (rows - 1)
        around = np.arange(-_REPEATED, columns + _REPEATED)
        self._spline = RectBivariateSpline(
            low + step * np.arange(rows),
            2.0 * np.pi / columns * around,
            factors[:, around % columns],
        )

    def stretch(self, points: Float[np.ndarray, "points 3"]) -> Stretched:
        """Stretches points in the frame of the axis, and returns the derivatives."""
        height, azimuth = self._place(points)
        factor = 1.0 + self._spline.ev(height, azimuth)
        by_height = self._spline.ev(height, azimuth, dx=1) * (height == points[:, 2])
        by_azimuth = self._spline.ev(height, azimuth, dy=1)
        flat = points * [1.0, 1.0, 0.0]
        square = np.maximum(np.sum(flat**2, axis=-1), 1e-300)
        around = np.stack([-points[:, 1], points[:, 0], np.zeros(len(points))], axis=-1)
        slope = (by_azimuth / square)[:, None] * around + by_height[:, None] * [0.0, 0.0, 1.0]
        jacobian = flat[:, :, None] * slope[:, None, :]
        jacobian += factor[:, None, None] * np.diag([1.0, 1.0, 0.0]) + np.diag([0.0, 0.0, 1.0])
        return Stretched(factor[:, None] * flat + points * [0.0, 0.0, 1.0], jacobian)

    def shrink(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Inverts `stretch`."""
        factor = 1.0 + self._spline.ev(*self._place(points))
        return points / np.stack([factor, factor, np.ones_like(factor)], axis=-1)

    def _place(self, points: Float[np.ndarray, "points 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Returns heights, within those of the relief, and azimuths."""
        height = np.clip(points[:, 2], self.low, self._high)
        return height, np.arctan2(points[:, 1], points[:, 0]) % (2.0 * np.pi)


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
    mean = radii.mean(axis=1, keepdims=True)
    # Along the normal: where a surface is nearly level, small errors move its radius by much.
    rise = np.gradient(mean[:, 0], step)[:, None]
    spread = radii.std(axis=1, keepdims=True) / np.hypot(1.0, rise)
    noise = _NOISE * diameter(mesh.vertices)
    kept = np.maximum(1.0 - (noise / np.maximum(spread, 1e-300)) ** 2, 0.0)
    factors = gaussian_filter1d(kept * (radii / mean - 1.0), _SMOOTHING, axis=0, mode="nearest")
    return Relief(low, step, factors) if factors.any() else None


def _outermost(
    mesh: Mesh, axis: Axis
) -> tuple[Float[np.ndarray, "heights azimuths"], float, float]:
    """Returns the outermost radii of sections, NaN where there are none; and their heights."""
    local = (mesh.vertices - axis.point) @ axis.frame
    low, high = local[:, 2].min(), local[:, 2].max()
    step = (high - low) / _SECTIONS
    start, end, row = slice_faces(local, mesh.faces, low, step)
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
