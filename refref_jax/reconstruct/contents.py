"""What is inside a vessel, its parts and media, and where its unknowns are in a vector.

Source: ours.
"""

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple

from refref_jax.choices import CLEAR, NO_ABSORPTION, Colour
from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.optics.media import INDEX_OF_AIR, Interfaces

GLASS_DEVIATION = 0.03
"""Standard deviation of the index of glass, which is nearly known."""

Contents = Literal["none", "air", "liquid", "liquid and air"]
"""What is inside the glass; `none` is solid glass."""


class Detail(NamedTuple):
    """Resolution of the meshes of a vessel.

    Attributes:
      outer: points along the outer wall.
      ridges: points that are added there if the wall has narrow ridges (`Revolution.knots`).
      inner: points along the inner wall, all of its pieces together.
      azimuths: number of half-planes.
      fine: whether ridges have knots of their own, and offsets of a relief are unknowns.
    """

    outer: int = 112
    ridges: int = 128
    inner: int = 124
    azimuths: int = 96
    fine: bool = True


FINE = Detail()
"""Enough for photographs of 200 x 200 pixels."""

COARSE = Detail(outer=72, ridges=0, inner=80, azimuths=64, fine=False)
"""Enough for a look through a blurred backdrop."""


@dataclasses.dataclass(frozen=True)
class Interior:
    """What is inside a vessel, and of what it is made.

    Attributes:
      contents: kind of the contents.
      mouth: whether the vessel is open.
      wall: distance of the inner from the outer wall at rest, world units.
      base: least height of the inside above the lowest point of the axis, at rest, world units.
      punt: height of the hollow under the bottom at rest, world units.
      lid: least depth of the inside below the highest point of the axis, likewise.
      level: height of the liquid's surface above the point of the axis, world units.
      gap: height of the glass between liquid and air, world units.
      glass: index of refraction of the glass.
      glass_deviation: standard deviation of its prior; 0 keeps it.
      liquid: the same of the liquid.
      tint: factor on light at each crossing of the liquid's surface, linear RGB.
      absorption: absorption of the liquid, linear RGB, per world unit.
      glass_tint: the same as `tint` of the glass.
      stained: whether the tint of the glass is unknown.
    """

    contents: Contents = "liquid and air"
    mouth: bool = False
    wall: float = 0.1
    base: float = 0.0
    punt: float = 0.0
    lid: float = 0.0
    level: float = 0.0
    gap: float = 0.01
    glass: float = 1.5
    glass_deviation: float = GLASS_DEVIATION
    liquid: float = 1.36
    tint: Colour = (1.0, 1.0, 1.0)
    absorption: Colour = (0.0, 0.0, 0.0)
    glass_tint: Colour = (1.0, 1.0, 1.0)
    stained: bool = False

    @property
    def filled(self) -> bool:
        """Whether there is liquid."""
        return self.contents in ("liquid", "liquid and air")

    @property
    def name(self) -> str:
        """What is inside, in words."""
        return self.contents + ", open" * self.mouth + ", stained" * self.stained

    @property
    def materials(self) -> list[str]:
        """Material of each part, the glass first."""
        air = self.contents in ("air", "liquid and air") and not self.mouth
        return ["glass", *(["liquid"] if self.filled else []), *(["air"] if air else [])]

    @property
    def level_unknown(self) -> bool:
        """Whether the liquid has a surface."""
        return self.contents == "liquid and air"


class Layout:
    """Where the unknowns of a vessel are; slices, empty for what it does not have."""

    def __init__(
        self, interior: Interior, outer: int, inner: int, *, axis: int = 4, relief: int = 0
    ) -> None:
        """Counts the unknowns."""
        self.axis, self.outer = slice(0, axis), slice(axis, axis + outer)
        at = axis + outer

        def take(count: int) -> slice:
            nonlocal at
            at += count
            return slice(at - count, at)

        self.inner = take(inner if interior.contents != "none" else 0)
        self.level, self.gap = take(interior.level_unknown), take(interior.level_unknown)
        self.profile = at - axis
        self.glass, self.liquid = take(1), take(interior.filled)
        self.tint, self.absorption = take(3 * interior.filled), take(3 * interior.filled)
        self.glass_tint = take(3 * interior.stained)
        self.relief = take(relief)
        self.count = at

    def names(self) -> list[str]:
        """Returns a name for each unknown."""
        found = [""] * self.count
        for name, each in vars(self).items():
            if isinstance(each, slice):
                for number in range(each.start, each.stop):
                    found[number] = name
        return found


@dataclasses.dataclass(frozen=True)
class Solid:
    """A part of a scene.

    Attributes:
      name: name of its material.
      mesh: its surface.
      index: index of refraction inside.
      parent: part that contains it, or `NO_PARENT`.
      tint: factor on light at each crossing of its surface, linear RGB.
      absorption: absorption inside, linear RGB, per world unit.
      radiance: linear RGB radiance of an opaque part, `None` for a clear one.
    """

    name: str
    mesh: Mesh
    index: float
    parent: int
    tint: Colour
    absorption: Colour = NO_ABSORPTION
    radiance: Colour | None = None


@dataclasses.dataclass(frozen=True)
class Medium:
    """A material of a vessel, and where its unknowns are.

    Attributes:
      index: index of refraction.
      tint: factor on light at each crossing of its surface, linear RGB.
      absorption: absorption inside, linear RGB, per world unit.
      index_at: place of the index in the unknowns; empty if it is fixed.
      tint_at: the same of the logarithm of the tint.
      absorption_at: the same of the absorption.
    """

    index: float
    tint: Colour
    absorption: Colour
    index_at: slice
    tint_at: slice
    absorption_at: slice


def media_of(now: Interior, at: Layout) -> list[Medium]:
    """Returns the medium of each part of a vessel."""
    fixed, clear = slice(0), NO_ABSORPTION
    media = {
        "glass": Medium(now.glass, now.glass_tint, clear, at.glass, at.glass_tint, fixed),
        "liquid": Medium(now.liquid, now.tint, now.absorption, at.liquid, at.tint, at.absorption),
        "air": Medium(INDEX_OF_AIR, CLEAR, clear, fixed, fixed, fixed),
    }
    return [media[name] for name in now.materials]


def interfaces_of(media: Sequence[Medium]) -> Interfaces:
    """Returns the interfaces of parts of these media, all of which are in the first one."""
    return nested(
        [medium.index for medium in media],
        [NO_PARENT] + [0] * (len(media) - 1),
        tints=[medium.tint for medium in media],
        absorptions=[medium.absorption for medium in media],
    )
