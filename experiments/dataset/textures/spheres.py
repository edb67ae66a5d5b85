"""The pool of pictures that are laid around a sphere."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from PIL import Image

from experiments.dataset.textures import halls, heavens, orbs, outlooks, rooms
from experiments.dataset.textures.faces import require_size
from experiments.dataset.textures.fields import Picture

HEIGHT = 1024
"""Usual rows; there are twice as many columns."""

SPHERES: dict[str, Callable[[int], Picture]] = {
    "nebula": heavens.nebula,
    "agate": orbs.agate,
    "planet": heavens.planet,
    "lantern": orbs.lantern,
    "coral": orbs.coral,
    "canyon": orbs.canyon,
    "library": rooms.library,
    "gallery": rooms.gallery,
    "courtyard": rooms.courtyard,
    "rotunda": halls.rotunda,
    "tent": halls.tent,
    "skyline": outlooks.skyline,
    "wood": outlooks.wood,
}


def make_sphere(name: str, height: int = HEIGHT) -> Float[np.ndarray, "height width 3"]:
    """Returns a picture of `[height, 2 height]` samples, sRGB from 0 to 1 in float32.

    It is painted with half as many samples again in each direction, and averaged.

    Args:
      name: one of `SPHERES`.
      height: rows, 16 or more.

    Raises:
      ValueError: if there is no such picture, or the height is too small.
    """
    if name not in SPHERES:
        raise ValueError(f"There is no sphere {name!r}. Choose from {', '.join(SPHERES)}.")
    require_size(height)
    fine = np.clip(SPHERES[name]((3 * height + 1) // 2), 0.0, 1.0).astype(np.float32)
    channels = [
        Image.fromarray(np.ascontiguousarray(fine[..., each])).resize(
            (2 * height, height), Image.Resampling.BOX
        )
        for each in range(3)
    ]
    return np.stack([np.asarray(channel) for channel in channels], -1)
