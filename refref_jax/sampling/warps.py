"""Maps distance along a path to the unit interval in which samplers work, and back.

Letters: `t` is distance in world units, `s` the normalised coordinate in `[0, 1]`. Equal steps in
`s` are short near the camera and grow with distance, so that one interval covers near and far.

Source: Barron et al., Zip-NeRF (2023), section 4: the power transformation with
`lambda = -1.5`, applied to twice the distance.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

_LAMBDA = -1.5


class DistanceWarp(NamedTuple):
    """The sampled interval of distances, and its length scale.

    Attributes:
      near: distance at `s = 0`, world units, at least 0.
      far: distance at `s = 1`, world units, > `near`; may differ between paths.
      unit: size of the scene, world units; steps start to grow at about this distance.
    """

    near: float
    far: float | Float[Array, ""]
    unit: float


def to_distance(warp: DistanceWarp, s: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Maps `s` in `[0, 1]` to a distance in `[near, far]`, increasing up to rounding error.

    The transformed distance is interpolated from both ends, so that `s = 1` gives `far` up to
    rounding error, although the transform is flat there.
    """
    start, end = _ladder(warp, warp.near), _ladder(warp, warp.far)
    power = (1.0 - s) * start + s * end
    return _scale(warp) * (power ** (1.0 / _LAMBDA) - 1.0)


def to_unit(warp: DistanceWarp, t: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Maps a distance in `[near, far]` to `s` in `[0, 1]`; the inverse of `to_distance`."""
    start, end = _ladder(warp, warp.near), _ladder(warp, warp.far)
    return jnp.clip((start - _ladder(warp, t)) / (start - end), 0.0, 1.0)


def _scale(warp: DistanceWarp) -> float:
    """Returns the length unit of the power transformation: `|lambda - 1| / 2` times `unit`."""
    return abs(_LAMBDA - 1.0) / 2.0 * warp.unit


def _ladder(
    warp: DistanceWarp, t: float | Float[Array, "*shape"]
) -> float | Float[Array, "*shape"]:
    return (1.0 + t / _scale(warp)) ** _LAMBDA
