"""Objects with flat faces: cube, pyramid, and a diamond of brilliant cut (NumPy only).

Vocabulary of a cut stone: the *table* is its flat top, the *crown* the part above the *girdle*, its
widest part, and the *pavilion* the part below, down to the *culet*. Angles are between the main
facets and the girdle's plane; shares are of the girdle's diameter.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
from jaxtyping import Float

from experiments.dataset.parts import Object, ObjectPart
from refref_jax.choices import CLEAR, Colour

GREEN: Colour = (0.72, 0.95, 0.80)
ROSE: Colour = (1.0, 0.74, 0.80)

CROWN_ANGLE, PAVILION_ANGLE = np.radians(34.5), np.radians(40.75)
"""Tolkowsky's angles for the brightest stone."""

TABLE, GIRDLE = 0.57, 0.03
"""Width of the table, and height of the girdle."""

# Reach of the stars, as a share of the way from the table's edge to the girdle; reach of the lower
# halves, as a share of the way from the girdle to the culet.
_STAR, _LOWER_HALF = 0.5, 0.77

_HALF_EDGE = 0.95
_BASE, _HEIGHT = 1.15, 1.75
_GIRDLE_RADIUS = 1.7


def cube(detail: float, *, tint: Colour = CLEAR) -> list[ObjectPart]:
    """A cube along the axes; the same for all levels of detail."""
    del detail
    corners = _HALF_EDGE * np.array(
        [[x, y, z] for z in (-1.0, 1.0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    )
    sides = [[i, (i + 1) % 4, 4 + (i + 1) % 4, 4 + i] for i in range(4)]
    return [_flat("body", "glass", corners, [[3, 2, 1, 0], [4, 5, 6, 7], *sides], tint)]


def pyramid(detail: float, *, tint: Colour = CLEAR) -> list[ObjectPart]:
    """A pyramid on a square; the same for all levels of detail."""
    del detail
    low = -0.5 * _HEIGHT
    base = [[x * _BASE, y * _BASE, low] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    corners = np.array([*base, [0.0, 0.0, -low]])
    sides = [[i, (i + 1) % 4, 4] for i in range(4)]
    return [_flat("body", "glass", corners, [[3, 2, 1, 0], *sides], tint)]


def diamond(detail: float) -> list[ObjectPart]:
    """A round brilliant of 57 facets and 16 more on its girdle, at all levels of detail."""
    del detail
    top, bottom = GIRDLE, -GIRDLE  # the girdle's diameter is 2, here
    star = np.cos(np.pi / 8.0) * TABLE
    star += _STAR * (1.0 - star)
    slopes = np.tan(CROWN_ANGLE), np.tan(PAVILION_ANGLE)
    # The tips of the stars and of the lower halves lie on the planes of the main facets, whose
    # corners on the girdle are at even multiples of a sixteenth of the circle.
    fall = np.cos(np.pi / 8.0)
    lower = 1.0 - _LOWER_HALF
    rings = [
        _ring(8, 0, TABLE, top + slopes[0] * (1.0 - TABLE)),
        _ring(8, 1, star, top + slopes[0] * (1.0 - star * fall)),
        _ring(16, 0, 1.0, top),
        _ring(16, 0, 1.0, bottom),
        _ring(8, 1, lower, bottom - slopes[1] * (1.0 - lower * fall)),
        np.array([[0.0, 0.0, bottom - slopes[1]]]),
    ]
    table, tip, upper, under, low, culet = np.cumsum([0] + [len(ring) for ring in rings[:-1]])
    facets = [list(range(table, tip))]
    for i in range(8):
        after, before = (i + 1) % 8, (i - 1) % 8
        here, half, there = 2 * i, 2 * i + 1, 2 * after
        facets += [
            [table + i, tip + i, table + after],
            [table + i, tip + before, upper + here, tip + i],
            [upper + here, upper + half, tip + i],
            [upper + half, upper + there, tip + i],
            [under + here, under + half, upper + half, upper + here],
            [under + half, under + there, upper + there, upper + half],
            [under + half, under + here, low + i],
            [under + there, under + half, low + i],
            [under + here, low + before, culet, low + i],
        ]
    corners = np.concatenate(rings)
    corners[:, 2] -= 0.5 * (corners[:, 2].max() + corners[:, 2].min())
    return [_flat("body", "diamond", _GIRDLE_RADIUS * corners, facets, CLEAR)]


def _ring(count: int, shift: int, radius: float, height: float) -> Float[np.ndarray, "count 3"]:
    """Returns points on a circle, shifted by sixteenths of it."""
    angle = 2.0 * np.pi * (np.arange(count) / count + shift / 16.0)
    return np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)], axis=-1
    )


def _flat(
    name: str,
    material: str,
    corners: Float[np.ndarray, "corners 3"],
    polygons: Sequence[Sequence[int]],
    tint: Colour,
) -> ObjectPart:
    """Makes a part from convex polygons, each a fan of triangles."""
    faces = [
        [polygon[0], polygon[i], polygon[i + 1]]
        for polygon in polygons
        for i in range(1, len(polygon) - 1)
    ]
    return ObjectPart(name, material, corners, np.array(faces, np.int64), smooth=False, tint=tint)


OBJECTS = (
    Object("cube", "smcvx", cube),
    Object("cube_coloured", "smcvx", partial(cube, tint=GREEN)),
    Object("pyramid", "smcvx", pyramid),
    Object("pyramid_coloured", "smcvx", partial(pyramid, tint=ROSE)),
    Object("diamond", "smcvx", diamond),
)
