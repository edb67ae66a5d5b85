"""Moves and scales the world that cameras stand in (NumPy only)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from refref_jax.data.errors import SceneError

USUAL_DISTANCE = 4.0
"""Distance of the data set's cameras from the origin, world units, for captures without a scale."""

# Axes are taken for parallel if the meeting point moves more than this per unit of their shift.
_WORST_CONDITION = 1e4


class Placement(NamedTuple):
    """A change of the world frame: `x -> scale (x - centre)`.

    Attributes:
      centre: what becomes the origin, in the units of before.
      scale: units of after per unit of before.
    """

    centre: Float[np.ndarray, "3"]
    scale: float


def place(
    poses: Float[np.ndarray, "cameras 3 4"], placement: Placement
) -> Float[np.ndarray, "cameras 3 4"]:
    """Returns camera-to-world matrices in the changed frame; rotations stay as they are."""
    positions = placement.scale * (poses[..., 3] - placement.centre)
    return np.concatenate([poses[..., :3], positions[..., None]], axis=-1)


def undo_motion(
    poses: Float[np.ndarray, "cameras 3 4"], motion: Float[np.ndarray, "3 4"], scale: float
) -> Float[np.ndarray, "cameras 3 4"]:
    """Returns poses as they were before `p -> scale motion(p)`.

    Args:
      poses: camera to world.
      motion: rotation and translation, that were applied first.
      scale: of positions, that was applied then.
    """
    back = motion[:, :3].T
    positions = (poses[..., 3] / scale - motion[:, 3]) @ back.T
    return np.concatenate([back @ poses[..., :3], positions[..., None]], axis=-1)


def meeting_point(poses: Float[np.ndarray, "cameras 3 4"]) -> Float[np.ndarray, "3"]:
    """Returns the point that is nearest to all optical axes, by least squares.

    Raises:
      SceneError: if the axes are all but parallel, so that they meet nowhere.
    """
    axes = poses[..., 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.cond(total) > _WORST_CONDITION:
        raise SceneError(
            "All cameras look the same way, so nothing says where the middle of the scene is. Give "
            "it as the centre, such as (0.5, 0, 1.2)."
        )
    return np.linalg.solve(total, np.einsum("nij,nj->i", across, poses[..., 3]))
