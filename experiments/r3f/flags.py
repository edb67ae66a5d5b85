"""Defines the flags of all commands that reconstruct an object."""

from __future__ import annotations

import math
from typing import NamedTuple, get_args

from absl import flags
from etils import epy

from refref_jax import choices

with epy.lazy_imports():
    from experiments.r3f import records

flags.disclaim_key_flags()

# Equal to those of `geometry_stage`, which imports JAX; a test compares them.
GEOMETRIES = ("hull", "occupancy", "neus", "nunerf")


class ReconstructionFlags(NamedTuple):
    """Flags of all commands that reconstruct an object."""

    geometry: flags.FlagHolder[str]
    resolution: flags.FlagHolder[int]
    outliers: flags.FlagHolder[int]
    refinement: flags.FlagHolder[str]

    def chosen(
        self,
        *,
        index: float | None,
        seed: int,
        space: str | None,
        radius: float | None,
        centre: choices.Position | None = None,
        exposure: choices.Exposure = "fixed",
    ) -> records.ReconstructionConfig:
        """Returns the options of the reconstruction; an index of `None` is estimated."""
        geometry, resolution, outliers, refinement = (each.value for each in self)
        return records.ReconstructionConfig(
            geometry, resolution, outliers, index, space, radius, refinement, seed, centre, exposure
        )


def reconstruction() -> ReconstructionFlags:
    """Defines the flags of a reconstruction."""
    how = "Method that finds the object: the exact visual hull of the masks, an occupancy field "
    how += "trained on them, or the surface of a field of the images, by NeuS or NU-NeRF, which "
    how += "needs no masks."
    cells = "Cells along the longest edge of the grid around the object."
    wrong = "Number of masks that may be wrong, which reduces the accuracy of a hull everywhere."
    light = "What refines the surface and the index: the light refracted through it, or nothing. "
    light += "The result is kept only if it explains pixels better that were not fitted."
    found = ReconstructionFlags(
        flags.DEFINE_enum("geometry", "hull", GEOMETRIES, how),
        flags.DEFINE_integer("resolution", 128, cells, 16, 1024),
        flags.DEFINE_integer("outliers", 0, wrong, 0),
        flags.DEFINE_enum("refinement", "light", ["light", "none"], light),
    )
    flags.register_multi_flags_validator(
        ["geometry", "outliers"],
        lambda given: given["geometry"] == "hull" or not given["outliers"],
        "--outliers has no effect on an occupancy field, which weighs all masks, or on a field of "
        "the images (neus, nunerf), which reads none. Remove either.",
    )
    return found


class SpaceFlags(NamedTuple):
    """Flags for the type and size of a background, for scenes that do not define them."""

    background: flags.FlagHolder[str]
    radius: flags.FlagHolder[float | None]

    def chosen(self) -> str | None:
        """Returns the space that `--background` selects, or `None` for the scene's own."""
        return None if self.background.value == "auto" else self.background.value


def space() -> SpaceFlags:
    """Defines `--background` and `--radius`."""
    background = flags.DEFINE_enum(
        "background",
        "auto",
        ["auto", *get_args(choices.Space)],
        "Type of the background: walls (a cube or a sphere), or an environment at infinity.",
    )
    radius = flags.DEFINE_float(
        "radius",
        None,
        "Half-extent of the background cube, or radius of the background sphere (by default from "
        "scene.json, else measured, else 7.3), or radius of the uncontracted ball of an unbounded "
        "scene, in world units.",
        lower_bound=1e-6,
    )
    finite = "It must be a finite number of world units."
    flags.register_validator("radius", lambda x: x is None or math.isfinite(x), finite)
    return SpaceFlags(background, radius)
