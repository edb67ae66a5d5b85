"""Objects of clear glass only: jars with glass lids, a light bulb, a candlestick, a cut vase."""

import numpy as np

from experiments.dataset.objects.placing import centred, united
from experiments.dataset.objects.profiles import arc, filleted, joined, sampling, smooth
from experiments.dataset.objects.regions import box, region, ring, rounded
from experiments.dataset.objects.revolve import (
    Turned,
    Values,
    even_angles,
    faded,
    ramp,
    waves,
    within,
)
from experiments.dataset.objects.vessels import GLASS, Look, body, hollow, open_mouth, space_in
from experiments.dataset.parts import Object, ObjectPart

_PALE_GREEN = Look(tint=(0.95, 0.985, 0.96))
_ROSE = Look(tint=(0.98, 0.93, 0.95))


def _make_korken_jar(detail: float) -> list[ObjectPart]:
    """A preserving jar of 115 mm by 175 mm; its lid is raised by the height of a rubber ring."""
    cut = sampling(detail)
    outline = region(
        filleted(
            (0, 0),
            (1.0, 0, 0.16),
            (1.0, 2.28, 0.22),
            (0.8, 2.44, 0.08),
            (0.8, 2.78),
            (0, 2.78),
        )
    )
    space = space_in(outline, wall=0.075, floor=0.12, corner=0.14, mouth=0.725)
    flange = rounded(box(0.92, 2.6, 2.78), convex=0.05)
    lid = rounded(box(0.92, 2.83, 3.0) + box(0.67, 2.7, 3.0), convex=0.045, concave=0.04)
    # A groove around a dome.
    lid = lid - ring(0.66, 3.04, 0.22) + region(arc((0.0, 1.9), 1.2, 62.0, 90.0))
    lid = rounded(lid, convex=0.03, concave=0.06)
    parts = [
        body("body", GLASS, hollow(outline + flange, space, rim=0.03), cut),
        body("lid", GLASS, lid, cut),
    ]
    return centred([united(parts)])


def _make_vardagen_jar(detail: float) -> list[ObjectPart]:
    """A storage jar with a thick bottom, and a lid with a knob that extends into its mouth."""
    cut = sampling(detail)
    outline = region(
        filleted(
            (0, 0.05),
            (0.7, 0.05, 0.1),
            (0.8, 0.0, 0.04),
            (0.93, 0.0, 0.08),
            (0.97, 0.9, 0.6),
            (0.93, 2.4),
            (0, 2.4),
        )
    )
    mouth = open_mouth(outline, wall=0.08)
    space = space_in(outline, wall=0.08, floor=0.2, corner=0.12, mouth=mouth)
    lid = box(0.99, 2.44, 2.56) + box(mouth - 0.05, 2.3, 2.5)
    lid = rounded(lid, convex=0.045, concave=0.04) + box(0.12, 2.5, 2.75)
    lid = rounded(lid + ring(0.0001, 2.86, 0.5), concave=0.08)
    parts = [
        body("body", _PALE_GREEN, hollow(outline, space, rim=0.036), cut),
        body("lid", _PALE_GREEN, lid, cut),
    ]
    return centred([united(parts)])


def _make_light_bulb(detail: float) -> list[ObjectPart]:
    """A bulb of 60 mm by 110 mm, all of it glass: a shell with a cavity and a mount inside.

    Like a real bulb it is closed. Outer surface and cavity are one part; the faces of the cavity
    point into the cavity, and thus out of the glass.
    """
    globe = region(arc((0.0, 2.5), 1.05, -90.0, 90.0))
    neck = filleted(
        (0, 0.85), (0.46, 0.85), (0.5, 1.2, 0.3), (0.72, 1.75, 0.5), (0.9, 2.3), (0, 2.3)
    )
    glass = rounded(globe + region(neck), concave=0.8)
    space = space_in(glass + box(0.46, 0.6, 1.0), wall=0.06, floor=0.95, corner=0.1)
    flare = filleted(
        (0, 0.6),
        (0.3, 0.6),
        (0.3, 1.0, 0.1),
        (0.1, 1.3, 0.2),
        (0.1, 1.95, 0.04),
        (0.2, 2.05, 0.05),
        (0.2, 2.12, 0.05),
        (0, 2.16),
    )
    space = rounded(space - region(flare), convex=0.03, concave=0.05)
    screw = box(0.43, 0.22, 0.9)
    for height in np.arange(0.3, 0.86, 0.13):
        screw = screw + ring(0.42, float(height), 0.09)
    contact = region(filleted((0, 0), (0.14, 0), (0.42, 0.24), (0.42, 0.3), (0, 0.3)))
    foot = rounded(screw + contact, convex=0.035, concave=0.035)
    shape = rounded(glass + foot, concave=0.04) - space
    return centred([body("body", GLASS, shape, sampling(detail))])


def _make_candle_holder(detail: float) -> list[ObjectPart]:
    """A turned candlestick of solid glass, with a socket for a taper."""
    outline = region(
        filleted(
            (0, 0.06),
            (0.75, 0.06, 0.1),
            (0.82, 0.0, 0.04),
            (0.95, 0.0, 0.06),
            (0.95, 0.14, 0.06),
            (0.55, 0.26, 0.14),
            (0.2, 0.55, 0.25),
            (0.16, 0.95, 0.1),
            (0.3, 1.02, 0.06),
            (0.3, 1.12, 0.06),
            (0.15, 1.2, 0.08),
            (0.24, 2.2, 0.2),
            (0.13, 2.45, 0.08),
            (0.3, 2.6, 0.12),
            (0.36, 2.72, 0.1),
            (0.72, 2.84, 0.04),
            (0.72, 2.92, 0.038),
            (0.4, 2.9, 0.1),
            (0.35, 3.35, 0.1),
            (0.38, 3.42),
            (0, 3.42),
        )
    )
    socket = box(0.22, 2.95, 4.0)
    knob = region(arc((0.0, 1.45), 0.3, -90.0, 90.0))
    shape = rounded((outline + knob) - rounded(socket, convex=0.05), convex=0.03, concave=0.06)
    cut = sampling(detail)
    return centred([body("body", _ROSE, shape, cut)])


def _make_crystal_vase(detail: float) -> list[ObjectPart]:
    """A thick vase with cuts that wind around it; round inside, at its foot and at its rim."""
    cut = sampling(detail)
    side = smooth([(0.66, 0.12), (0.6, 0.5), (0.66, 1.3), (0.82, 2.2), (1.0, 3.1)])
    foot = filleted((0, 0.04), (0.5, 0.04, 0.1), (0.56, 0.0, 0.03), (0.68, 0.0, 0.06), (0.66, 0.12))
    outline = rounded(region(joined(foot, side, np.array([[0.0, 3.1]]))), convex=0.03)
    outline = outline + box(1.0, 3.06, 3.1)
    space = space_in(outline, wall=0.15, floor=0.5, corner=0.2, mouth=0.85)
    shape = hollow(outline, space, rim=0.06)

    def share(r: Values, z: Values) -> Values:
        outer = np.interp(z, side[:, 1], side[:, 0])
        return ramp(r / outer, 0.86, 0.97) * within(z, 0.12, 2.9, soft=0.3)

    cuts = waves(14, 0.11, sharpness=0.2)
    turned = Turned(even_angles(cut, lobes=14, each=16), faded(cuts, share), twist=0.32)
    return centred([body("body", GLASS, shape, cut, turned=turned)])


OBJECTS = (
    Object("korken_jar", "smncvx", _make_korken_jar),
    Object("vardagen_jar", "smncvx", _make_vardagen_jar),
    Object("light_bulb", "smncvx", _make_light_bulb),
    Object("candle_holder", "smncvx", _make_candle_holder),
    Object("crystal_vase", "smncvx", _make_crystal_vase),
)
