"""A man and a woman as classical statues on a base (NumPy only).

Both rest on one leg, so that hips and shoulders tilt in opposite directions. Fields are those of
`distance_fields`; z is up, they face -y, and their left is +x.
"""

import numpy as np

from experiments.dataset.objects.distance_fields import Field, Points, ellipsoid, revolution
from experiments.dataset.objects.field_operations import (
    both_sides,
    offset,
    subtraction,
    union,
    warped,
)
from experiments.dataset.objects.formed import filled_glass, single_glass
from experiments.dataset.objects.space_curves import limb

# Folds of the woman's dress: their number around it, and their depth at the hem.
_FOLDS, _FOLD_DEPTH = 14, 0.045
_WAIST, _HEM = 0.25, -1.6


def _man() -> Field:
    torso = union(
        ellipsoid((0.02, 0.02, 0.08), (0.31, 0.22, 0.26)),
        limb((0.01, 0.0, 0.1, 0.26), (0.0, -0.02, 0.4, 0.27), (-0.01, 0.02, 0.7, 0.3)),
        ellipsoid((0.0, 0.02, 0.7), (0.4, 0.25, 0.34)),
        limb((-0.42, 0.04, 0.9, 0.16), (0.0, 0.05, 0.97, 0.15), (0.42, 0.04, 0.95, 0.16)),
        *both_sides(
            ellipsoid((0.18, -0.15, 0.76), (0.19, 0.11, 0.15)),
            ellipsoid((0.15, 0.16, 0.02), (0.18, 0.16, 0.19)),
        ),
        blend=0.12,
    )
    legs = [
        limb((-0.17, 0.0, 0.05, 0.22), (-0.21, -0.03, -0.35, 0.2), (-0.2, -0.04, -0.74, 0.135)),
        limb((-0.2, -0.03, -0.74, 0.13), (-0.2, 0.04, -0.98, 0.15), (-0.2, 0.06, -1.46, 0.085)),
        limb((-0.2, 0.07, -1.54, 0.09), (-0.25, -0.24, -1.58, 0.075)),
        limb((0.17, -0.02, 0.05, 0.21), (0.27, -0.16, -0.32, 0.19), (0.33, -0.24, -0.68, 0.13)),
        limb((0.33, -0.22, -0.7, 0.13), (0.35, -0.08, -0.96, 0.145), (0.36, 0.06, -1.44, 0.085)),
        limb((0.36, 0.07, -1.54, 0.09), (0.47, -0.2, -1.58, 0.075)),
    ]
    arms = [
        limb((-0.47, 0.04, 0.9, 0.15), (-0.56, 0.08, 0.66, 0.125), (-0.6, 0.1, 0.42, 0.1)),
        limb((-0.6, 0.1, 0.44, 0.1), (-0.6, 0.02, 0.22, 0.1), (-0.56, -0.06, 0.02, 0.075)),
        limb((-0.56, -0.07, -0.02, 0.08), (-0.53, -0.1, -0.18, 0.075)),
        limb((0.47, 0.04, 0.94, 0.15), (0.62, 0.02, 0.72, 0.125), (0.72, -0.04, 0.52, 0.1)),
        limb((0.72, -0.04, 0.52, 0.1), (0.68, -0.24, 0.74, 0.1), (0.56, -0.26, 0.98, 0.075)),
        limb((0.55, -0.25, 1.02, 0.08), (0.46, -0.16, 1.12, 0.08)),
    ]
    body = union(torso, *legs, *arms, blend=0.1)
    figure = union(body, _head((0.0, -0.04, 1.47)), _neck((0.0, 0.05, 0.98), 0.14), blend=0.07)
    return union(figure, _base(0.62), blend=0.06)


def _woman() -> Field:
    torso = union(
        limb((0.0, 0.02, 0.2, 0.24), (0.0, 0.0, 0.42, 0.22), (0.0, 0.02, 0.72, 0.23)),
        ellipsoid((0.0, 0.02, 0.72), (0.31, 0.21, 0.26)),
        limb((-0.33, 0.04, 0.92, 0.13), (0.0, 0.05, 0.96, 0.13), (0.33, 0.04, 0.94, 0.13)),
        *both_sides(ellipsoid((0.14, -0.17, 0.7), (0.14, 0.13, 0.13))),
        blend=0.1,
    )
    skirt = union(
        ellipsoid((0.0, 0.04, 0.0), (0.36, 0.29, 0.3)),
        limb((-0.06, 0.04, -0.1, 0.33), (-0.06, 0.03, -0.8, 0.34), (-0.04, 0.03, -1.3, 0.42)),
        # The bent leg is visible under the cloth.
        limb((0.14, -0.04, -0.1, 0.26), (0.24, -0.26, -0.68, 0.2), (0.22, -0.1, -1.35, 0.3)),
        blend=0.18,
    )
    dress = warped(skirt, _into_folds, _FOLD_DEPTH)
    arms = [
        limb((-0.36, 0.04, 0.92, 0.13), (-0.5, 0.1, 0.66, 0.11), (-0.58, 0.14, 0.42, 0.09)),
        limb((-0.58, 0.14, 0.44, 0.09), (-0.48, -0.02, 0.27, 0.085), (-0.33, -0.12, 0.12, 0.075)),
        limb((0.36, 0.04, 0.94, 0.13), (0.56, 0.02, 1.06, 0.105), (0.74, 0.0, 1.24, 0.09)),
        limb((0.74, 0.0, 1.24, 0.09), (0.58, 0.0, 1.46, 0.085), (0.36, -0.02, 1.62, 0.075)),
        limb((0.34, -0.02, 1.63, 0.075), (0.2, -0.02, 1.66, 0.07)),
    ]
    hair = union(
        ellipsoid((0.0, 0.05, 1.52), (0.19, 0.2, 0.2)),
        ellipsoid((0.0, 0.26, 1.52), (0.13, 0.12, 0.13)),
        blend=0.06,
    )
    body = union(torso, *arms, blend=0.09)
    body = union(body, _head((0.0, -0.03, 1.46)), _neck((0.0, 0.05, 0.98), 0.11), blend=0.06)
    return union(union(body, hair, blend=0.05), dress, _base(0.6), blend=0.07)


def _head(centre: tuple[float, float, float]) -> Field:
    x, y, z = centre
    skull = union(
        ellipsoid((x, y + 0.03, z + 0.04), (0.17, 0.205, 0.2)),
        ellipsoid((x, y - 0.06, z - 0.1), (0.12, 0.13, 0.15)),
        limb((x, y - 0.18, z + 0.04, 0.03), (x, y - 0.23, z - 0.05, 0.04)),
        blend=0.07,
    )
    eyes = both_sides(ellipsoid((x + 0.075, y - 0.2, z + 0.02), (0.045, 0.05, 0.03)))
    return subtraction(skull, union(*eyes), blend=0.04)


def _neck(foot: tuple[float, float, float], radius: float) -> Field:
    x, y, z = foot
    return limb((x, y, z, 1.1 * radius), (x, y - 0.03, z + 0.4, 0.9 * radius))


def _base(radius: float) -> Field:
    """Returns a round base with a rounded edge, for feet at a height of about -1.6."""
    disc = np.array([(0.0, -1.8), (radius, -1.8), (radius, -1.66), (0.0, -1.66)])
    return offset(revolution(disc), 0.05)


def _into_folds(points: Points) -> Points:
    """Scales the part below the waist periodically, in folds that deepen towards the hem."""
    share = np.clip((_WAIST - points[:, 2]) / (_WAIST - _HEM), 0.0, 1.0)
    angle = np.arctan2(points[:, 1], points[:, 0])
    away = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-9)
    # Less near the axis, where all angles meet.
    depth = _FOLD_DEPTH * share * np.minimum(1.0, (away / 0.2) ** 2)
    # At most `_FOLD_DEPTH`, so that distances hardly increase.
    wider = np.maximum(away - depth * np.sin(_FOLDS * angle), 0.0) / away
    return points * np.stack([wider, wider, np.ones_like(wider)], axis=-1)


OBJECTS = (
    single_glass("man_sculpture", _man, radius=1.9, thinnest=0.1, fineness=1.4),
    filled_glass(
        "woman_sculpture",
        _woman,
        radius=1.9,
        thinnest=0.1,
        medium="perfume",
        absorption=(0.1, 1.1, 0.7),
        fineness=1.4,
    ),
)
