"""A dragon asleep, curled up with its head on its tail: glass around a tinted core (NumPy only).

Fields are those of `distance_fields`; z is up. The spine goes around the z axis: angle 0 is +x, and
the head lies towards -y.
"""

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from experiments.dataset.objects.distance_fields import Field, ellipsoid, tube
from experiments.dataset.objects.field_operations import moved, subtraction, turned, union
from experiments.dataset.objects.formed import filled_glass
from experiments.dataset.objects.space_curves import limb, through

# Along the spine: angle (degrees), distance from the axis, height, and radius of the trunk.
_SPINE = np.array(
    [
        (-84.0, 1.18, -0.06, 0.2),
        (-62.0, 1.2, 0.04, 0.23),
        (-35.0, 1.16, 0.08, 0.28),
        (-5.0, 1.02, 0.06, 0.4),
        (35.0, 0.92, 0.04, 0.52),
        (80.0, 0.9, 0.06, 0.58),
        (125.0, 0.94, 0.04, 0.54),
        (165.0, 1.02, -0.06, 0.44),
        (200.0, 1.12, -0.2, 0.31),
        (232.0, 1.2, -0.32, 0.22),
        (262.0, 1.25, -0.37, 0.19),
        (290.0, 1.3, -0.4, 0.15),
        (316.0, 1.44, -0.41, 0.1),
        (336.0, 1.6, -0.38, 0.05),
    ]
)

# Spikes are placed between these angles, at this step in degrees, and lean outwards.
_FIRST_SPIKE, _LAST_SPIKE, _SPIKE_STEP = -52.0, 250.0, 16.0
_SPIKE_LENGTH = 0.26


def _dragon() -> Field:
    angle = np.radians(_SPINE[:, 0])
    joints = np.stack(
        [_SPINE[:, 1] * np.cos(angle), _SPINE[:, 1] * np.sin(angle), _SPINE[:, 2]], axis=-1
    )
    curve = through(joints, between=6)
    at = np.linspace(0.0, len(joints) - 1.0, len(curve))
    trunk = tube(curve, PchipInterpolator(np.arange(len(joints)), _SPINE[:, 3])(at))
    body = union(trunk, *_limbs(), blend=0.16)
    return union(body, *_spikes(), _arrow(), _head(), blend=0.08)


def _spikes() -> list[Field]:
    along = PchipInterpolator(_SPINE[:, 0], _SPINE[:, 1:])
    spikes = []
    for degrees in np.arange(_FIRST_SPIKE, _LAST_SPIKE, _SPIKE_STEP).tolist():
        away, height, radius = along(degrees).tolist()
        out = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0.0])
        up = 0.45 * out + np.array([0.0, 0.0, 0.9])
        root = away * out + np.array([0.0, 0.0, height]) + 0.85 * radius * up
        size = 0.5 + radius
        tip = root + _SPIKE_LENGTH * size * up / np.linalg.norm(up)
        spikes.append(limb((*root, 0.16 * size), (*tip, 0.05)))
    return spikes


def _limbs() -> list[Field]:
    """Returns thighs, forelegs and paws on the outside, and a folded wing."""
    return [
        _at(142.0, 1.32, ellipsoid((0.0, 0.0, -0.12), (0.3, 0.42, 0.34))),
        _on_ring((150.0, 1.55, -0.3, 0.17), (122.0, 1.62, -0.42, 0.13), (112.0, 1.7, -0.46, 0.11)),
        _on_ring((14.0, 1.3, -0.05, 0.24), (2.0, 1.5, -0.3, 0.15), (-18.0, 1.52, -0.44, 0.12)),
        _on_ring((25.0, 1.2, 0.36, 0.14), (60.0, 1.42, 0.5, 0.12), (105.0, 1.46, 0.12, 0.08)),
        _on_ring((60.0, 1.42, 0.46, 0.11), (85.0, 1.5, 0.2, 0.1), (96.0, 1.48, -0.12, 0.07)),
        _on_ring((58.0, 1.42, 0.46, 0.11), (66.0, 1.52, 0.15, 0.1), (74.0, 1.5, -0.2, 0.07)),
    ]


def _head() -> Field:
    """Returns the head, at the end of the ring, on top of the tail."""
    skull = union(
        ellipsoid((0.0, 0.0, 0.06), (0.27, 0.32, 0.24)),
        limb((0.0, -0.1, 0.02, 0.23), (0.0, -0.42, -0.03, 0.17), (0.0, -0.66, -0.05, 0.14)),
        ellipsoid((0.09, -0.7, 0.04), (0.07, 0.09, 0.06)),
        ellipsoid((-0.09, -0.7, 0.04), (0.07, 0.09, 0.06)),
        # Brows above closed eyes.
        limb((0.14, 0.12, 0.24, 0.06), (0.19, -0.16, 0.17, 0.055)),
        limb((-0.14, 0.12, 0.24, 0.06), (-0.19, -0.16, 0.17, 0.055)),
        blend=0.09,
    )
    lids = [ellipsoid((side * 0.25, -0.2, 0.08), (0.06, 0.1, 0.03)) for side in (-1.0, 1.0)]
    jaws = [
        limb((side * 0.24, -0.1, -0.1, 0.02), (side * 0.2, -0.7, -0.1, 0.02)) for side in (-1, 1)
    ]
    skull = subtraction(skull, union(*lids, *jaws), blend=0.05)
    horns = [
        limb(
            (side * 0.14, 0.2, 0.2, 0.09),
            (side * 0.24, 0.42, 0.38, 0.075),
            (side * 0.3, 0.68, 0.46, 0.03),
        )
        for side in (-1.0, 1.0)
    ]
    head = union(skull, *horns, blend=0.06)
    # Its muzzle, at -y, is turned to point along the ring, over the tail.
    head = turned(head, Rotation.from_euler("z", -80.0, degrees=True))
    return moved(head, (0.02, -1.22, -0.03))


def _arrow() -> Field:
    """Returns the tip of the tail."""
    degrees, away, height = _SPINE[-1, :3].tolist()
    x, y, z = _ring_point(degrees, away, height)
    blade = ellipsoid((0.0, 0.0, 0.0), (0.15, 0.24, 0.08))
    return moved(turned(blade, Rotation.from_euler("z", degrees - 20.0, degrees=True)), (x, y, z))


def _at(degrees: float, away: float, solid: Field) -> Field:
    """Returns a solid moved to the ring and rotated along it."""
    return moved(
        turned(solid, Rotation.from_euler("z", degrees, degrees=True)),
        _ring_point(degrees, away, 0.0),
    )


def _on_ring(*joints: tuple[float, float, float, float]) -> Field:
    """Returns a limb through joints of angle, distance from the axis, height and radius."""
    return limb(
        *((*_ring_point(degrees, away, height), radius) for degrees, away, height, radius in joints)
    )


def _ring_point(degrees: float, away: float, height: float) -> tuple[float, float, float]:
    angle = np.radians(degrees)
    return float(away * np.cos(angle)), float(away * np.sin(angle)), height


OBJECTS = (
    filled_glass(
        "sleeping_dragon",
        _dragon,
        radius=1.85,
        thinnest=0.1,
        medium="perfume",
        absorption=(1.2, 0.15, 0.9),
        fineness=1.1,
    ),
)
