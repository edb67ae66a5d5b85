"""A furnished room with a table, made of textured rectangles (NumPy only).

The object stands on the table; behind it are things at many distances: books on the table, shelves,
crates and pictures before the walls, and the walls. The floor is that of +z up, world units. Light
comes from a roof of glass and from a window.

Each rectangle is `corner + u * along + v * up` with `u` and `v` from 0 to 1; `u` is the column of
its image from the left, `v` its row from the bottom.
"""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from experiments.dataset.textures import fields
from experiments.dataset.textures.faces import make_face
from refref_jax.choices import Colour
from refref_jax.data import image_files

FLOOR, CEILING = -3.0, 5.6
"""Heights of the floor and of the ceiling above the table's top, world units."""

LIGHT_TEXELS = 4.0
"""Texels per world unit of the light that is baked on walls and furniture."""

TABLE_TEXELS = 16.0
"""The same for the top of the table, which has the shadow of the object."""

# Gap between the table and the object, which touches nothing.
_GAP = 2e-3

# Standard deviation of the smoothing of baked light, texels.
_SOFT = 0.8

# Samples a side of the pictures that textures repeat.
_PICTURE = 512

# Texels per world unit of the images on surfaces near the cameras and on distant ones; most texels.
_NEAR_TEXELS, _FAR_TEXELS, _MOST_TEXELS = 120.0, 72.0, 1400

# Light of the roof and the window; only their ratio and colours matter.
_LAMP: Colour = (1.0, 0.97, 0.9)
_DAYLIGHT: Colour = (1.0, 1.1, 1.25)

_X, _Y, _Z = np.eye(3)


class Look(NamedTuple):
    """What covers a rectangle.

    Attributes:
      image: name of an image of `textures.faces.FACES`, or `None` for a plain colour.
      width: width of one repetition of the image, world units; 0 to stretch it over the surface.
      colour: linear RGB factor of the image, or the plain colour.
    """

    image: str | None
    width: float = 0.0
    colour: Colour = (1.0, 1.0, 1.0)


class Surface(NamedTuple):
    """A textured rectangle; see the module.

    Attributes:
      name: unique name, also of its files.
      corner, along, up: its lower left corner and its two sides, world units.
      look: image or colour that covers it.
      radiance: linear RGB light that it emits, instead of reflecting any.
      near: whether cameras come close to it.
    """

    name: str
    corner: Float[np.ndarray, "3"]
    along: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"]
    look: Look
    radiance: Colour | None = None
    near: bool = False

    @property
    def size(self) -> tuple[float, float]:
        """Lengths of `along` and `up`."""
        return float(np.linalg.norm(self.along)), float(np.linalg.norm(self.up))

    def light_size(self) -> tuple[int, int]:
        """Returns columns and rows of the light that is baked on it."""
        density = TABLE_TEXELS if self.near else LIGHT_TEXELS
        wide, high = (max(2, math.ceil(density * length)) for length in self.size)
        return wide, high


_WOOD = Look(None, colour=(0.16, 0.08, 0.04))


def furnish(bottom: float, *, texture_scale: float = 1.0) -> list[Surface]:
    """Returns the surfaces of the room around an object.

    Args:
      bottom: height of the lowest point of the object, which stands on the table.
      texture_scale: factor of the width of images that are repeated. At 1, their details are as
        fine as the pixels of a view of 160 x 160 pixels.
    """
    top = bottom - _GAP
    shell = _shell(top + FLOOR, top + CEILING)
    things = [*_table(top), *_shelves(top + FLOOR), *_crates(top + FLOOR), *_pictures(top)]
    return [
        each._replace(look=each.look._replace(width=texture_scale * each.look.width))
        for each in (*shell, *_lights(top), *things)
    ]


def paint(
    surface: Surface, light: Float[np.ndarray, "rows columns 3"] | None
) -> Float[np.ndarray, "h w 3"]:
    """Returns the linear light that leaves a surface, row 0 at the top.

    Args:
      surface: the surface.
      light: irradiance over pi on a grid over the surface, row 0 at the top; `None` for one that
        emits light.
    """
    wide, high = surface.size
    density = _NEAR_TEXELS if surface.near else _FAR_TEXELS
    columns, rows = (
        min(_MOST_TEXELS, max(4, math.ceil(density * length))) for length in (wide, high)
    )
    u = np.broadcast_to((np.arange(columns) + 0.5) / columns, (rows, columns))
    v = np.broadcast_to(((np.arange(rows) + 0.5) / rows)[:, None], (rows, columns))
    colour = np.broadcast_to(np.array(surface.look.colour), (rows, columns, 3))
    if surface.look.image is not None:
        picture = _picture(surface.look.image)
        repeats = (1.0, 1.0)
        if surface.look.width:
            repeats = (wide / surface.look.width, high / surface.look.width)
        encoded = fields.lookup(picture, u * repeats[0], v * repeats[1])
        colour = colour * image_files.srgb_to_linear(encoded)
    if surface.radiance is not None or light is None:
        return colour * np.array(surface.radiance or (1.0, 1.0, 1.0))
    at = [v * light.shape[0] - 0.5, u * light.shape[1] - 0.5]
    spread = [
        scipy.ndimage.map_coordinates(light[..., channel], at, order=1, mode="nearest")
        for channel in range(3)
    ]
    return colour * np.stack(spread, axis=-1)


def without_noise(light: Float[np.ndarray, "rows columns 3"]) -> np.ndarray:
    """Returns baked light without single bright texels, smoothed by about a texel.

    Light that glass gathers on the table is the noisiest.
    """
    middle = scipy.ndimage.median_filter(light, size=(3, 3, 1), mode="nearest")
    return scipy.ndimage.gaussian_filter(middle, (_SOFT, _SOFT, 0.0), mode="nearest")


@functools.cache
def _picture(name: str) -> Float[np.ndarray, "n n 3"]:
    return make_face(name, _PICTURE)


def _rectangle(
    name: str,
    corner: Sequence[float] | np.ndarray,
    along: np.ndarray,
    up: np.ndarray,
    look: Look,
    radiance: Colour | None = None,
) -> Surface:
    return Surface(name, np.asarray(corner, np.float64), along, up, look, radiance)


def _box(
    name: str,
    low: Sequence[float],
    high: Sequence[float],
    look: Look,
    **others: Look,
) -> list[Surface]:
    """Returns the sides of a box, upright seen from outside.

    Args:
      name: name of the box; its sides are `right` (+x), `left`, `back` (+y), `front`, `top` and
        `bottom`.
      low: its least corner.
      high: its greatest corner.
      look: image or colour that covers it.
      others: looks of single sides.
    """
    (x, y, z), (w, d, h) = low, np.subtract(high, low)
    sides = {
        "right": ((x + w, y, z), d * _Y, h * _Z),
        "left": ((x, y + d, z), -d * _Y, h * _Z),
        "back": ((x + w, y + d, z), -w * _X, h * _Z),
        "front": ((x, y, z), w * _X, h * _Z),
        "top": ((x, y, z + h), w * _X, d * _Y),
        "bottom": ((x, y + d, z), w * _X, -d * _Y),
    }
    return [_rectangle(f"{name}_{side}", *sides[side], others.get(side, look)) for side in sides]


def _shell(floor: float, ceiling: float) -> list[Surface]:
    """Returns floor, carpet, ceiling and walls, seen from inside."""
    (left, right), (front, back), high = (-6.8, 6.2), (-6.0, 7.2), (ceiling - floor) * _Z
    wide, deep = (right - left) * _X, (back - front) * _Y
    plaster = Look(None, colour=(0.75, 0.73, 0.68))
    return [
        _rectangle("floor", (left, front, floor), wide, deep, Look("parquet", 5.0)),
        *_box("carpet", (-4.0, -3.4, floor), (3.6, 3.6, floor + 0.03), Look("carpet")),
        _rectangle("ceiling", (left, back, ceiling), wide, -deep, plaster),
        _rectangle("wall_right", (right, back, floor), -deep, high, Look("brick", 6.5)),
        _rectangle("wall_left", (left, front, floor), deep, high, Look("flowers", 5.0)),
        _rectangle("wall_back", (left, back, floor), wide, high, Look("truchet", 6.0)),
        _rectangle("wall_front", (right, front, floor), -wide, high, Look("planks", 6.0)),
    ]


def _lights(top: float) -> list[Surface]:
    """Returns a roof of glass behind beams, and a window in the front wall with its bars.

    Light is spread over so large an area that it is not much brighter than what it shines on, and
    its reflections in the object need few samples.
    """
    under = top + CEILING - 0.02
    white = Look(None)
    panels = [
        _rectangle(f"panel_{x}_{y}", (x, y + 5.9, under), 5.8 * _X, -5.9 * _Y, white, _LAMP)
        for x, y in itertools.product((-6.4, -0.2), (-5.6, 0.9))
    ]
    window = (-2.8, 1.4), (top - 0.4, top + 3.4)
    (left, right), (low, high) = window
    middle, y = 0.5 * (left + right), -5.98
    bars = [
        _box("bar_upright", (middle - 0.08, y, low), (middle + 0.08, y + 0.1, high), _WOOD),
        _box("bar_across", (left, y, top + 1.4), (right, y + 0.1, top + 1.56), _WOOD),
        _box("sill", (left - 0.2, y, low - 0.2), (right + 0.2, y + 0.4, low), _WOOD),
    ]
    return [
        *panels,
        _rectangle(
            "window",
            (right, y, low),
            (left - right) * _X,
            (high - low) * _Z,
            white,
            _DAYLIGHT,
        ),
        *itertools.chain(*bars),
    ]


def _table(top: float) -> list[Surface]:
    """Returns the table, two books and a box on it, beyond the reach of any object."""
    (x, y), thick = (2.7, 2.5), 0.14
    plate = _box("table", (-x, -y, top - thick), (x, y, top), _WOOD, top=Look("penrose", 3.2))
    plate = [each._replace(near=each.name == "table_top") for each in plate]
    legs = [
        _box(
            f"leg_{number}",
            (sx * (x - 0.2) - 0.1, sy * (y - 0.2) - 0.1, top + FLOOR),
            (sx * (x - 0.2) + 0.1, sy * (y - 0.2) + 0.1, top - thick),
            _WOOD,
        )
        for number, (sx, sy) in enumerate(itertools.product((-1, 1), repeat=2))
    ]
    posters, leaves, tartan = Look("posters", 0.9), Look("leaves", 0.8), Look("tartan", 0.9)
    return [
        *plate,
        *itertools.chain(*legs),
        *_box("book_low", (1.6, 1.55, top), (2.5, 2.3, top + 0.22), leaves, top=posters),
        *_box("book_high", (1.7, 1.6, top + 0.22), (2.45, 2.2, top + 0.4), tartan),
        *_box("tin", (-2.5, 1.7, top), (-1.9, 2.3, top + 0.75), Look("contours", 0.8)),
        *_box("cards", (-2.45, -2.35, top), (-1.75, -1.9, top + 0.3), Look("circuit", 0.9)),
    ]


def _shelves(floor: float) -> list[Surface]:
    books, tall = Look("bookshelf", 4.2), floor + 5.4
    return [
        *_box("shelf_back", (-5.6, 6.2, floor), (-0.4, 7.15, tall), _WOOD, front=books),
        *_box("shelf_right", (5.3, -1.8, floor), (6.15, 3.0, floor + 4.2), _WOOD, left=books),
        *_box(
            "cabinet",
            (-6.75, -3.6, floor),
            (-5.7, 1.4, floor + 3.0),
            Look("marble", 3.0),
            right=Look("mosaic", 3.0),
        ),
        *_box("vase", (-6.4, -0.6, floor + 3.0), (-5.9, -0.1, floor + 4.1), Look("jacquard", 2.0)),
    ]


def _crates(floor: float) -> list[Surface]:
    """Returns things that stand on the floor in front of walls."""
    rust, shingles = Look("rust", 2.0), Look("shingles", 2.0)
    return [
        *_box("crate", (2.4, 4.8, floor), (4.4, 6.6, floor + 1.9), rust),
        *_box("crate_upper", (2.9, 5.1, floor + 1.9), (4.1, 6.2, floor + 3.1), shingles),
        *_box("chest", (3.0, -5.7, floor), (5.6, -4.5, floor + 2.3), Look("cobbles", 2.6)),
        *_box("seat", (-5.6, -5.6, floor), (-3.6, -4.4, floor + 1.5), Look("tartan", 1.5)),
        *_box("seat_back", (-5.6, -5.9, floor), (-3.6, -5.6, floor + 3.4), Look("tartan", 1.5)),
        *_box("pillar", (-6.0, 4.6, floor), (-5.3, 5.3, floor + 4.4), Look("terrazzo", 2.4)),
    ]


def _pictures(top: float) -> list[Surface]:
    """Returns framed pictures, a little in front of the walls."""
    posters, painting = Look("posters"), Look("painting")
    return [
        *_box("print", (0.6, 7.05, top + 0.2), (2.6, 7.15, top + 2.2), _WOOD, front=posters),
        *_box("painting", (3.2, 7.0, top + 1.4), (5.6, 7.15, top + 3.6), _WOOD, front=painting),
        *_box(
            "pane",
            (-6.75, 2.0, top - 0.2),
            (-6.65, 4.2, top + 2.0),
            _WOOD,
            right=Look("stained_glass"),
        ),
        *_box("map", (6.05, 3.6, top - 0.4), (6.15, 6.4, top + 2.4), _WOOD, left=Look("contours")),
        *_box("card", (6.05, -5.2, top), (6.15, -3.0, top + 2.2), _WOOD, left=Look("turing")),
    ]
