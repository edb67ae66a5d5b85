"""Between distance along a path and the unit interval that a sampler works on.

Letters: `t` is distance in world units, `s` the normalised coordinate in `[0, 1]`. Equal steps
in `s` are fine near the camera and grow with distance, so that one interval can hold both.

Source: Barron et al., Zip-NeRF (2023), section 4: the power transformation with
`lambda = -1.5`, applied to twice the distance.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

_LAMBDA = -1.5


class DistanceWarp(NamedTuple):
    """The interval of distances that is sampled, and the length that sets its scale.

    Attributes:
      near: distance at `s = 0`, world units, at least 0.
      far: distance at `s = 1`, world units, > near; may differ from path to path.
      unit: the scene's size, world units; steps start to grow at about this distance.
    """

    near: float
    far: float | Float[Array, ""]
    unit: float


def to_distance(warp: DistanceWarp, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Maps `s` in `[0, 1]` to a distance in `[near, far]`, increasing but for rounding error.

    The transformed distance is interpolated from both of its ends, so that `s = 1` gives `far`
    to rounding error although the transform flattens out there.
    """
    start, end = _ladder(warp, warp.near), _ladder(warp, warp.far)
    power = (1.0 - s) * start + s * end
    return _scale(warp) * (power ** (1.0 / _LAMBDA) - 1.0)


def to_unit(warp: DistanceWarp, t: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Maps a distance in `[near, far]` to `s` in `[0, 1]`; the inverse of `to_distance`."""
    start, end = _ladder(warp, warp.near), _ladder(warp, warp.far)
    return jnp.clip((start - _ladder(warp, t)) / (start - end), 0.0, 1.0)


def _scale(warp: DistanceWarp) -> float:
    """Returns the distance that the power transformation measures in: `|lambda - 1| / 2` units."""
    return abs(_LAMBDA - 1.0) / 2.0 * warp.unit


def _ladder(
    warp: DistanceWarp, t: float | Float[Array, "*shape"]
) -> float | Float[Array, "*shape"]:
    return (1.0 + t / _scale(warp)) ** _LAMBDA
