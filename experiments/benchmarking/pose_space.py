"""How far test views are from all training views, in the space of camera poses (NumPy only).

The paper speaks of test views "farthest from any training view in camera pose space" and does not
define a distance. Here that of two poses is

    sqrt(|c - c'|^2 / s^2 + a^2)

of camera positions `c`, the angle `a` in radians of the rotation that takes one camera's axes to
the other's, and the scale `s`, the mean distance of the training cameras from the world's origin,
about which the objects of the data set stand. A camera that moves round the origin by an angle
moves by as much in both terms. A test view's own distance is that to the nearest training view.
"""

import numpy as np
from jaxtyping import Float


def distances(
    tests: Float[np.ndarray, "tests 3 4"], trainings: Float[np.ndarray, "trainings 3 4"]
) -> Float[np.ndarray, " tests"]:
    """Returns the distance of each test pose from the nearest training pose.

    Args:
      tests: camera-to-world matrices.
      trainings: the same, of the training views.
    """
    scale = np.mean(np.linalg.norm(trainings[:, :, 3], axis=-1))
    apart = np.linalg.norm(tests[:, None, :, 3] - trainings[None, :, :, 3], axis=-1)
    trace = np.einsum("iab,jab->ij", tests[:, :, :3], trainings[:, :, :3])
    angles = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
    scaled = apart / scale if scale > 0.0 else apart
    return np.sqrt(np.square(scaled) + np.square(angles)).min(axis=1)


def farthest(found: Float[np.ndarray, " tests"], count: int) -> list[int]:
    """Returns the places of the largest distances, the farthest first; ties in their order."""
    return [int(i) for i in np.argsort(-found, kind="stable")[:count]]
