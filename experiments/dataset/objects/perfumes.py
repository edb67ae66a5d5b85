"""Perfume bottles: thick glass, a coloured liquid under air, and an opaque cap."""

from experiments.dataset.objects.placing import centred
from experiments.dataset.objects.profiles import Sampling, filleted, sampling
from experiments.dataset.objects.regions import Region, box, region
from experiments.dataset.objects.revolve import (
    Section,
    Turned,
    faded,
    polygon,
    ramp,
    section_angles,
    stretched,
)
from experiments.dataset.objects.vessels import Look, body, cap, painted, sealed, space_in, vessel
from experiments.dataset.parts import Object, ObjectPart

_RED = Look("perfume", absorption=(0.12, 1.9, 1.5))
_YELLOW = Look("perfume", absorption=(0.04, 0.28, 1.7))
_BLACK = painted(0.03, 0.03, 0.035)
_GOLD = painted(0.72, 0.46, 0.13)


def _make_perfume_red(detail: float) -> list[ObjectPart]:
    """A cube with a black square cap."""
    outline = region(
        filleted(
            (0, 0),
            (0.92, 0, 0.09),
            (0.92, 1.95, 0.12),
            (0.36, 2.05, 0.05),
            (0.36, 2.45, 0.05),
            (0, 2.45),
        )
    )
    cut = sampling(detail)
    square = polygon(4, 0.16)
    turned = Turned(section_angles(square, cut), faded(square, lambda r, z: ramp(r, 0.36, 0.7)))
    shapes = sealed(outline, _thick(outline, 1.95, 0.17, 0.34), level=1.35, film=0.02)
    lid = cap(0.56, low=2.12, high=2.95, bore=0.42, ceiling=2.52, edge=0.05)
    parts = vessel(shapes, cut, liquid=_RED, turned=turned)
    return centred([*parts, _cap(lid, _BLACK, polygon(4, 0.2), cut)])


def _make_perfume_yellow(detail: float) -> list[ObjectPart]:
    """A flat, tall block with sloping shoulders and a golden cap of twelve sides."""
    outline = region(
        filleted(
            (0, 0),
            (0.98, 0, 0.1),
            (0.98, 1.75, 0.25),
            (0.34, 2.2, 0.07),
            (0.34, 2.6, 0.06),
            (0, 2.6),
        )
    )
    cut = sampling(detail)
    block = stretched(polygon(4, 0.2), 0.62)
    # It narrows the bottle, so that a blend along the radius would fold the bottom.
    turned = Turned(
        section_angles(block, cut), faded(block, lambda r, z: 1.0 - ramp(z, 1.45, 2.25))
    )
    shapes = sealed(outline, _thick(outline, 2.2, 0.2, 0.36), level=1.5, film=0.026)
    lid = cap(0.53, low=2.3, high=3.1, bore=0.4, ceiling=2.67, edge=0.05)
    parts = vessel(shapes, cut, liquid=_YELLOW, turned=turned)
    return centred([*parts, _cap(lid, _GOLD, polygon(12, 0.4), cut)])


def _thick(outline: Region, shoulder: float, wall: float, floor: float) -> Region:
    """Returns the space in a bottle with a solid neck."""
    return space_in(outline - box(1.0, shoulder, 9.0), wall=wall, floor=floor, corner=0.1)


def _cap(shape: Region, look: Look, section: Section, cut: Sampling) -> ObjectPart:
    """Returns a cap with its own outer section, and a round bore."""
    fitted = faded(section, lambda r, z: ramp(r, 0.42, 0.5))
    return body("cap", look, shape, cut, turned=Turned(section_angles(section, cut), fitted))


OBJECTS = (
    Object("perfume_red", "mmncvx", _make_perfume_red),
    Object("perfume_yellow", "mmncvx", _make_perfume_yellow),
)
