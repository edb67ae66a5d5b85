"""The set of images for background spheres."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from experiments.dataset.textures import halls, heavens, orbs, outlooks, rooms
from experiments.dataset.textures.faces import require_size
from experiments.dataset.textures.fields import Picture
from experiments.dataset.textures.sphere_fields import averaged

HEIGHT = 1024
"""Default number of rows; there are twice as many columns."""

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
    """Returns an image of `[height, 2 height]` samples, sRGB from 0 to 1 in float32.

    Args:
      name: name of an image in `SPHERES`.
      height: number of rows, 16 or more.

    Raises:
      ValueError: if the image does not exist, or the height is too small.
    """
    if name not in SPHERES:
        raise ValueError(f"There is no sphere {name!r}. Choose from {', '.join(SPHERES)}.")
    require_size(height)
    return np.clip(averaged(SPHERES[name], height), 0.0, 1.0)
