"""Vessels and their contents, as regions in the half plane, and the resulting parts.

An *outline* is a vessel's outer shape as if it were solid, the *space* its capacity. An open vessel
is one piece of glass whose space is filled with liquid, which a thin *film* of glass covers. A
sealed vessel is solid glass except for the liquid and the air in it, with a film between the two.
So any two surfaces are nested or apart, and refraction is as in the real object.
"""

from typing import NamedTuple

import numpy as np

from experiments.dataset.objects.placing import merged
from experiments.dataset.objects.profiles import Sampling, resampled
from experiments.dataset.objects.regions import (
    Region,
    above,
    below,
    box,
    offset,
    profiles,
    rounded,
    top,
)
from experiments.dataset.objects.revolve import Turned, revolve, round_about
from experiments.dataset.parts import ObjectPart
from refref_jax.choices import CLEAR, NO_ABSORPTION, Colour

FILM = 0.016
"""Thickness of the glass between a liquid and the air over it, world units."""

# Length by which a space extends beyond the mouth.
_BEYOND = 1.0

# Narrower pieces are artefacts of cutting regions.
_SLIVER = 0.005


class Look(NamedTuple):
    """Material of a part, and its colour.

    Attributes:
      material: material inside the surface.
      tint: tint of the surface; see `ObjectPart`.
      absorption: absorption of the medium; see `ObjectPart`.
    """

    material: str = "glass"
    tint: Colour = CLEAR
    absorption: Colour = NO_ABSORPTION


GLASS = Look()
AIR = Look("air")


class Filled(NamedTuple):
    """Regions of a vessel with a liquid.

    Attributes:
      glass: region of the vessel.
      liquid: region of the liquid, strictly inside the glass.
      air: cavity over the liquid; only in a sealed vessel.
    """

    glass: Region
    liquid: Region
    air: Region | None = None


def space_in(
    outline: Region,
    *,
    wall: float,
    floor: float | None = None,
    corner: float = 0.06,
    mouth: float | None = None,
) -> Region:
    """Returns the space in a vessel.

    Args:
      outline: outline of the vessel.
      wall: least thickness of the wall.
      floor: height of the space's bottom; by default it follows the outline.
      corner: radius to which the space's edges are rounded.
      mouth: inner radius of the opening at the top, where the space continues; closed if not given.
    """
    if mouth is not None:
        height = top(outline)[1]
        outline = outline + box(mouth + wall, height - wall, height + _BEYOND)
    inner = offset(outline, -wall)
    return rounded(inner if floor is None else above(inner, floor), convex=corner)


def open_mouth(outline: Region, *, wall: float) -> float:
    """Returns the inner radius of an opening as wide as the outline's top end."""
    return top(outline)[0] - wall


def hollow(outline: Region, space: Region, *, rim: float, inner: float = 0.05) -> Region:
    """Returns an empty vessel.

    Args:
      outline: outline of the vessel.
      space: space inside; open if it extends beyond the outline.
      rim: radius to which the edges are rounded; less than half of the thinnest wall.
      inner: radius to which the corners are filled.
    """
    return rounded(outline - space, convex=rim, concave=inner)


def filled(
    outline: Region,
    space: Region,
    *,
    level: float,
    rim: float,
    film: float = FILM,
    meniscus: float = 0.06,
) -> Filled:
    """Returns an open vessel with a liquid up to a height, with a meniscus at the wall.

    Args:
      outline: outline of the vessel.
      space: space inside.
      level: height of the liquid's visible surface.
      rim: radius to which the glass's edges are rounded; less than half of the thinnest wall.
      film: thickness of the glass over the liquid.
      meniscus: radius at which the surface bends up to the wall.
    """
    glass = hollow(outline, above(space, level), rim=rim, inner=meniscus)
    liquid = offset(glass, -film) ^ below(space, level + meniscus)
    return Filled(glass, rounded(liquid, convex=1.25 * film, concave=0.03))


def sealed(
    outline: Region, space: Region, *, level: float, film: float = FILM, meniscus: float = 0.06
) -> Filled:
    """Returns a closed vessel with a liquid up to a height, and air over it; see `filled`."""
    air = rounded(above(space, level + 0.5 * film), convex=meniscus)
    liquid = below(space, level + meniscus) - offset(air, film)
    return Filled(outline, rounded(liquid, convex=1.25 * film, concave=0.03), air)


def rod(radius: float, low: float, high: float, *, edge: float | None = None) -> Region:
    """Returns an upright rod with rounded ends; `edge` is the radius of its edges."""
    return rounded(box(radius, low, high), convex=0.6 * radius if edge is None else edge)


def stopper(
    neck: float, *, low: float, high: float, head: float, rim: float, edge: float = 0.03
) -> Region:
    """Returns a stopper: a plug of one radius up to the rim's height, and a wider head above."""
    return rounded(box(neck, low, rim + edge) + box(head, rim, high), convex=edge, concave=edge)


def cap(
    radius: float, *, low: float, high: float, bore: float, ceiling: float, edge: float = 0.03
) -> Region:
    """Returns a cap over a neck: a cylinder with a bore from below up to a ceiling."""
    return rounded(
        box(radius, low, high) - box(bore, low - 1.0, ceiling), convex=edge, concave=edge
    )


def body(
    name: str,
    look: Look,
    shape: Region,
    cut: Sampling,
    *,
    turned: Turned | None = None,
) -> ObjectPart:
    """Returns the part that results from revolving a region around the axis."""
    turned = round_about(cut) if turned is None else turned
    pieces = [
        revolve(resampled(profile, cut), turned)
        for profile in profiles(shape)
        if np.max(np.ptp(profile, axis=0)) > _SLIVER
    ]
    vertices, faces = merged(pieces)
    return ObjectPart(
        name, look.material, vertices, faces, tint=look.tint, absorption=look.absorption
    )


def vessel(
    shapes: Filled,
    cut: Sampling,
    *,
    liquid: Look,
    glass: Look = GLASS,
    turned: Turned | None = None,
    name: str = "",
) -> list[ObjectPart]:
    """Returns the parts of a vessel with a liquid: `shell`, `liquid`, and `air` if it is sealed.

    Args:
      shapes: regions of glass, liquid and air.
      cut: sampling of the curves.
      liquid: material of the liquid.
      glass: material of the vessel.
      turned: rotation around the vessel's axis; round by default.
      name: name of the vessel if the object has several; prefix of the parts' names.
    """
    prefix = f"{name}_" if name else ""
    parts = [
        body(f"{prefix}shell", glass, shapes.glass, cut, turned=turned),
        body(f"{prefix}liquid", liquid, shapes.liquid, cut, turned=turned),
    ]
    if shapes.air is not None:
        parts.append(body(f"{prefix}air", AIR, shapes.air, cut, turned=turned))
    return parts


def resized(shapes: Filled, factor: float) -> Filled:
    """Returns a scaled vessel, including its walls and films."""
    glass, liquid, air = (None if each is None else each.scale((factor, factor)) for each in shapes)
    return Filled(glass, liquid, air)
