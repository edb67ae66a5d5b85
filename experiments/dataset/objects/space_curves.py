"""Smooth polylines through a few joints, for tubes and profiles (NumPy only)."""

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator, make_interp_spline

from experiments.dataset.objects.distance_fields import Field, tube

# Number of points of a curve between two of its joints.
_BETWEEN = 8


def through(
    joints: Float[np.ndarray, "joints dimensions"], *, between: int = _BETWEEN
) -> Float[np.ndarray, "points dimensions"]:
    """Returns points of the smooth curve through some joints, including these.

    Args:
      joints: two or more points; with two, the curve is straight.
      between: number of segments between consecutive joints.
    """
    at = _parameters(joints)
    spline = make_interp_spline(at, joints, k=min(3, len(joints) - 1))
    return spline(_refined(at, between))


def limb(*joints: tuple[float, float, float, float]) -> Field:
    """Returns a tube along the smooth curve through joints.

    Args:
      *joints: positions and radii, as (x, y, z, radius). Radii between them are within the range of
        the two neighbours.
    """
    table = np.asarray(joints, float)
    at = _parameters(table[:, :3])
    radii = PchipInterpolator(at, table[:, 3])(_refined(at, _BETWEEN))
    return tube(through(table[:, :3]), radii)


def _parameters(joints: Float[np.ndarray, "joints dimensions"]) -> Float[np.ndarray, " joints"]:
    """Returns the centripetal parameters of joints, which prevent loops of the spline."""
    steps = np.sqrt(np.linalg.norm(np.diff(joints, axis=0), axis=-1))
    return np.concatenate([[0.0], np.cumsum(steps)])


def _refined(at: Float[np.ndarray, " joints"], between: int) -> Float[np.ndarray, " points"]:
    return np.interp(np.arange(between * (len(at) - 1) + 1) / between, np.arange(len(at)), at)
