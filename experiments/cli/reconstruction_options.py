"""The options of a reconstruction that all commands which make one share."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from absl import flags

from experiments.cli import choosable
from experiments.cli.late_imports import late

if TYPE_CHECKING:
    from experiments.r3f import records
    from refref_jax.choices import Space
else:
    records = late("experiments.r3f.records")

GEOMETRY = flags.DEFINE_enum(
    "geometry",
    "hull",
    choosable.GEOMETRIES,
    "How a body is found from masks: as their exact visual hull, or by an occupancy field that is "
    "trained on them.",
)
RESOLUTION = flags.DEFINE_integer(
    "resolution", 128, "Cells along the longest edge of the grid that holds the body.", 16, 1024
)
OUTLIERS = flags.DEFINE_integer(
    "outliers", 0, "Views whose masks may be wrong, at the cost of a hull's accuracy everywhere.", 0
)

LIGHT_STEPS = flags.DEFINE_integer(
    "light_steps",
    0,
    "Steps by which the surface is refined by the light that went through it; 0 leaves it out. The "
    "result is kept only if validation images are explained better.",
    0,
)

_LARGEST_INDEX = 5.0


def chosen(
    *, index: float | None, seed: int, space: Space | None, radius: float | None
) -> records.ReconstructionConfig:
    """Returns what the options ask for.

    Args:
      index: index of refraction, or `None` to estimate it.
      seed: seed of everything random.
      space: where the background stands, or `None` for what the scene says.
      radius: its half extent or radius, world units, or `None` likewise.

    Raises:
      ValueError: if one would have no effect.
    """
    if OUTLIERS.value and GEOMETRY.value != "hull":
        raise ValueError(
            f"--outliers={OUTLIERS.value} has no effect on --geometry={GEOMETRY.value}, which "
            "weighs all masks. Leave out one of them."
        )
    return records.ReconstructionConfig(
        GEOMETRY.value,
        RESOLUTION.value,
        OUTLIERS.value,
        index,
        space,
        radius,
        LIGHT_STEPS.value,
        seed,
    )


def parse_index(word: str) -> float:
    """Returns the index of refraction of `--ior=NUMBER`.

    Raises:
      ValueError: if it is none that a solid or liquid in air could have.
    """
    try:
        index = float(word)
    except ValueError:
        index = math.nan
    if not 1.0 < index < _LARGEST_INDEX:
        raise ValueError(
            f"--ior={word} is no index of refraction of one body in air. Give a number above 1 and "
            f"below {_LARGEST_INDEX:g}, as in --ior=1.5, or leave it out to have it estimated."
        )
    return index
