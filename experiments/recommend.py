"""Recommends training options for a given time.

python -m experiments.recommend --scene=experiments/data/cube_smcvx_ball --minutes=5

Where `experiments.train` would solve for a backdrop, it traces a few views, takes some iterations
and renders an image on this machine, and prints the resolution for the images' detail, the number
of iterations and the rays per pixel that fit into the time.

Else it reads the table measured by `experiments.trade_off`, times a short training of its base
point on this machine, and scales the table's times by the ratio. It prints the options with the
highest masked PSNR that fit into the time. Only measured points are recommended, without
interpolation; their PSNR is that of the table's scene. A table that is given with --table is read
in any case.

Both print the next cheaper and more expensive options, too.
"""

import time
from pathlib import Path
from typing import get_args

from absl import flags
from etils import epy

from experiments.cli import app
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from refref_jax import choices

with epy.lazy_imports():
    from experiments.sweeps import backdrop_trial, far_fields, recommend, table
    from refref_jax.data import scene_folder

_BUNDLED = Path(__file__).parent / "data" / "trade_off.csv"

_SCENE = cli_flags.scene("The scene to train on")
_MINUTES = flags.DEFINE_float(
    "minutes", None, "Time for training and evaluation, minutes.", 0.0, required=True
)
_FAR_FIELD = flags.DEFINE_enum(
    "far_field",
    None,
    get_args(choices.FarField),
    "Far field to recommend options for; by default that of the given table, else as for training.",
)
_TABLE = flags.DEFINE_string("table", str(_BUNDLED), "Table of a sweep, trade_off.csv.")
_TIMED_STEPS = flags.DEFINE_integer(
    "timed_steps", 96, "Steps to time; the first third, which includes compilation, is dropped.", 6
)
cli_flags.allow_outside()


def main() -> None:
    """Times this machine and prints the recommendation."""
    begun = time.monotonic()
    cli_scenes.check(_SCENE.value)
    if _TABLE.present:
        print_from_table()
        return
    if _FAR_FIELD.value != "field":
        scene = cli_scenes.opened(_SCENE.value)
        asked = {} if _FAR_FIELD.value is None else {"far_field": _FAR_FIELD.value}
        resolved, objects = far_fields.prepare(scene, asked)
        print(far_fields.describe(resolved))
        if resolved.config.model.far_field == "backdrop":
            images = len(scene_folder.read_frames(scene, "test").names)
            print("Tracing a few views, and solving for what they see ...", flush=True)
            trial = backdrop_trial.try_out(
                resolved, objects, startup=time.monotonic() - begun, images=images
            )
            choice = backdrop_trial.choose(trial, 60.0 * _MINUTES.value)
            print("\n".join(backdrop_trial.describe(choice, trial, scene)))
            return
    print_from_table()


def print_from_table() -> None:
    """Times the base point of the table and prints a recommendation of its points.

    Raises:
      ValueError: if the table is of another far field than the flag.
    """
    rows = table.read(Path(_TABLE.value))
    base = table.base_of(rows)
    found = "backdrop" if base.has_backdrop else "field"
    if _FAR_FIELD.value not in (None, found):
        raise ValueError(
            f"--far_field={_FAR_FIELD.value}, but the base of {_TABLE.value} has a {found}. Leave "
            "out one of both."
        )
    scene = cli_scenes.opened(_SCENE.value)
    images = len(scene_folder.read_frames(scene, "test").names)
    what = "a few iterations" if base.has_backdrop else f"{_TIMED_STEPS.value} steps"
    print(f"Timing {what} of the table's base point ...", flush=True)
    timing = recommend.time_machine(scene, base, _TIMED_STEPS.value)
    machine = recommend.compare(timing, base, images)
    print(
        f"{'An iteration' if base.has_backdrop else 'A step'} takes "
        f"{1e3 * timing.seconds_per_step:.1f} ms here and "
        f"{1e3 * base.seconds_per_step:.1f} ms in the table: times are scaled by "
        f"{machine.ratio:.2f}. Startup and compilation take {machine.startup:.0f} s."
    )
    choice = recommend.choose(rows, machine, 60.0 * _MINUTES.value)
    print("\n".join(recommend.describe(choice, machine, scene)))


if __name__ == "__main__":
    app.run(main, again="repeat the command to time this machine again; nothing is written.")
