"""Boolean operations on cross-sections of turned objects (Clipper2, through manifold3d).

A *region* is the section of an object through its axis, both halves of it. Walls are made by
shrinking a region by their thickness, cavities are subtracted, and edges are rounded by rolling a
disc along them. The results are exact, except that arcs become polygons, and free of
self-intersections.
"""

from typing import TypeAlias

import numpy as np
from manifold3d import CrossSection, FillRule, JoinType

from experiments.dataset.objects.profiles import Curve

Region: TypeAlias = CrossSection

# Wider and higher than any object.
_FAR = 10.0

# Number of corners of a full circle that rounds a corner of a region. Even, for symmetric halves.
_CIRCLE = 240

# Tolerance of Clipper, world units: points closer than this to the line through their neighbours
# are noise, and so are smaller distances from the axis.
_NOISE = 1e-6


def region(profile: Curve) -> Region:
    """Returns the section of the object bounded by a profile, from the axis to the axis."""
    ring = np.concatenate([profile, (profile * [-1.0, 1.0])[::-1]])
    return CrossSection([ring], FillRule.NonZero)


def ring(radius: float, height: float, thickness: float) -> Region:
    """Returns the section of a round ring, given its distance from the axis and height."""
    disc = CrossSection.circle(0.5 * thickness, _CIRCLE)
    return disc.translate((radius, height)) + disc.translate((-radius, height))


def box(radius: float, low: float, high: float) -> Region:
    """Returns the section of a cylinder between two heights."""
    square = CrossSection.square((2.0 * radius, high - low))
    return square.translate((-radius, low))


def below(shape: Region, height: float) -> Region:
    """Returns the part of a region below a height."""
    return shape ^ box(_FAR, -_FAR, height)


def above(shape: Region, height: float) -> Region:
    """Returns the part of a region above a height."""
    return shape ^ box(_FAR, height, _FAR)


def offset(shape: Region, distance: float) -> Region:
    """Returns the points within a distance of a region, rounded at convex corners.

    With a negative distance, the points of the region at least that far from its boundary.
    """
    if distance == 0.0:
        return shape
    grown = shape.offset(distance, JoinType.Round, circular_segments=_CIRCLE)
    return grown.simplify(_NOISE)


def rounded(shape: Region, *, convex: float = 0.0, concave: float = 0.0) -> Region:
    """Returns a region whose edges have at least these radii.

    Parts thinner than twice the convex radius disappear, and gaps thinner than twice the concave
    one are filled.
    """
    opened = offset(offset(shape, -convex), convex) if convex else shape
    return offset(offset(opened, concave), -concave) if concave else opened


def top(shape: Region) -> tuple[float, float]:
    """Returns the radius and height of the top end of a region."""
    height = shape.bounds()[3]
    return above(shape, height - 100.0 * _NOISE).bounds()[2], height


def profiles(shape: Region) -> list[Curve]:
    """Returns the profiles of a region's boundary: outer ones and those of cavities."""
    half = shape ^ CrossSection.square((_FAR, 2.0 * _FAR)).translate((0.0, -_FAR))
    found = []
    for polygon in half.to_polygons():
        found += _chains(np.asarray(polygon, np.float64))
    # Clipper does not guarantee an order of polygons.
    return sorted(found, key=lambda curve: (-float(np.max(curve[:, 0])), tuple(curve[0])))


def _chains(polygon: Curve) -> list[Curve]:
    """Returns the pieces of a polygon between its edges on the axis, or the closed polygon."""
    on_axis = np.abs(polygon[:, 0]) < _NOISE
    polygon = np.where(on_axis[:, None], polygon * [0.0, 1.0], polygon)
    axial = on_axis & np.roll(on_axis, -1)
    if not axial.any():
        first = int(np.lexsort(polygon.T)[0])
        turned = np.roll(polygon, -first, axis=0)
        return [np.concatenate([turned, turned[:1]])]
    first = int(np.flatnonzero(axial)[0]) + 1
    turned, axial = np.roll(polygon, -first, axis=0), np.roll(axial, -first)
    ends = np.flatnonzero(axial)
    starts = np.concatenate([[0], ends[:-1] + 1])
    return [turned[a : b + 1] for a, b in zip(starts, ends, strict=True) if b > a]
