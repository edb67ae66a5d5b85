"""Defines the flags that several commands share, grouped by topic.

Each function defines its flags for the calling module; importing this module defines nothing, so
that no command accepts a flag that it ignores. Values are validated during parsing, before JAX is
imported.
"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, get_args

from absl import flags

from experiments.cli import app
from experiments.runs import processes, view_numbers
from refref_jax import choices
from refref_jax.data import scene_properties
from refref_jax.optics.path_settings import PathSettings, make_path_settings

flags.disclaim_key_flags()

# Choices of the library.
SPLITS = get_args(choices.Split)
PRESETS = get_args(choices.PresetName)
RULES = get_args(choices.RuleName)

SCENE_FORMS = "a folder, or hf:CONFIG/SCENE of the published data set"

SCENES_FORMS = f"{SCENE_FORMS} (hf:all, hf:CONFIG and wildcards stand for several)"

# Files that identify the folders of a run and of a reconstruction.
RUN = "config.json"
RECONSTRUCTION = "reconstruction.json"


# ---- Names and values of earlier versions ----
def alias(former: str, present: str) -> None:
    """Accepts the name that a flag had in earlier versions; only `--helpfull` lists it."""
    flags.DEFINE_alias(former, present, module_name="earlier versions")


class _EnumParser(flags.EnumParser):
    def __init__(self, values: Sequence[str], formerly: Mapping[str, str]):
        super().__init__(values)
        self._formerly = formerly

    def parse(self, argument: str) -> str:
        return super().parse(self._formerly.get(argument, argument))


def enum(
    name: str, default: str | None, values: Sequence[str], what: str, *, formerly: Mapping[str, str]
) -> flags.FlagHolder[str]:
    """Defines a choice whose values had other names in earlier versions, which are accepted.

    It is required if its default is `None`.
    """
    flag = flags.EnumFlag(name, default, what, enum_values=list(values))
    flag.parser = _EnumParser(values, formerly)
    return flags.DEFINE_flag(flag, required=default is None)


# ---- Runs ----
def run(what: str = "Folder of a trained run.") -> flags.FlagHolder[str]:
    """Defines `--run`, which is required."""
    return flags.DEFINE_string("run", None, what, required=True)


def step() -> flags.FlagHolder[int | None]:
    """Defines `--step`, the checkpoint of a run."""
    return flags.DEFINE_integer("step", None, "Checkpoint to use; the newest by default.", 0)


def check_run(folder: Path, *, holds: Sequence[str] = (RUN,)) -> None:
    """Rejects a folder that lacks one of the given files, before its readers are imported."""
    if not any((folder / name).is_file() for name in holds):
        raise ValueError(
            f"{folder / holds[0]} does not exist. Give the folder that a training wrote, as in "
            "--run=runs/demo."
        )


# ---- Input and output ----
def scene(what: str, *, required: bool = True) -> flags.FlagHolder[str]:
    """Defines `--scene`; `what` describes its use."""
    return flags.DEFINE_string("scene", None, f"{what}: {SCENE_FORMS}.", required=required)


def allow_outside() -> flags.FlagHolder[bool]:
    """Defines `--allow_outside`, which `app.run` tells the readers of scenes."""
    what = "Read files that a scene names outside of its folder. Only for scenes that you trust."
    return flags.DEFINE_bool("allow_outside", False, what)


def out(what: str) -> flags.FlagHolder[str]:
    """Defines `--out`, which is required."""
    holder = flags.DEFINE_string("out", None, what, required=True)
    flags.register_validator("out", lambda value: value != "", "Give a path to write to.")
    return holder


def overwrite(what: str) -> flags.FlagHolder[bool]:
    """Defines `--overwrite`, which allows to replace `what`."""
    return flags.DEFINE_bool("overwrite", False, f"Replace {what}.")


# ---- Training ----
def preset(what: str) -> flags.FlagHolder[str]:
    """Defines `--preset`."""
    return flags.DEFINE_enum("preset", "tiny", PRESETS, what)


def seed(what: str = "Random seed.") -> flags.FlagHolder[int]:
    """Defines `--seed`."""
    return flags.DEFINE_integer("seed", 0, what, 0, 2**32 - 1)


# ---- Views ----
def split(what: str) -> flags.FlagHolder[str]:
    """Defines `--split`."""
    return flags.DEFINE_enum("split", "test", SPLITS, what)


def limit() -> flags.FlagHolder[int | None]:
    """Defines `--limit`."""
    return flags.DEFINE_integer("limit", None, "Use only this many test images, evenly spread.", 1)


def views(default: str) -> flags.FlagHolder[str]:
    """Defines `--views`, which `view_numbers` parses."""
    what = "Numbers of views of the split, as in 0,10,20, or all."
    holder = flags.DEFINE_string("views", default, what)
    app.check(holder, lambda text: view_numbers.choose(text, sys.maxsize))
    return holder


# ---- Rendering and measuring ----
def rays_per_pixel(default: int) -> flags.FlagHolder[int]:
    """Defines `--rays_per_pixel`."""
    what = "Rays per pixel, a square number: 1, 4, 9, 16. Their radiance is averaged."
    holder = flags.DEFINE_integer("rays_per_pixel", default, what)
    app.check(holder, choices.side_of)
    return holder


def chunk() -> flags.FlagHolder[int | None]:
    """Defines `--chunk`."""
    what = "Paths rendered at once; by default 4096, and 65,536 on accelerators. Reduce it if "
    return flags.DEFINE_integer("chunk", None, what + "memory runs out.", 1)


def lpips_weights() -> flags.FlagHolder[str | None]:
    """Defines `--lpips_weights`; `runs.perceptual` reads the file."""
    what = "File of LPIPS weights, made by experiments.convert_lpips, see docs/metrics.md. "
    what += "LPIPS is skipped without it."
    return flags.DEFINE_string("lpips_weights", None, what)


# ---- Light paths ----
class PathFlags(NamedTuple):
    """Flags of commands that trace light paths with the user's path settings."""

    min_throughput: flags.FlagHolder[float | None]
    max_bends: flags.FlagHolder[int | None]

    def chosen(self, paths: str) -> PathSettings:
        """Returns the path settings of a preset, with the user's threshold and maximum of bends."""
        return make_path_settings(
            paths, min_throughput=self.min_throughput.value, max_bends=self.max_bends.value
        )


def settings(*, min_throughput: float | None = None, max_bends: int | None = None) -> PathFlags:
    """Defines `--min_throughput` and `--max_bends`, formerly `--cut` and `--bends`."""
    least, usual = "Throughput threshold of paths, in [0, 1)", "that of the path preset by default."
    found = PathFlags(
        flags.DEFINE_float("min_throughput", min_throughput, f"{least}; {usual}"),
        flags.DEFINE_integer("max_bends", max_bends, f"Maximum bends of a path; {usual}"),
    )
    app.check(found.min_throughput, lambda x: make_path_settings("tree", min_throughput=x))
    app.check(found.max_bends, lambda n: make_path_settings("tree", max_bends=n))
    alias("cut", "min_throughput")
    alias("bends", "max_bends")
    return found


# ---- Properties of scenes ----
def rule() -> flags.FlagHolder[str | None]:
    """Defines `--rule`."""
    return flags.DEFINE_enum(
        "rule",
        None,
        RULES,
        "Medium outside each mesh: that of the enclosing mesh, always air (as in Cycles), or, for "
        "overlapping meshes, that with the highest 'priority' in scene.json. By default that of "
        "scene.json, else nested.",
    )


def properties() -> flags.FlagHolder[str | None]:
    """Defines `--properties`, a file like `scene.json`, which is read before the scene."""
    what = "JSON file of properties, like scene.json, whose values override it."
    holder = flags.DEFINE_string("properties", None, what)
    app.check(holder, check_properties)
    return holder


def check_properties(path: str | None) -> None:
    """Rejects a file that is not a valid overlay of a scene's properties."""
    if path:
        scene_properties.check_file(Path(path))


def ior() -> flags.FlagHolder[list[str]]:
    """Defines `--ior` of meshes, which `runs.refraction_indices` parses."""
    what = "Index of refraction of a material or a mesh, as in glass=1.52. May be repeated."
    return flags.DEFINE_multi_string("ior", [], what)


# ---- Devices and processes ----
class DeviceFlags(NamedTuple):
    """Flags for the devices and processes that train together; see `runs.processes`."""

    devices: flags.FlagHolder[str]
    coordinator: flags.FlagHolder[str | None]
    processes: flags.FlagHolder[int]
    process: flags.FlagHolder[int | None]


def devices() -> DeviceFlags:
    """Defines `--devices`, `--coordinator`, `--processes` and `--process`."""
    what = "Devices per process that share the light paths of a batch: a number, or all."
    where = "Address of process 0 if there are several, as HOST:PORT."
    found = DeviceFlags(
        flags.DEFINE_string("devices", "1", what),
        flags.DEFINE_string("coordinator", None, where),
        flags.DEFINE_integer("processes", 1, "Number of processes that train together.", 1),
        flags.DEFINE_integer("process", None, "Number of this process, from 0.", 0),
    )
    flags.register_validator(
        "devices", lambda word: word == "all" or word.isdecimal(), "Give a number, or all."
    )
    names = ["coordinator", "processes", "process"]
    flags.register_multi_flags_validator(names, processes.check)
    return found
