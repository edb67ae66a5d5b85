"""Filled vessels of a household: a glass of wine, flowers in water, a scent with reeds."""

import numpy as np

from experiments.dataset.objects.placing import centred, united
from experiments.dataset.objects.profiles import filleted, joined, sampling, smooth
from experiments.dataset.objects.regions import Region, box, region, rounded
from experiments.dataset.objects.revolve import (
    Turned,
    faded,
    polygon,
    ramp,
    section_angles,
    waves,
)
from experiments.dataset.objects.sticks import along, bundle, piece
from experiments.dataset.objects.vessels import (
    Look,
    filled,
    painted,
    space_in,
    vessel,
)
from experiments.dataset.parts import Object, ObjectPart

_WINE = Look("alcohol", absorption=(0.35, 2.6, 2.2))
_SCENT = Look("perfume", tint=(0.95, 0.86, 0.62))
_WATER = Look("water", tint=(0.93, 0.98, 1.0))
_REED = painted(0.5, 0.32, 0.16)
_STEM = painted(0.1, 0.32, 0.07)
_PETALS = painted(0.75, 0.1, 0.16)

# Distances of sticks from the visible surface of a liquid: above it, and below its film.
_OVER, _UNDER = 0.03, 0.05


def _make_wine_glass(detail: float) -> list[ObjectPart]:
    """Red wine in a stemmed glass with a wide bowl."""
    bowl = smooth(
        [
            (0.085, 1.35),
            (0.13, 1.5),
            (0.5, 1.72),
            (0.84, 2.1),
            (0.94, 2.5),
            (0.86, 3.0),
            (0.71, 3.5),
        ],
        ends="upright",
    )
    foot = filleted(
        (0, 0.05),
        (0.3, 0.04, 0.3),
        (0.6, 0.0, 0.4),
        (0.82, 0.0, 0.024),
        (0.82, 0.05, 0.024),
        (0.3, 0.13, 0.5),
        (0.075, 0.45, 0.4),
        (0.07, 1.0, 1.0),
        (0.085, 1.35),
    )
    outline = rounded(region(joined(foot, bowl, np.array([[0.0, 3.5]]))), concave=0.1)
    outline = outline + box(0.71, 3.46, 3.5)
    space = space_in(outline, wall=0.046, floor=1.6, corner=0.25, mouth=0.664)
    shapes = filled(outline, space, level=2.5, rim=0.0215)
    return centred(vessel(shapes, sampling(detail), liquid=_WINE))


def _make_reed_diffuser(detail: float) -> list[ObjectPart]:
    """Six opaque reeds in a square bottle."""
    outline = region(
        filleted(
            (0, 0),
            (0.74, 0, 0.1),
            (0.74, 1.15, 0.2),
            (0.3, 1.32, 0.1),
            (0.27, 1.7),
            (0, 1.7),
        )
    )
    lip = rounded(box(0.34, 1.6, 1.7), convex=0.045)
    space = space_in(outline, wall=0.09, floor=0.16, corner=0.1, mouth=0.2)
    level = 0.82
    shapes = filled(outline + lip, space, level=level, rim=0.03)
    square = polygon(4, 0.25)
    cut = sampling(detail)
    turned = Turned(
        section_angles(square, cut), faded(square, lambda r, z: 1.0 - ramp(z, 1.05, 1.3))
    )
    sticks = bundle(6, waist=0.12, height=1.45, slope=0.22, radius=0.032)
    upper = [
        piece("reeds", _REED, stick, level + _OVER, 3.3 + 0.05 * (number % 3), detail)
        for number, stick in enumerate(sticks)
    ]
    lower = [piece("reed_ends", _REED, stick, 0.24, level - _UNDER, detail) for stick in sticks]
    parts = vessel(shapes, cut, liquid=_SCENT, turned=turned)
    return centred([*parts, united(upper), united(lower)])


def _make_flower_vase(detail: float) -> list[ObjectPart]:
    """Three opaque tulips in water."""
    side = smooth([(0.55, 0.1), (0.68, 0.5), (0.6, 1.05), (0.34, 1.5), (0.42, 1.95)])
    foot = filleted((0, 0), (0.5, 0, 0.06), (0.55, 0.1))
    outline = rounded(region(joined(foot, side, np.array([[0.0, 1.95]]))), convex=0.03)
    outline = outline + box(0.42, 1.9, 1.95)
    space = space_in(outline, wall=0.06, floor=0.14, corner=0.12, mouth=0.36)
    level = 1.1
    shapes = filled(outline, space, level=level, rim=0.027)
    parts = vessel(shapes, sampling(detail), liquid=_WATER)
    sticks = bundle(3, waist=0.13, height=1.6, slope=0.24, radius=0.042)
    lobed = waves(3, 0.14)
    turned = Turned(
        section_angles(lobed, sampling(detail, segments=48)),
        faded(lobed, lambda r, z: ramp(r, 0.05, 0.2)),
    )
    tops = (2.75, 3.0, 2.6)
    pairs = list(zip(sticks, tops, strict=True))
    heads = [
        along("flowers", _PETALS, _tulip(), stick, high + 0.015, detail, turned=turned)
        for stick, high in pairs
    ]
    upper = [piece("stems", _STEM, stick, level + _OVER, high, detail) for stick, high in pairs]
    lower = [piece("stem_ends", _STEM, stick, 0.24, level - _UNDER, detail) for stick in sticks]
    return centred([*parts, united(heads), united(upper), united(lower)])


def _tulip() -> Region:
    """Returns the section of a tulip: a cup of petals, closed at its bottom."""
    outer = smooth([(0.0, 0.0), (0.2, 0.1), (0.29, 0.3), (0.25, 0.55), (0.19, 0.72)])
    cup = region(joined(outer, np.array([[0.0, 0.72]])))
    inner = region(
        joined(
            smooth([(0.0, 0.2), (0.13, 0.28), (0.2, 0.42), (0.17, 0.6), (0.14, 0.8)]),
            np.array([[0.0, 0.8]]),
        )
    )
    return rounded(cup - inner, convex=0.024, concave=0.03)


OBJECTS = (
    Object("wine_glass", "mmncvx", _make_wine_glass),
    Object("reed_diffuser", "mmncvx", _make_reed_diffuser),
    Object("flower_vase", "mmncvx", _make_flower_vase),
)
