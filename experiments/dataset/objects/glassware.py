"""Shapes of laboratory glass, as regions, from the bottom at height 0 upwards (NumPy only).

Proportions are those of borosilicate glass in catalogues; the walls of small vessels are thicker
than real ones, since edges must be visibly rounded.
"""

import numpy as np

from experiments.dataset.objects.profiles import arc, filleted, joined
from experiments.dataset.objects.regions import Region, box, region, ring, rounded
from experiments.dataset.objects.revolve import Values, Warp, polygon, ramp
from experiments.dataset.objects.vessels import FILM, Filled, filled, open_mouth, space_in

MARK_SPACING = 0.3
"""Distance between the rings on a graduated cylinder, world units."""


def beaker(*, level: float, wall: float = 0.052, film: float = FILM) -> Filled:
    """Returns a low beaker, 2.72 high, like the 250 ml Griffin beaker: 70 mm wide, 95 mm high."""
    outline = region(filleted((0, 0), (1.0, 0, 0.16), (1.0, 2.5, 0.3), (1.09, 2.72), (0, 2.72)))
    space = space_in(outline, wall=wall, corner=0.12, mouth=open_mouth(outline, wall=wall))
    return filled(outline, space, level=level, rim=0.45 * wall, film=film)


def conical_flask(*, level: float, wall: float = 0.052, film: float = FILM) -> Filled:
    """Returns an Erlenmeyer flask, 3.2 high, like that of 250 ml: 85 mm wide, 145 mm high."""
    outline = region(filleted((0, 0), (1.02, 0, 0.14), (0.35, 2.3, 0.4), (0.35, 3.2), (0, 3.2)))
    return _beaded(outline, 0.4, level, wall, film)


def round_bottom_flask(*, level: float, wall: float = 0.052, film: float = FILM) -> Filled:
    """Returns a round-bottom flask, 3.4 high, like that of 250 ml: 85 mm wide, 140 mm high."""
    globe = region(arc((0.0, 1.08), 1.08, -90.0, 90.0))
    outline = rounded(globe + box(0.34, 1.5, 3.4), concave=0.22)
    return _beaded(outline, 0.39, level, wall, film)


def test_tube(*, level: float, wall: float = 0.05, film: float = FILM) -> Filled:
    """Returns a test tube, 3.6 high, like that of 30 mm by 150 mm."""
    outline = region(
        joined(arc((0.0, 0.36), 0.36, -90.0, 0.0), filleted((0.36, 0.36), (0.36, 3.6), (0, 3.6)))
    )
    return _beaded(outline, 0.4, level, wall, film)


def graduated_cylinder(*, level: float, wall: float = 0.05, film: float = FILM) -> Filled:
    """Returns a graduated cylinder, 3.6 high, with raised rings; see `hexagonal_foot`."""
    outline = region(
        filleted(
            (0, 0),
            (0.7, 0, 0.05),
            (0.7, 0.16, 0.06),
            (0.42, 0.24, 0.1),
            (0.34, 0.42, 0.12),
            (0.34, 3.46, 0.2),
            (0.40, 3.6),
            (0, 3.6),
        )
    )
    mouth = open_mouth(outline, wall=wall)
    space = space_in(outline, wall=wall, floor=0.36, corner=0.12, mouth=mouth)
    for height in np.arange(0.9, 3.2, MARK_SPACING):
        outline = outline + ring(0.332, float(height), 0.06)
    return filled(outline, space, level=level, rim=0.45 * wall, film=film)


def hexagonal_foot(angle: Values, r: Values, z: Values) -> Values:
    """Warps the foot of a graduated cylinder to a hexagon, and its lip to a spout."""
    share = 1.0 - ramp(z, 0.16, 0.40)
    foot = 1.0 + share * ramp(r, 0.2, 0.6) * (polygon(6, 0.2)(angle) - 1.0)
    return spout(3.2, 3.6, reach=0.28, width=0.45)(angle, r, z) * foot


def spout(low: float, high: float, *, reach: float, width: float) -> Warp:
    """Returns the warp that draws a lip out to a spout at angle 0.

    Args:
      low: height where the spout begins.
      high: height of the lip.
      reach: distance by which the lip is drawn out, as a share of the radius.
      width: width of the spout, in radians; next to it the lip is drawn in a little.
    """

    def warp(angle: Values, r: Values, z: Values) -> Values:
        off = (np.mod(angle + np.pi, 2.0 * np.pi) - np.pi) / width
        drawn = (1.0 - 0.35 * off**2) * np.exp(-(off**2))
        return r * (1.0 + reach * ramp(z, low, 2.0 * high - low) * 2.0 * drawn)

    return warp


def _beaded(outline: Region, bead: float, level: float, wall: float, film: float) -> Filled:
    """Returns a vessel whose mouth is as wide as its neck, with a bead around its rim."""
    mouth = open_mouth(outline, wall=wall)
    height = outline.bounds()[3]
    space = space_in(outline, wall=wall, corner=0.1, mouth=mouth)
    outer = mouth + wall
    lip = rounded(box(bead, height - 2.2 * (bead - outer), height), convex=0.9 * (bead - outer))
    return filled(outline + lip, space, level=level, rim=0.45 * wall, film=film)
