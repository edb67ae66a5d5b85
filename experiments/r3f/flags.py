"""Defines the flags of all commands that reconstruct an object."""

from __future__ import annotations

from typing import NamedTuple

from absl import flags
from etils import epy

with epy.lazy_imports():
    from experiments.r3f import records

flags.disclaim_key_flags()

# Equal to those of `geometry_stage`, which imports JAX; a test compares them.
GEOMETRIES = ("hull", "occupancy")


class ReconstructionFlags(NamedTuple):
    """Flags of all commands that reconstruct an object."""

    geometry: flags.FlagHolder[str]
    resolution: flags.FlagHolder[int]
    outliers: flags.FlagHolder[int]
    light_steps: flags.FlagHolder[int]

    def chosen(
        self, *, index: float | None, seed: int, space: str | None, radius: float | None
    ) -> records.ReconstructionConfig:
        """Returns the options of the reconstruction; an index of `None` is estimated."""
        geometry, resolution, outliers, light_steps = (each.value for each in self)
        return records.ReconstructionConfig(
            geometry, resolution, outliers, index, space, radius, light_steps, seed
        )


def reconstruction() -> ReconstructionFlags:
    """Defines the flags of a reconstruction."""
    how = "Method that turns masks into an object: their exact visual hull, or an occupancy field "
    how += "trained on them."
    cells = "Cells along the longest edge of the grid around the object."
    wrong = "Number of masks that may be wrong, which reduces the accuracy of a hull everywhere."
    steps = "Steps of the refinement of the surface with refracted light; 0 skips it. "
    steps += "The result is kept only if it explains validation images better."
    found = ReconstructionFlags(
        flags.DEFINE_enum("geometry", "hull", GEOMETRIES, how),
        flags.DEFINE_integer("resolution", 128, cells, 16, 1024),
        flags.DEFINE_integer("outliers", 0, wrong, 0),
        flags.DEFINE_integer("light_steps", 0, steps, 0),
    )
    flags.register_multi_flags_validator(
        ["geometry", "outliers"],
        lambda given: given["geometry"] == "hull" or not given["outliers"],
        "--outliers has no effect on an occupancy field, which weighs all masks. Remove either.",
    )
    return found
