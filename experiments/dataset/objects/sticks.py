"""Straight rods in a liquid: one piece in it, and one above.

A rod must not intersect the surface of a liquid, since its own surface would then lie in two media.
Therefore its lower piece ends below the liquid's surface, and its upper piece continues above it
along the same line.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from experiments.dataset.objects.profiles import sampling
from experiments.dataset.objects.regions import Region
from experiments.dataset.objects.vessels import Look, body, rod
from experiments.dataset.parts import ObjectPart


class Stick(NamedTuple):
    """A straight line with a thickness.

    Attributes:
      origin: point on the line, in world units.
      way: direction of the stick, with a positive upward component.
      radius: radius of the stick.
    """

    origin: tuple[float, float, float]
    way: tuple[float, float, float]
    radius: float


def bundle(count: int, *, waist: float, height: float, slope: float, radius: float) -> list[Stick]:
    """Returns sticks that lean in all directions, closest to each other at a height.

    Args:
      count: number of sticks.
      waist: distance of each stick from the axis where they are closest.
      height: height of the waist.
      slope: sideways per upwards; it varies slightly between sticks, as if placed by hand.
      radius: radius of each stick.
    """
    sticks = []
    for number in range(count):
        angle = 2.0 * np.pi * number / count
        lean = slope * (1.0 + 0.12 * np.sin(2.4 * number + 0.5))
        origin = (waist * np.cos(angle), waist * np.sin(angle), height)
        sticks.append(Stick(origin, (-lean * np.sin(angle), lean * np.cos(angle), 1.0), radius))
    return sticks


def piece(
    name: str, look: Look, stick: Stick, low: float, high: float, detail: float
) -> ObjectPart:
    """Returns the piece of a stick between two heights, measured along its axis."""
    way = np.asarray(stick.way)
    stretch = float(np.linalg.norm(way) / way[2])
    shape = rod(stick.radius, 0.0, (high - low) * stretch)
    return along(name, look, shape, stick, low, detail)


def along(
    name: str, look: Look, shape: Region, stick: Stick, low: float, detail: float, **turned
) -> ObjectPart:
    """Returns a part whose axis, from height 0, is moved to a stick from a given height."""
    part = body(name, look, shape, sampling(detail, segments=32), **turned)
    start = np.asarray(stick.origin) + (low - stick.origin[2]) / stick.way[2] * np.asarray(
        stick.way
    )
    return part._replace(vertices=part.vertices @ _frame(np.asarray(stick.way)).T + start)


def _frame(way: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation that takes the z axis to a direction, without a twist around it."""
    z = way / np.linalg.norm(way)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
