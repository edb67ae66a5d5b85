"""Multisamples of a pixel's cone around the bent centre line of a light path.

An interval of a path is a conical frustum, represented by a few multisamples, each an isotropic
Gaussian, so that a field can blur detail that is finer than the pixel's footprint. The centre line
follows the bends. The width of the cone grows with arc length, as along a straight ray, or is that
of the ray differentials, if they are carried (`optics.ray_differentials`).

Source: Barron et al., Zip-NeRF (2023), section 2; paper (arXiv 2505.05848), supplement, for the
bent centre line.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.sampling.polylines import Polyline, point_at

# Angles of Zip-NeRF's hexagon: two triangles of points, the second rotated by half a turn.
_HEXAGON = tuple(math.pi * turn for turn in (0.0, 2.0 / 3.0, 4.0 / 3.0, 1.0, 5.0 / 3.0, 1.0 / 3.0))

# Offsets of the six points along the ray, for the formula in `_hexagon_distances`.
_HEXAGON_STEPS = tuple(3.0 / math.sqrt(7.0) * (2.0 * j / 5.0 - 1.0) for j in range(6))

# Standard deviation of a multisample in units of its distance from the centre line.
_HEXAGON_SCALE = 0.5


class Gaussians(NamedTuple):
    """Isotropic Gaussians, the multisamples of one interval of a path.

    Attributes:
      positions: means.
      scales: standard deviations.
    """

    positions: Float[Array, "samples 3"]
    scales: Float[Array, " samples"]


def multisamples(
    line: Polyline,
    start: Float[Array, ""],
    end: Float[Array, ""],
    rotation: Float[Array, ""],
    *,
    count: int,
) -> Gaussians:
    """Samples the frustum of one interval.

    Six multisamples match the mean of the frustum and its covariance across the ray; a single one
    lies on the centre line and has this covariance. A multisample belongs to the segment at its own
    coordinate, even if the interval straddles an interface.

    Args:
      line: the path.
      start: coordinate of the interval's start.
      end: coordinate of the interval's end, at least `start`.
      rotation: rotation of the pattern about the centre line, radians.
      count: number of multisamples, 1 or 6.

    Raises:
      ValueError: if `count` is neither 1 nor 6.
    """
    if count == 1:
        t = _frustum_mean(start, end)
        point = point_at(line, t)
        return Gaussians(point.position[None], (0.5 * _mean_radius(point.footprint))[None])
    if count != len(_HEXAGON):
        raise ValueError(
            f"count is {count}, but cone patterns have 1 or 6 points. Use 1 (centre line) or 6 "
            "(Zip-NeRF's hexagon)."
        )
    angles = jnp.asarray(_HEXAGON, start.dtype) + rotation

    def one_sample(t: Float[Array, ""], angle: Float[Array, ""]) -> Gaussians:
        point = point_at(line, t)
        right, up = point.footprint / math.sqrt(2.0)
        offset = jnp.cos(angle) * right + jnp.sin(angle) * up
        scale = _HEXAGON_SCALE / math.sqrt(2.0) * _mean_radius(point.footprint)
        return Gaussians(point.position + offset, scale)

    return jax.vmap(one_sample)(_hexagon_distances(start, end), angles)


def _mean_radius(footprint: Float[Array, "2 3"]) -> Float[Array, ""]:
    """Returns the radius of a disc with the mean second moment of an ellipse."""
    return numerics.length(footprint.reshape(6)) / math.sqrt(2.0)


def _frustum_mean(start: Float[Array, ""], end: Float[Array, ""]) -> Float[Array, ""]:
    """Returns the mean distance of a conical frustum (mip-NeRF, Eq 7), without overflow."""
    mean, ratio = _middle_and_ratio(start, end)
    return mean * (1.0 + 2.0 * ratio**2 / (3.0 + ratio**2))


def _hexagon_distances(start: Float[Array, ""], end: Float[Array, ""]) -> Float[Array, "6"]:
    """Returns the distances of the six points, which match the frustum's moments (Eq 3)."""
    mean, ratio = _middle_and_ratio(start, end)
    spread = jnp.sqrt((ratio**2 - 1.0) ** 2 + 4.0)
    steps = jnp.asarray(_HEXAGON_STEPS, start.dtype)
    shift = (1.0 + ratio) ** 2 + 2.0 + steps * spread
    return start + mean * ratio * shift / (ratio**2 + 3.0)


def _middle_and_ratio(
    start: Float[Array, ""], end: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns the middle of an interval, and the ratio of half-width to middle, 0 at the apex."""
    mean = 0.5 * (start + end)
    return mean, numerics.safe_divide(0.5 * (end - start), mean)
