"""Magnifier, skull-shaped bottle, and an abstract sculpture, each of one transparent material.

Fields are those of `distance_fields`; z is up, faces point to -y.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.dataset.objects import placing
from experiments.dataset.objects.distance_fields import (
    Field,
    ellipsoid,
    revolution,
    torus,
    tube,
)
from experiments.dataset.objects.field_operations import (
    both_sides,
    intersection,
    moved,
    offset,
    subtraction,
    turned,
    union,
)
from experiments.dataset.objects.formed import centred, single_glass, softened, spacing
from experiments.dataset.objects.isosurface import isosurface
from experiments.dataset.objects.placing import tilted
from experiments.dataset.objects.profiles import arc, sampling
from experiments.dataset.objects.regions import region, rounded
from experiments.dataset.objects.space_curves import limb
from experiments.dataset.objects.vessels import GLASS, body
from experiments.dataset.parts import OPAQUE, Object, ObjectPart
from refref_jax.choices import Colour

# The lens: the radius and the thickness of its caps, and the radius to which their edge is rounded.
_LENS_RADIUS, _LENS_THICKNESS, _LENS_EDGE = 0.9, 0.42, 0.03

# Height by which the magnifier is moved up into the searched cube.
_GRIP = 0.9

_BLACK: Colour = (0.04, 0.035, 0.03)

_SKULL_WALL = 0.13

# The knot: radius of the ring that it winds around, distance from that ring, and the tube's radius,
# which increases three times along the knot.
_KNOT_RING, _KNOT_AWAY, _KNOT_TUBE, _KNOT_SWELL = 1.15, 0.5, 0.27, 0.06
_KNOT_POINTS = 360


def _frame() -> Field:
    """Returns the rim and the handle, around a lens at the origin."""
    rim = turned(torus(1.02, 0.13), Rotation.from_euler("x", 90.0, degrees=True))
    collar = limb((0.0, 0.0, -1.1, 0.13), (0.0, 0.0, -1.45, 0.1))
    profile = [(0.0, -2.9), (0.12, -2.88), (0.19, -2.75), (0.2, -2.4), (0.15, -1.75), (0.13, -1.4)]
    handle = revolution(np.array([*profile, (0.0, -1.4)]))
    grip = union(collar, offset(handle, 0.02), blend=0.1)
    return union(rim, grip, blend=0.1)


def _make_magnifier(detail: float) -> list[ObjectPart]:
    """A lens of glass in an opaque rim with a handle."""
    half = 0.5 * _LENS_THICKNESS
    # Two caps of a sphere, each with half the height of the lens.
    curvature = (_LENS_RADIUS**2 + half**2) / (2.0 * half)
    caps = [
        region(arc((0.0, side * (curvature - half)), curvature, -90.0, 90.0)) for side in (-1, 1)
    ]
    shape = rounded(caps[0] ^ caps[1], convex=_LENS_EDGE)
    lens = tilted([body("lens", GLASS, shape, sampling(detail))], axis="x", degrees=90.0)
    step = spacing(1.5 * detail, thinnest=0.12)
    grip = isosurface(softened(moved(_frame(), (0.0, 0.0, _GRIP))), spacing=step)
    frame = ObjectPart("frame", OPAQUE, *grip, kind="opaque", albedo=_BLACK)
    return centred([*placing.moved(lens, (0.0, 0.0, _GRIP)), frame], 1.9)


def _skull_bottle() -> Field:
    cranium = union(
        ellipsoid((0.0, 0.22, 0.34), (0.84, 1.04, 0.82)),
        ellipsoid((0.0, -0.25, 0.32), (0.68, 0.58, 0.56)),
        blend=0.2,
    )
    face = union(
        cranium,
        ellipsoid((0.0, -0.5, -0.42), (0.46, 0.44, 0.5)),
        ellipsoid((0.0, -0.66, -0.64), (0.4, 0.36, 0.32)),
        ellipsoid((0.0, -0.66, -1.0), (0.36, 0.3, 0.2)),
        *both_sides(
            ellipsoid((0.45, -0.7, -0.27), (0.18, 0.18, 0.13)),
            limb((0.66, 0.1, -0.12, 0.09), (0.64, -0.25, -0.2, 0.1), (0.52, -0.58, -0.27, 0.1)),
            limb((0.58, 0.05, -0.35, 0.13), (0.5, -0.15, -0.85, 0.15), (0.26, -0.6, -1.0, 0.16)),
            limb((0.62, -0.54, 0.2, 0.08), (0.36, -0.74, 0.36, 0.09), (0.1, -0.8, 0.28, 0.09)),
            limb((0.09, -0.78, 0.28, 0.09), (0.06, -0.82, 0.1, 0.07)),
        ),
        blend=0.2,
    )
    features = both_sides(
        ellipsoid((0.34, -0.92, 0.05), (0.23, 0.4, 0.23)),
        limb((0.04, -0.98, -0.08, 0.1), (0.12, -0.97, -0.36, 0.15)),
        ellipsoid((0.98, -0.35, 0.22), (0.16, 0.4, 0.34)),
    )
    carved = subtraction(face, union(*features), blend=0.12)
    carved = subtraction(carved, _between_teeth(), blend=0.06)
    flat = Field(lambda p: -1.12 - p[:, 2], (0.0, 0.0, 0.0), np.inf)
    skull = intersection(carved, flat, blend=0.12)
    neck = union(
        limb((0.0, 0.2, 1.0, 0.27), (0.0, 0.2, 1.55, 0.24)),
        moved(torus(0.2, 0.09), (0.0, 0.2, 1.66)),
        blend=0.1,
    )
    room = union(
        ellipsoid((0.0, 0.22, 0.32), (0.7, 0.9, 0.68)),
        ellipsoid((0.0, -0.25, -0.45), (0.36, 0.42, 0.52)),
        blend=0.25,
    )
    inside = intersection(room, offset(skull, -_SKULL_WALL), blend=0.1)
    bore = limb((0.0, 0.2, 0.8, 0.14), (0.0, 0.2, 2.1, 0.14))
    whole = union(skull, neck, blend=0.2)
    return subtraction(whole, union(inside, bore, blend=0.15), blend=0.05)


def _between_teeth() -> Field:
    """Returns the grooves between the rows of teeth, and between the teeth of both rows."""
    row = limb((-0.36, -0.76, -0.76, 0.05), (0.0, -1.0, -0.78, 0.05), (0.36, -0.76, -0.76, 0.05))
    gaps = []
    for x in np.linspace(-0.27, 0.27, 6).tolist():
        y = 0.9 * x**2 - 1.0
        gaps.append(
            limb((x, y - 0.01, -0.6, 0.042), (x, y, -0.78, 0.045), (x, y + 0.03, -0.94, 0.042))
        )
    return union(row, *gaps)


def _generic_sculpture() -> Field:
    # A few points are repeated, so that there are neighbours on both sides of the seam.
    turn = 2.0 * np.pi * np.arange(-4, _KNOT_POINTS + 5) / _KNOT_POINTS
    away = _KNOT_RING + _KNOT_AWAY * np.cos(3.0 * turn)
    curve = np.stack(
        [away * np.cos(2.0 * turn), _KNOT_AWAY * np.sin(3.0 * turn), away * np.sin(2.0 * turn)],
        axis=-1,
    )
    return tube(curve, _KNOT_TUBE + _KNOT_SWELL * np.cos(3.0 * turn))


OBJECTS = (
    Object("magnifier", "smncvx", _make_magnifier),
    single_glass("skull_bottle", _skull_bottle, radius=1.7, thinnest=0.09, fineness=1.05),
    single_glass("generic_sculpture", _generic_sculpture, radius=1.75, thinnest=0.12, fineness=0.9),
)
