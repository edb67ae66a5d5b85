"""Empty bottles, each of one transparent material: hollow, and open at the mouth."""

import numpy as np

from experiments.dataset.objects.placing import centred
from experiments.dataset.objects.profiles import filleted, joined, sampling, smooth
from experiments.dataset.objects.regions import box, region, ring, rounded
from experiments.dataset.objects.revolve import (
    Turned,
    Values,
    even_angles,
    faded,
    ramp,
    section_angles,
    waves,
    within,
)
from experiments.dataset.objects.vessels import Look, body, cap, hollow, painted, space_in
from experiments.dataset.parts import Object, ObjectPart

_COLA_GREEN = Look(tint=(0.9, 0.97, 0.92))
_DEMIJOHN_GREEN = Look(tint=(0.84, 0.95, 0.88))
_STAR_BLUE = Look(tint=(0.84, 0.92, 0.98))
_PLASTIC = Look("plastic", tint=(0.93, 0.97, 0.99))
_BLUE = painted(0.03, 0.16, 0.6)
_PAPER = painted(0.78, 0.74, 0.64)


def _make_cola_bottle(detail: float) -> list[ObjectPart]:
    """The contour bottle of 195 mm by 60 mm: waisted, with flutes above and below its belt."""
    cut = sampling(detail)
    side = smooth(
        [
            (0.52, 0.15),
            (0.52, 0.4),
            (0.455, 0.95),
            (0.51, 1.5),
            (0.575, 1.9),
            (0.53, 2.3),
            (0.37, 2.75),
            (0.25, 3.15),
            (0.225, 3.66),
        ],
        ends="upright",
    )
    foot = filleted((0, 0.05), (0.3, 0.05, 0.1), (0.36, 0.0, 0.05), (0.45, 0.0, 0.06), (0.52, 0.15))
    outline = region(joined(foot, side, np.array([[0.0, 3.66]])))
    space = space_in(outline, wall=0.055, floor=0.16, corner=0.15, mouth=0.17)
    lip = rounded(box(0.27, 3.46, 3.66) + box(0.255, 3.36, 3.42), convex=0.02)
    shape = hollow(outline + lip, space, rim=0.025, inner=0.03)
    turned = Turned(
        even_angles(cut, lobes=10, each=14), faded(waves(10, 0.085, sharpness=-0.3), _fluted)
    )
    return centred([body("body", _COLA_GREEN, shape, cut, turned=turned)])


def _fluted(r: Values, z: Values) -> Values:
    """Returns the depth of a contour bottle's flutes: 0 at its foot, belt and neck."""
    return within(z, 0.15, 1.62, soft=0.35) + within(z, 2.12, 3.1, soft=0.35)


def _make_plastic_bottle(detail: float) -> list[ObjectPart]:
    """A ribbed bottle with a foot of five lobes, an opaque screw cap, and an opaque label."""
    cut = sampling(0.75 * detail, segments=112)
    outline = region(
        filleted(
            (0, 0.1),
            (0.25, 0.1, 0.1),
            (0.36, 0, 0.08),
            (0.52, 0, 0.1),
            (0.66, 0.3, 0.3),
            (0.66, 2.3, 0.4),
            (0.24, 2.95, 0.14),
            (0.2, 3.5),
            (0, 3.5),
        )
    )
    for height in np.arange(0.65, 2.1, 0.32):
        outline = outline - ring(0.71, float(height), 0.2)
    outline = rounded(outline, convex=0.04, concave=0.04)
    space = space_in(outline, wall=0.05, corner=0.05, mouth=0.15)
    collar = rounded(box(0.33, 2.98, 3.07), convex=0.035)
    shape = hollow(outline + collar, space, rim=0.024, inner=0.03)
    lid = cap(0.31, low=3.12, high=3.62, bore=0.25, ceiling=3.55, edge=0.025)
    label = rounded(box(0.7, 1.12, 1.92) - box(0.676, 0.0, 3.0), convex=0.01)
    foot = faded(waves(5, 0.16), lambda r, z: ramp(r, 0.1, 0.35) * (1.0 - ramp(z, 0.0, 0.42)))
    knurled = faded(waves(20, 0.05), _side_of_cap)
    parts = [
        body("body", _PLASTIC, shape, cut, turned=Turned(even_angles(cut, lobes=5), foot)),
        body("cap", _BLUE, lid, cut, turned=Turned(even_angles(cut, lobes=20, each=16), knurled)),
        body("label", _PAPER, label, cut),
    ]
    return centred(parts)


def _side_of_cap(r: Values, z: Values) -> Values:
    return ramp(r, 0.255, 0.305) * within(z, 3.13, 3.6, soft=0.08)


def _make_star_shaped_bottle(detail: float) -> list[ObjectPart]:
    """A bottle with five ridges that merge into a round neck."""
    cut = sampling(0.75 * detail, segments=112)
    outline = region(
        filleted(
            (0, 0),
            (1.05, 0, 0.12),
            (1.16, 2.15, 0.28),
            (0.34, 2.6, 0.16),
            (0.27, 3.3),
            (0, 3.3),
        )
    )
    space = space_in(outline, wall=0.11, floor=0.16, corner=0.1, mouth=0.19)
    lip = rounded(box(0.36, 3.12, 3.3), convex=0.06)
    star = waves(5, 0.4, sharpness=0.1)
    turned = Turned(section_angles(star, cut), faded(star, lambda r, z: 1.0 - ramp(z, 2.0, 2.7)))
    shape = hollow(outline + lip, space, rim=0.035)
    return centred([body("body", _STAR_BLUE, shape, cut, turned=turned)])


def _make_demijohn_vase(detail: float) -> list[ObjectPart]:
    """A big round jug with a short neck, used for fermenting wine."""
    globe = smooth(
        [(0.85, 0.06), (1.22, 0.45), (1.4, 1.15), (1.22, 1.85), (0.75, 2.3), (0.36, 2.6)]
    )
    foot = filleted((0, 0.1), (0.45, 0.1, 0.2), (0.6, 0.0, 0.12), (0.78, 0.0, 0.06), (0.85, 0.06))
    neck = filleted((0.36, 2.6), (0.33, 2.75, 0.1), (0.33, 3.2), (0, 3.2))
    outline = rounded(region(joined(foot, globe, neck)), convex=0.05, concave=0.2)
    outline = outline + box(0.33, 3.0, 3.2)
    space = space_in(outline, wall=0.07, floor=0.17, corner=0.12, mouth=0.26)
    lip = ring(0.35, 3.12, 0.16)
    shape = hollow(outline + lip, space, rim=0.032)
    return centred([body("body", _DEMIJOHN_GREEN, shape, sampling(detail))])


OBJECTS = (
    Object("cola_bottle", "smncvx", _make_cola_bottle),
    Object("plastic_bottle", "smncvx", _make_plastic_bottle),
    Object("star_shaped_bottle", "smncvx", _make_star_shaped_bottle),
    Object("demijohn_vase", "smncvx", _make_demijohn_vase),
)
