"""Options that several commands have: one name, one meaning, one definition.

Each function defines an option for the module that calls it, so that no command takes an option of
another's. What an option that is listed here checks, it checks before anything else is imported.
"""

import math

from absl import flags

from experiments.cli import choosable, command_line

flags.disclaim_key_flags()

SCENE_FORMS = "a folder, or hf:CONFIG/SCENE of the published data set"
"""What an option that takes a scene may name."""


def run(what: str = "Folder of a trained run.") -> flags.FlagHolder[str]:
    """Defines `--run`, which must be given."""
    return flags.DEFINE_string("run", None, what, required=True)


def step() -> flags.FlagHolder[int | None]:
    """Defines `--step`, of a run."""
    return flags.DEFINE_integer("step", None, "Checkpoint to use; the newest if not given.", 0)


def scene(what: str) -> flags.FlagHolder[str]:
    """Defines `--scene`, which must be given.

    Args:
      what: what is done with it, as `The scene to train on`.
    """
    return flags.DEFINE_string("scene", None, f"{what}: {SCENE_FORMS}.", required=True)


def moved_scene() -> flags.FlagHolder[str | None]:
    """Defines `--scene` of commands that know the scene from a run."""
    return flags.DEFINE_string("scene", None, f"The scene, if it has moved: {SCENE_FORMS}.")


def out(what: str) -> flags.FlagHolder[str]:
    """Defines `--out`, which must be given."""
    holder = flags.DEFINE_string("out", None, what, required=True)
    command_line.check(holder, _refuse_empty)
    return holder


def overwrite(what: str) -> flags.FlagHolder[bool]:
    """Defines `--overwrite`.

    Args:
      what: what it replaces.
    """
    return flags.DEFINE_bool("overwrite", False, f"Replace {what}.")


def split(what: str) -> flags.FlagHolder[str]:
    """Defines `--split`."""
    return flags.DEFINE_enum("split", "test", choosable.SPLITS, what)


def limit() -> flags.FlagHolder[int | None]:
    """Defines `--limit`."""
    return flags.DEFINE_integer("limit", None, "Only this many test images, evenly spread.", 1)


def rays_per_pixel(default: int) -> flags.FlagHolder[int]:
    """Defines `--rays_per_pixel`."""
    holder = flags.DEFINE_integer(
        "rays_per_pixel", default, "Rays in each pixel, a square: 1, 4, 9, 16. They are averaged."
    )
    command_line.check(holder, side_of)
    return holder


def chunk() -> flags.FlagHolder[int]:
    """Defines `--chunk`."""
    what = "Paths at once: lower it if memory runs out."
    return flags.DEFINE_integer("chunk", 4096, what, 1)


def preset(what: str) -> flags.FlagHolder[str]:
    """Defines `--preset`."""
    return flags.DEFINE_enum("preset", "tiny", choosable.PRESETS, what)


def seed(what: str = "Seed of everything random.") -> flags.FlagHolder[int]:
    """Defines `--seed`."""
    return flags.DEFINE_integer("seed", 0, what, 0, 2**32 - 1)


def side_of(rays: int) -> int:
    """Returns how many rays a pixel has along each edge, of so many in all.

    Raises:
      ValueError: if they do not make a square grid.
    """
    side = math.isqrt(max(rays, 0))
    if side >= 1 and side**2 == rays:
        return side
    nearest = " or ".join(str(s**2) for s in (side, side + 1) if s)
    raise ValueError(f"{rays} rays a pixel do not make a square grid. Give {nearest}.")


def _refuse_empty(value: str | None) -> None:
    if value == "":
        raise ValueError("--out is empty. Give the place to write to.")
