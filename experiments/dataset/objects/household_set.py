"""Four small vessels side by side: a drink, soap, honey, and a scent."""

from experiments.dataset.objects.placing import centred, enlarged, moved
from experiments.dataset.objects.profiles import Sampling, arc, filleted, sampling
from experiments.dataset.objects.regions import box, region, ring, rounded
from experiments.dataset.objects.revolve import Turned, faded, polygon, ramp, section_angles
from experiments.dataset.objects.sticks import Stick, piece
from experiments.dataset.objects.vessels import (
    Look,
    body,
    cap,
    filled,
    open_mouth,
    painted,
    rod,
    sealed,
    space_in,
    stopper,
    vessel,
)
from experiments.dataset.parts import Object, ObjectPart

_DRINK = Look("water", tint=(0.98, 0.86, 0.72))
_SOAP = Look("water", absorption=(1.5, 0.35, 0.2))
_HONEY = Look("alcohol", absorption=(0.12, 0.85, 3.0))
_SCENT = Look("perfume", tint=(0.93, 0.78, 0.97))
_STRAW = painted(0.7, 0.08, 0.06)
_WHITE = painted(0.8, 0.8, 0.78)
_CLEAR = Look("plastic")
_LID = painted(0.6, 0.36, 0.08)
_STOPPER = Look("glass", tint=(0.9, 0.84, 0.97))


def _tumbler(cut: Sampling, detail: float) -> list[ObjectPart]:
    """A drink with a straw that does not touch the glass."""
    outline = region(filleted((0, 0), (0.46, 0, 0.08), (0.58, 1.5), (0, 1.5)))
    mouth = open_mouth(outline, wall=0.05)
    space = space_in(outline, wall=0.05, floor=0.14, corner=0.08, mouth=mouth)
    level = 1.0
    straw = Stick((-0.08, 0.0, level), (0.16, 0.05, 1.0), 0.05)
    return [
        *vessel(filled(outline, space, level=level, rim=0.022), cut, liquid=_DRINK, name="drink"),
        piece("straw", _STRAW, straw, level + 0.04, 2.1, detail),
        piece("straw_end", _STRAW, straw, 0.24, level - 0.06, detail),
    ]


def _dispenser(cut: Sampling) -> list[ObjectPart]:
    """Liquid soap in a bottle of clear plastic under a pump."""
    outline = region(
        filleted(
            (0, 0),
            (0.46, 0, 0.1),
            (0.46, 1.35, 0.25),
            (0.18, 1.6, 0.06),
            (0.18, 1.85, 0.05),
            (0, 1.85),
        )
    )
    shapes = sealed(outline, space_in(outline, wall=0.05, corner=0.07), level=1.15)
    collar = cap(0.3, low=1.66, high=2.0, bore=0.23, ceiling=1.9, edge=0.03)
    pump = collar + rod(0.08, 1.95, 2.2, edge=0.03) + rounded(box(0.24, 2.16, 2.3), convex=0.05)
    parts = vessel(shapes, cut, liquid=_SOAP, glass=_CLEAR, name="soap")
    return [*parts, body("pump", _WHITE, rounded(pump, concave=0.05), cut)]


def _jar(cut: Sampling) -> list[ObjectPart]:
    """Honey in a hexagonal jar with a lid."""
    outline = region(
        filleted(
            (0, 0), (0.5, 0, 0.07), (0.5, 0.72, 0.1), (0.4, 0.85, 0.05), (0.4, 1.05), (0, 1.05)
        )
    )
    space = space_in(outline, wall=0.055, floor=0.1, corner=0.07, mouth=0.345)
    hexagon = polygon(6, 0.25)
    turned = Turned(
        section_angles(hexagon, cut), faded(hexagon, lambda r, z: 1.0 - ramp(z, 0.68, 0.86))
    )
    lid = cap(0.52, low=0.92, high=1.2, bore=0.435, ceiling=1.09, edge=0.03)
    shapes = filled(outline, space, level=0.72, rim=0.024, meniscus=0.04)
    parts = vessel(shapes, cut, liquid=_HONEY, turned=turned, name="honey")
    return [*parts, body("lid", _LID, lid, cut)]


def _flacon(cut: Sampling) -> list[ObjectPart]:
    """Scent in a globe with a glass stopper."""
    globe = region(arc((0.0, 0.42), 0.46, -90.0, 90.0))
    outline = rounded(globe - box(1.0, -1.0, 0.0), convex=0.06) + box(0.17, 0.5, 1.08)
    outline = rounded(outline, concave=0.1)
    space = space_in(outline, wall=0.055, floor=0.09, corner=0.05, mouth=0.115)
    lip = ring(0.18, 1.03, 0.1)
    shapes = filled(outline + lip, space, level=0.55, rim=0.024, meniscus=0.04)
    plug = stopper(0.075, low=0.86, high=1.2, head=0.14, rim=1.12)
    plug = rounded(plug + ring(0.001, 1.36, 0.4), concave=0.05)
    parts = vessel(shapes, cut, liquid=_SCENT, name="scent")
    return [*parts, body("stopper", _STOPPER, plug, cut)]


def _make_household_item_set(detail: float) -> list[ObjectPart]:
    cut = sampling(detail, segments=64)
    placed = [
        (_tumbler(cut, detail), (0.4, 0.66)),
        (_dispenser(cut), (-0.68, 0.42)),
        (_jar(cut), (-0.34, -0.72)),
        (_flacon(cut), (0.7, -0.55)),
    ]
    together = [part for parts, (x, y) in placed for part in moved(parts, (x, y, 0.0))]
    return enlarged(centred(together), 1.12)


OBJECTS = (Object("household_item_set", "mmncvx", _make_household_item_set),)
