"""Distances between camera poses, to find the test views farthest from the training (NumPy only).

The paper uses test views "farthest from any training view in camera pose space" without defining a
distance. Here the distance of two poses is

    sqrt(|c - c'|^2 / s^2 + a^2)

with the camera positions `c`, the angle `a` in radians of the rotation between the cameras' axes,
and the scale `s`, the mean distance of the training cameras from the world's origin, around which
the objects of the data set are placed. A camera that rotates around the origin by an angle changes
both terms by the same amount. The distance of a test view is that to the nearest training view.
"""

import numpy as np
from jaxtyping import Float


def distances(
    tests: Float[np.ndarray, "tests 3 4"], trainings: Float[np.ndarray, "trainings 3 4"]
) -> Float[np.ndarray, " tests"]:
    """Returns the distance of each test pose from the nearest training pose.

    Args:
      tests: camera-to-world matrices of the test views.
      trainings: camera-to-world matrices of the training views.
    """
    scale = np.mean(np.linalg.norm(trainings[:, :, 3], axis=-1))
    apart = np.linalg.norm(tests[:, None, :, 3] - trainings[None, :, :, 3], axis=-1)
    trace = np.einsum("iab,jab->ij", tests[:, :, :3], trainings[:, :, :3])
    angles = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
    scaled = apart / scale if scale > 0.0 else apart
    return np.sqrt(np.square(scaled) + np.square(angles)).min(axis=1)


def farthest(found: Float[np.ndarray, " tests"], count: int) -> list[int]:
    """Returns the indices of the largest distances, the farthest first; ties keep their order."""
    return [int(i) for i in np.argsort(-found, kind="stable")[:count]]
