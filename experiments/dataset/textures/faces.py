"""The set of square images for background cubes."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from experiments.dataset.textures import (
    books,
    cloth,
    drawn,
    masonry,
    minerals,
    painted,
    penrose_tiles,
    plants,
    posters,
    tilings,
    timber,
)
from experiments.dataset.textures.fields import Picture

SIZE = 1024
"""Default number of samples a side."""


class Face(NamedTuple):
    """Recipe of an image.

    Attributes:
      paint: function from samples a side to sRGB values, which may lie a little outside 0 to 1.
      samples: samples per pixel a side. Images made of stamps have soft outlines anyway.
    """

    paint: Callable[[int], Picture]
    samples: int = 2


FACES: dict[str, Face] = {
    "brick": Face(masonry.brick),
    "cobbles": Face(masonry.cobbles),
    "pebbles": Face(masonry.pebbles, samples=1),
    "shingles": Face(masonry.shingles),
    "terrazzo": Face(masonry.terrazzo),
    "parquet": Face(timber.parquet),
    "planks": Face(timber.planks),
    "marble": Face(minerals.marble),
    "rust": Face(minerals.rust),
    "turing": Face(minerals.turing),
    "jacquard": Face(cloth.jacquard),
    "tartan": Face(cloth.tartan),
    "carpet": Face(cloth.carpet),
    "stained_glass": Face(tilings.stained_glass),
    "mosaic": Face(tilings.mosaic),
    "truchet": Face(tilings.truchet),
    "penrose": Face(penrose_tiles.penrose),
    "leaves": Face(plants.leaves, samples=1),
    "flowers": Face(plants.flowers, samples=1),
    "bookshelf": Face(books.bookshelf),
    "posters": Face(posters.posters),
    "contours": Face(drawn.contours),
    "circuit": Face(drawn.circuit),
    "painting": Face(painted.painting),
}


def make_face(name: str, size: int = SIZE) -> Float[np.ndarray, "size size 3"]:
    """Returns an image, sRGB from 0 to 1 in float32, row 0 at the top.

    Args:
      name: name of an image in `FACES`.
      size: samples a side, 16 or more.

    Raises:
      ValueError: if the image does not exist, or the size is too small.
    """
    if name not in FACES:
        raise ValueError(f"There is no face {name!r}. Choose from {', '.join(FACES)}.")
    require_size(size)
    face = FACES[name]
    fine = np.clip(face.paint(size * face.samples), 0.0, 1.0).astype(np.float32)
    return fine.reshape(size, face.samples, size, face.samples, 3).mean((1, 3))


def require_size(size: int) -> None:
    """Raises ValueError if the size of an image is too small to be useful."""
    if size < 16:
        raise ValueError(f"An image of {size} samples is too small. Request 16 or more.")
