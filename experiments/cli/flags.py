"""Flags that several commands have: one name, one meaning, one definition, by topic.

Each function defines its flags for the module that calls it; nothing is defined by importing this
module, so that no command takes a flag that it does not heed. Values are checked as they are read,
before JAX is imported.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, get_args

from absl import flags
from etils import epy

from experiments.cli import app
from experiments.runs import processes, view_numbers
from refref_jax import choices
from refref_jax.optics.path_settings import Budget, budget_of

with epy.lazy_imports():
    from experiments.r3f import records

flags.disclaim_key_flags()

# Choices of the library; that of ways to a geometry is held equal to its definition by a test.
SPLITS = get_args(choices.Split)
PRESETS = get_args(choices.PresetName)
RULES = get_args(choices.RuleName)
GEOMETRIES = ("hull", "occupancy")

SCENE_FORMS = "a folder, or hf:CONFIG/SCENE of the published data set"

# Files by which the folders of a run and of a reconstruction are known.
RUN = "config.json"
RECONSTRUCTION = "reconstruction.json"


# ---- Runs ----
def run(what: str = "Folder of a trained run.") -> flags.FlagHolder[str]:
    """Defines `--run`, which must be given."""
    return flags.DEFINE_string("run", None, what, required=True)


def step() -> flags.FlagHolder[int | None]:
    """Defines `--step`, of a run."""
    return flags.DEFINE_integer("step", None, "Checkpoint to use; the newest if not given.", 0)


def check_run(folder: Path, *, holds: Sequence[str] = (RUN,)) -> None:
    """Refuses a folder that has none of some files, before anything that reads it is imported."""
    if not any((folder / name).is_file() for name in holds):
        raise ValueError(
            f"{folder / holds[0]} does not exist. Give the folder that a training wrote, as in "
            "--run=runs/demo."
        )


# ---- Input and output ----
def scene(what: str, *, required: bool = True) -> flags.FlagHolder[str]:
    """Defines `--scene`; `what` is done with it."""
    return flags.DEFINE_string("scene", None, f"{what}: {SCENE_FORMS}.", required=required)


def out(what: str) -> flags.FlagHolder[str]:
    """Defines `--out`, which must be given."""
    holder = flags.DEFINE_string("out", None, what, required=True)
    flags.register_validator("out", lambda value: value != "", "Give the place to write to.")
    return holder


def overwrite(what: str) -> flags.FlagHolder[bool]:
    """Defines `--overwrite`, which replaces `what`."""
    return flags.DEFINE_bool("overwrite", False, f"Replace {what}.")


# ---- Training ----
def preset(what: str) -> flags.FlagHolder[str]:
    """Defines `--preset`."""
    return flags.DEFINE_enum("preset", "tiny", PRESETS, what)


def seed(what: str = "Seed of everything random.") -> flags.FlagHolder[int]:
    """Defines `--seed`."""
    return flags.DEFINE_integer("seed", 0, what, 0, 2**32 - 1)


# ---- Views ----
def split(what: str) -> flags.FlagHolder[str]:
    """Defines `--split`."""
    return flags.DEFINE_enum("split", "test", SPLITS, what)


def limit() -> flags.FlagHolder[int | None]:
    """Defines `--limit`."""
    return flags.DEFINE_integer("limit", None, "Only this many test images, evenly spread.", 1)


def views(default: str) -> flags.FlagHolder[str]:
    """Defines `--views`, which `view_numbers` reads."""
    what = "Numbers of views of the split, as 0,10,20, or all."
    holder = flags.DEFINE_string("views", default, what)
    app.check(holder, lambda text: view_numbers.choose(text, sys.maxsize))
    return holder


# ---- Rendering and measuring ----
def rays_per_pixel(default: int) -> flags.FlagHolder[int]:
    """Defines `--rays_per_pixel`."""
    what = "Rays in each pixel, a square: 1, 4, 9, 16. They are averaged."
    holder = flags.DEFINE_integer("rays_per_pixel", default, what)
    app.check(holder, choices.side_of)
    return holder


def chunk() -> flags.FlagHolder[int]:
    """Defines `--chunk`."""
    what = "Paths at once: lower it if memory runs out."
    return flags.DEFINE_integer("chunk", 4096, what, 1)


def lpips_weights() -> flags.FlagHolder[str | None]:
    """Defines `--lpips_weights`; `runs.perceptual` reads the file."""
    what = "File of the weights of LPIPS, made by experiments.convert_lpips, see docs/metrics.md. "
    what += "LPIPS is not measured without it."
    return flags.DEFINE_string("lpips_weights", None, what)


# ---- Light paths ----
class BudgetFlags(NamedTuple):
    """Flags of commands that follow light with a budget of the user's choice."""

    cut: flags.FlagHolder[float | None]
    bends: flags.FlagHolder[int | None]

    def chosen(self, paths: str) -> Budget:
        """Returns the budget of a name, with the cut and the bends that were asked for."""
        return budget_of(paths, cut=self.cut.value, bends=self.bends.value)


def budget(*, cut: float | None = None, bends: int | None = None) -> BudgetFlags:
    """Defines `--cut` and `--bends`; without a default they are those of the light paths."""
    what = ("Smallest throughput worth following, in [0, 1)", "Most refractions and reflections")
    found = BudgetFlags(
        flags.DEFINE_float("cut", cut, f"{what[0]}; that of the paths if not given."),
        flags.DEFINE_integer("bends", bends, f"{what[1]}; those of the paths if not given."),
    )
    app.check(found.cut, lambda cut: budget_of("tree", cut=cut))
    app.check(found.bends, lambda bends: budget_of("tree", bends=bends))
    return found


# ---- Meshes and their materials ----
def rule() -> flags.FlagHolder[str]:
    """Defines `--rule`."""
    return flags.DEFINE_enum(
        "rule",
        "nested",
        RULES,
        "What lies outside each mesh: the part around it, always air (as Cycles does it), or, of "
        "meshes that overlap, the one with the highest 'priority' in scene.json.",
    )


def ior() -> flags.FlagHolder[list[str]]:
    """Defines `--ior` of meshes, which `runs.refraction_indices` reads."""
    what = "Index of refraction of a material or a mesh, as glass=1.52. May be repeated."
    return flags.DEFINE_multi_string("ior", [], what)


# ---- Background ----
class SpaceFlags(NamedTuple):
    """Flags that say where a scene's background stands, for scenes that do not."""

    background: flags.FlagHolder[str]
    radius: flags.FlagHolder[float | None]

    def chosen(self) -> str | None:
        """Returns the space that `--background` names, or `None` for that of the scene."""
        return None if self.background.value == "auto" else self.background.value


def space() -> SpaceFlags:
    """Defines `--background` and `--radius`."""
    background = flags.DEFINE_enum(
        "background",
        "auto",
        ["auto", *get_args(choices.Space)],
        "Walls, a cube of them or a sphere, or an environment infinitely far away.",
    )
    radius = flags.DEFINE_float(
        "radius",
        None,
        "Half edge of the cube, or radius of the sphere, on which the background stands (by "
        "default that of scene.json, else 7.3), or radius of an unbounded scene's uncontracted "
        "ball, in world units.",
        lower_bound=1e-6,
    )
    finite = "It is a finite number of world units."
    flags.register_validator("radius", lambda x: x is None or math.isfinite(x), finite)
    return SpaceFlags(background, radius)


# ---- Reconstruction ----
class ReconstructionFlags(NamedTuple):
    """Flags that all commands which reconstruct a body share."""

    geometry: flags.FlagHolder[str]
    resolution: flags.FlagHolder[int]
    outliers: flags.FlagHolder[int]
    light_steps: flags.FlagHolder[int]

    def chosen(
        self, *, index: float | None, seed: int, space: str | None, radius: float | None
    ) -> records.ReconstructionConfig:
        """Returns the reconstruction asked for; an index of `None` is estimated."""
        geometry, resolution, outliers, light_steps = (each.value for each in self)
        return records.ReconstructionConfig(
            geometry, resolution, outliers, index, space, radius, light_steps, seed
        )


def reconstruction() -> ReconstructionFlags:
    """Defines the flags of a reconstruction."""
    how = "How a body is found from masks: as their exact visual hull, or by an occupancy field "
    how += "that is trained on them."
    cells = "Cells along the longest edge of the grid that holds the body."
    wrong = "Views whose masks may be wrong, at the cost of a hull's accuracy everywhere."
    steps = "Steps by which the surface is refined by the light that went through it; 0 leaves it "
    steps += "out. The result is kept only if validation images are explained better."
    found = ReconstructionFlags(
        flags.DEFINE_enum("geometry", "hull", GEOMETRIES, how),
        flags.DEFINE_integer("resolution", 128, cells, 16, 1024),
        flags.DEFINE_integer("outliers", 0, wrong, 0),
        flags.DEFINE_integer("light_steps", 0, steps, 0),
    )
    flags.register_multi_flags_validator(
        ["geometry", "outliers"],
        lambda given: given["geometry"] == "hull" or not given["outliers"],
        "--outliers has no effect on an occupancy field, which weighs all masks. Leave out either.",
    )
    return found


# ---- Devices and processes ----
class DeviceFlags(NamedTuple):
    """Flags that say which devices, and which processes, train together; see `runs.processes`."""

    devices: flags.FlagHolder[str]
    coordinator: flags.FlagHolder[str | None]
    processes: flags.FlagHolder[int]
    process: flags.FlagHolder[int | None]


def devices() -> DeviceFlags:
    """Defines `--devices`, `--coordinator`, `--processes` and `--process`."""
    what = "Devices that share the light paths of a batch: a number, or all; of each process."
    where = "Where the first of several processes listens, as HOST:PORT."
    found = DeviceFlags(
        flags.DEFINE_string("devices", "1", what),
        flags.DEFINE_string("coordinator", None, where),
        flags.DEFINE_integer("processes", 1, "Processes that train together.", 1),
        flags.DEFINE_integer("process", None, "Number of this process, from 0.", 0),
    )
    flags.register_validator(
        "devices", lambda word: word == "all" or word.isdecimal(), "Give a number, or all."
    )
    names = ["coordinator", "processes", "process"]
    flags.register_multi_flags_validator(names, processes.check)
    return found
