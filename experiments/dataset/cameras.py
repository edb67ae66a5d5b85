"""Camera poses of the data set (NumPy only).

A pose is a 4x4 camera-to-world matrix with OpenGL's axes: x right, y up, looking along -z. All
cameras look at the origin from a sphere of radius 4, with z up. Azimuth is counted from +x towards
+y, elevation from the horizon upwards.
"""

import math
from typing import get_args

import numpy as np
from jaxtyping import Float

from experiments.dataset.seeds import seed_of
from refref_jax.choices import Split

SPLITS: tuple[Split, ...] = get_args(Split)

ANGLE_X = 1.1656107902526855
"""Horizontal field of view of all cameras, radians: `camera_angle_x`."""

CAMERA_RADIUS = 4.0
"""Distance of all cameras from the origin, world units."""

_TURNS = 3  # of the helix
_LOWEST, _HIGHEST = -10.0, 65.0  # degrees


def split_poses(scene: str, split: Split, count: int) -> Float[np.ndarray, "count 4 4"]:
    """Returns the poses of a split with the published data set's distribution.

    Training and validation poses are random, each split with its own seed from the names of scene
    and split (`seeds.seed_of`); test poses lie on the helix, the same for all scenes.

    Raises:
      ValueError: if the split does not exist, or the count is not positive.
    """
    if split not in SPLITS:
        raise ValueError(f"There is no split {split!r}. Choose from {', '.join(SPLITS)}.")
    if split == "test":
        return helix_poses(count)
    return random_poses(count, seed=seed_of(scene, split))


def random_poses(count: int, *, seed: int) -> Float[np.ndarray, "count 4 4"]:
    """Returns poses uniform on the sphere; smaller counts give prefixes of larger ones.

    Raises:
      ValueError: if the count is not positive.
    """
    _require_positive(count)
    height, turn = np.random.default_rng(seed).random((count, 2)).T
    # Equal heights bound equal areas of a sphere (Archimedes).
    return look_at_origin(2.0 * math.pi * turn, np.arcsin(2.0 * height - 1.0))


def helix_poses(count: int) -> Float[np.ndarray, "count 4 4"]:
    """Returns poses on a helix: -10 to 65 degrees high, three turns from +x, both ends included.

    Raises:
      ValueError: if the count is not positive.
    """
    _require_positive(count)
    share = np.linspace(0.0, 1.0, count)
    elevation = _LOWEST + (_HIGHEST - _LOWEST) * share
    return look_at_origin(2.0 * math.pi * _TURNS * share, np.radians(elevation))


def look_at_origin(
    azimuth: Float[np.ndarray, " count"], elevation: Float[np.ndarray, " count"]
) -> Float[np.ndarray, "count 4 4"]:
    """Returns poses on the sphere that look at the origin, z up.

    Args:
      azimuth: azimuths in radians; at a pole they alone decide the right axis.
      elevation: elevations in radians.
    """
    cos_a, sin_a, zero = np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)
    cos_e, sin_e = np.cos(elevation), np.sin(elevation)
    right = np.stack([-sin_a, cos_a, zero], -1)
    up = np.stack([-sin_e * cos_a, -sin_e * sin_a, cos_e], -1)
    backward = np.stack([cos_e * cos_a, cos_e * sin_a, sin_e], -1)
    poses = np.tile(np.eye(4), (azimuth.size, 1, 1))
    poses[:, :3] = np.stack([right, up, backward, CAMERA_RADIUS * backward], -1)
    return poses


def _require_positive(count: int) -> None:
    if count < 1:
        raise ValueError(f"{count} poses were requested. Request one or more.")
