"""Options that say where a scene's background stands, for scenes that do not."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from absl import flags

if TYPE_CHECKING:
    from refref_jax.choices import Space

BACKGROUND = flags.DEFINE_enum(
    "background",
    "auto",
    ["auto", "bounded", "spherical", "unbounded"],
    "Whether there are walls, a cube of them or a sphere, or an environment infinitely far away.",
)
RADIUS = flags.DEFINE_float(
    "radius",
    None,
    "Half edge of the cube, or radius of the sphere, on which the background stands (by default "
    "that of scene.json, else 7.3), or radius of an unbounded scene's uncontracted ball, in world "
    "units.",
    lower_bound=1e-6,
)
flags.register_validator(
    "radius",
    lambda radius: radius is None or math.isfinite(radius),
    message="It is a finite number of world units.",
)


def chosen_space() -> Space | None:
    """Returns what `--background` says, or `None` for what the scene does."""
    return None if BACKGROUND.value == "auto" else BACKGROUND.value
