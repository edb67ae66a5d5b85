"""Teapot, teacup, water pitcher and kettle: hollow, with handles and spouts (NumPy only).

Each is one piece of glass, open at mouth and spout. Fields are those of `distance_fields`; the
spout points to x, z is up.
"""

import numpy as np
from jaxtyping import Float

from experiments.dataset.objects.distance_fields import (
    Field,
    Points,
    ellipsoid,
    revolution,
    revolution_wall,
    torus,
)
from experiments.dataset.objects.field_operations import (
    intersection,
    moved,
    offset,
    subtraction,
    union,
    warped,
)
from experiments.dataset.objects.formed import single_glass
from experiments.dataset.objects.space_curves import limb, through

# Thickness of vessels' walls, and blending length of their edges.
_WALL = 0.1
_EDGE = 0.06

# Gap between cup and saucer: smoothing would merge closer surfaces.
_LIFT = 0.04

# The pitcher's lip: its reach, its width (radians), and the range of heights over which it grows.
_LIP, _LIP_WIDTH, _LIP_FROM, _LIP_TO = 0.34, 0.5, 0.55, 1.3


def _teapot() -> Field:
    pot = intersection(
        ellipsoid((0.0, 0.0, 0.0), (1.12, 1.12, 0.9)), _above(-0.72), blend=4.0 * _EDGE
    )
    foot = moved(torus(0.66, 0.1), (0.0, 0.0, -0.72))
    lid = moved(torus(0.52, 0.06), (0.0, 0.0, 0.8))
    stem = limb((0.0, 0.0, 0.8, 0.12), (0.0, 0.0, 1.06, 0.08))
    knob = ellipsoid((0.0, 0.0, 1.15), (0.2, 0.2, 0.16))
    spout = limb(
        (0.75, 0.0, -0.35, 0.34),
        (1.15, 0.0, -0.22, 0.27),
        (1.45, 0.0, 0.2, 0.2),
        (1.66, 0.0, 0.52, 0.195),
        (1.85, 0.0, 0.66, 0.19),
    )
    bore = limb(
        (0.6, 0.0, -0.35, 0.24),
        (1.15, 0.0, -0.22, 0.17),
        (1.45, 0.0, 0.2, 0.115),
        (1.66, 0.0, 0.52, 0.1),
        (2.2, 0.0, 0.9, 0.1),
    )
    handle = limb(
        (-0.85, 0.0, 0.42, 0.14),
        (-1.3, 0.0, 0.6, 0.11),
        (-1.68, 0.0, 0.32, 0.11),
        (-1.55, 0.0, -0.18, 0.11),
        (-0.98, 0.0, -0.4, 0.14),
    )
    outside = union(pot, foot, lid, stem, knob, blend=0.08)
    outside = union(outside, spout, handle, blend=0.2)
    inside = union(offset(pot, -_WALL), bore, blend=0.15)
    return subtraction(outside, inside, blend=_EDGE)


def _teacup() -> Field:
    curve = through(np.array([(0.0, -0.4), (0.3, -0.4), (0.62, -0.22), (0.85, 0.25), (0.98, 0.85)]))
    wall = revolution_wall(curve, 0.09)
    foot = revolution_wall(np.array([(0.42, -0.38), (0.44, -0.5)]), 0.1)
    handle = limb(
        (0.86, 0.0, 0.62, 0.085),
        (1.3, 0.0, 0.7, 0.075),
        (1.5, 0.0, 0.4, 0.075),
        (1.25, 0.0, 0.05, 0.075),
        (0.68, 0.0, -0.08, 0.09),
    )
    cup = union(union(wall, foot, blend=0.08), _outside_of(handle, curve), blend=0.08)
    dish = through(
        np.array([(0.0, -0.62), (0.45, -0.62), (0.75, -0.6), (1.15, -0.5), (1.55, -0.3)])
    )
    ring = revolution_wall(np.array([(0.68, -0.64), (0.69, -0.74)]), 0.09)
    saucer = union(revolution_wall(dish, 0.08), ring, blend=0.06)
    # Under the cup's foot, which ends at -0.55, the dish is at -0.58.
    return union(moved(cup, (0.0, 0.0, _LIFT)), saucer)


def _pitcher() -> Field:
    curve = through(
        np.array(
            [
                (0.0, -1.4),
                (0.45, -1.4),
                (0.74, -1.22),
                (0.88, -0.65),
                (0.74, 0.0),
                (0.56, 0.55),
                (0.58, 0.95),
                (0.7, 1.3),
            ]
        )
    )
    base = revolution_wall(np.array([(0.0, -1.43), (0.5, -1.43)]), 0.14)
    vessel = warped(union(revolution_wall(curve, _WALL), base, blend=0.08), _to_a_lip, _LIP)
    handle = limb(
        (-0.56, 0.0, 0.95, 0.11),
        (-1.05, 0.0, 1.12, 0.1),
        (-1.42, 0.0, 0.7, 0.1),
        (-1.32, 0.0, 0.0, 0.1),
        (-0.86, 0.0, -0.45, 0.12),
    )
    return union(vessel, _outside_of(handle, curve), blend=0.15)


def _kettle() -> Field:
    profile = through(
        np.array([(0.0, -1.0), (0.6, -1.0), (1.02, -0.86), (1.2, -0.4), (0.95, 0.15), (0.5, 0.42)])
    )
    pot = revolution(np.concatenate([profile, [[0.0, 0.5]]]))
    lid = moved(torus(0.52, 0.06), (0.0, 0.0, 0.42))
    stem = limb((0.0, 0.0, 0.4, 0.1), (0.0, 0.0, 0.64, 0.07))
    knob = ellipsoid((0.0, 0.0, 0.72), (0.2, 0.2, 0.13))
    spout = limb((0.85, 0.0, -0.3, 0.3), (1.3, 0.0, 0.0, 0.22), (1.62, 0.0, 0.34, 0.185))
    bore = limb(
        (0.75, 0.0, -0.35, 0.21),
        (1.3, 0.0, 0.0, 0.11),
        (1.62, 0.0, 0.34, 0.09),
        (1.9, 0.0, 0.62, 0.09),
    )
    hoop = limb(
        (-0.85, 0.0, 0.16, 0.11),
        (-1.05, 0.0, 0.8, 0.09),
        (-0.6, 0.0, 1.32, 0.1),
        (0.0, 0.0, 1.46, 0.11),
        (0.6, 0.0, 1.32, 0.1),
        (1.05, 0.0, 0.8, 0.09),
        (0.85, 0.0, 0.16, 0.11),
    )
    outside = union(pot, lid, stem, knob, blend=0.1)
    outside = union(outside, spout, hoop, blend=0.16)
    inside = union(offset(pot, -_WALL), bore, blend=0.15)
    return subtraction(outside, inside, blend=_EDGE)


def _outside_of(solid: Field, curve: Float[np.ndarray, "points 2"]) -> Field:
    """Returns the part of a solid that does not reach through a vessel's wall into the vessel."""
    top = np.array([[curve[-1, 0], 2.0], [0.0, 2.0]])
    return subtraction(solid, revolution(np.concatenate([curve, top])))


def _above(height: float) -> Field:
    """Returns the half space above a plane."""
    return Field(lambda p: height - p[:, 2], (0.0, 0.0, 0.0), np.inf)


def _to_a_lip(points: Points) -> Points:
    """Moves points near the rim towards the axis, so that the rim juts out."""
    share = np.clip((points[:, 2] - _LIP_FROM) / (_LIP_TO - _LIP_FROM), 0.0, None)
    angle = np.arctan2(points[:, 1], points[:, 0])
    out = _LIP * np.minimum(share, 1.2) ** 2 * np.exp(-((angle / _LIP_WIDTH) ** 2))
    away = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-9)
    # Less near the axis, where all angles meet.
    drawn = np.maximum(away - out * np.minimum(1.0, (away / 0.4) ** 2), 0.0) / away
    return points * np.stack([drawn, drawn, np.ones_like(drawn)], axis=-1)


OBJECTS = (
    single_glass("teapot", _teapot, radius=1.85, thinnest=0.08, fineness=0.95),
    single_glass("teacup", _teacup, radius=1.75, thinnest=0.08, fineness=0.9),
    single_glass("water_pitcher", _pitcher, radius=1.85, thinnest=0.09, fineness=0.95),
    single_glass("wisolt_kettle", _kettle, radius=1.85, thinnest=0.08, fineness=0.95),
)
