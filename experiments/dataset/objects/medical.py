"""Small vessels for medicine: an ampoule, a vial and a syringe."""

import numpy as np

from experiments.dataset.objects.placing import centred, tilted
from experiments.dataset.objects.profiles import filleted, sampling
from experiments.dataset.objects.regions import Region, box, region, ring, rounded
from experiments.dataset.objects.revolve import (
    Turned,
    Values,
    even_angles,
    faded,
    ramp,
    round_about,
    waves,
    within,
)
from experiments.dataset.objects.vessels import (
    Look,
    body,
    cap,
    filled,
    open_mouth,
    painted,
    sealed,
    space_in,
    vessel,
)
from experiments.dataset.parts import Object, ObjectPart

_AMBER = Look("water", tint=(0.97, 0.82, 0.5))
_CLEAR_BLUE = Look("water", tint=(0.78, 0.9, 0.99))
_CYAN = Look("alcohol", absorption=(1.1, 0.25, 0.12))
_PLASTIC = Look("plastic")
_CAP = painted(0.08, 0.12, 0.45)
_PLUNGER = painted(0.75, 0.8, 0.82)


def _make_ampoule(detail: float) -> list[ObjectPart]:
    """A sealed ampoule above a bulb and a narrow neck, where it is broken off."""
    outline = region(
        filleted(
            (0, 0),
            (0.5, 0, 0.1),
            (0.5, 1.85, 0.22),
            (0.2, 2.16, 0.07),
            (0.29, 2.42, 0.16),
            (0.15, 3.0, 0.5),
            (0.13, 3.62, 0.129),
            (0, 3.62),
        )
    )
    space = space_in(outline, wall=0.05, floor=0.06, corner=0.035)
    shapes = sealed(outline, space, level=1.45, meniscus=0.035)
    return centred(vessel(shapes, sampling(detail, segments=72), liquid=_AMBER))


def _make_vial(detail: float) -> list[ObjectPart]:
    """A scintillation vial of 20 ml with a knurled, opaque screw cap."""
    outline = region(
        filleted(
            (0, 0),
            (0.78, 0, 0.12),
            (0.78, 2.35, 0.22),
            (0.52, 2.55, 0.08),
            (0.52, 3.0),
            (0, 3.0),
        )
    )
    mouth = open_mouth(outline, wall=0.06)
    space = space_in(outline, wall=0.06, floor=0.1, corner=0.1, mouth=mouth)
    cut = sampling(detail)
    lid = cap(0.7, low=2.66, high=3.26, bore=0.572, ceiling=3.052, edge=0.04)
    knurled = faded(waves(20, 0.045), _side_of_cap)
    return centred(
        [
            *vessel(filled(outline, space, level=1.75, rim=0.026), cut, liquid=_CYAN),
            body(
                "cap", _CAP, lid, cut, turned=Turned(even_angles(cut, lobes=20, each=12), knurled)
            ),
        ]
    )


def _side_of_cap(r: Values, z: Values) -> Values:
    return ramp(r, 0.6, 0.69) * within(z, 2.68, 3.24, soft=0.1)


def _make_syringe(detail: float) -> list[ObjectPart]:
    """A half full syringe with an opaque plunger, needle down, tilted."""
    cut = sampling(detail, segments=80)
    barrel, space = _barrel()
    shapes = filled(barrel, space, level=0.98, rim=0.024, meniscus=0.03)
    grip = round_about(cut)._replace(warp=_finger_grip)
    cross = faded(waves(4, 0.36), lambda r, z: within(z, 1.3, 2.72, soft=0.12))
    parts = [
        body("barrel", _PLASTIC, shapes.glass, cut, turned=grip),
        body("liquid", _CLEAR_BLUE, shapes.liquid, cut),
        body("plunger", _PLUNGER, _plunger(), cut, turned=round_about(cut)._replace(warp=cross)),
    ]
    return tilted(centred(parts), axis="y", degrees=38.0)


def _barrel() -> tuple[Region, Region]:
    """Returns the outline of a barrel with a solid needle, and the space inside."""
    outline = region(
        filleted(
            (0, -1.0),
            (0.028, -0.96),
            (0.028, -0.42, 0.05),
            (0.09, -0.36, 0.04),
            (0.13, -0.06, 0.05),
            (0.32, 0.03, 0.06),
            (0.32, 2.0),
            (0, 2.0),
        )
    )
    space = space_in(outline, wall=0.055, floor=0.09, corner=0.05, mouth=0.265)
    flange = rounded(box(0.62, 1.9, 2.0), convex=0.045)
    return rounded(outline + flange, concave=0.04), space


def _plunger() -> Region:
    """Returns a piston with two sealing rings, a rod, and a thumb rest."""
    piston = box(0.2, 1.03, 1.3) + ring(0.19, 1.09, 0.08) + ring(0.19, 1.24, 0.08)
    rest = box(0.36, 2.72, 2.83)
    return rounded(piston + box(0.16, 1.1, 2.8) + rest, convex=0.035, concave=0.04)


def _finger_grip(angle: Values, r: Values, z: Values) -> Values:
    """Warps the flange to an oval; the barrel stays round."""
    beyond = np.maximum(r - 0.34, 0.0)
    return r - beyond * 0.6 * np.sin(angle) ** 2


OBJECTS = (
    Object("ampoule", "mmncvx", _make_ampoule),
    Object("vial", "mmncvx", _make_vial),
    Object("syringe", "mmncvx", _make_syringe),
)
