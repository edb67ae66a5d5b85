"""Recommends training options for a given time.

python -m experiments.recommend --scene=experiments/data/cube_smcvx_ball --minutes=5

Reads the table measured by `experiments.trade_off`, times a short training of its base point on
this machine, and scales the table's times by the ratio. It prints the options with the highest
masked PSNR that fit into the time, and the next cheaper and more expensive ones. Only measured
points are recommended, without interpolation; their PSNR is that of the table's scene.
"""

from pathlib import Path

from absl import flags
from etils import epy

from experiments.cli import app
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes

with epy.lazy_imports():
    from experiments.sweeps import recommend, table
    from refref_jax.data import scene_folder

_BUNDLED = Path(__file__).parent / "data" / "trade_off.csv"

_SCENE = cli_flags.scene("The scene to train on")
_MINUTES = flags.DEFINE_float(
    "minutes", None, "Time for training and evaluation, minutes.", 0.0, required=True
)
_TABLE = flags.DEFINE_string("table", str(_BUNDLED), "Table of a sweep, trade_off.csv.")
_TIMED_STEPS = flags.DEFINE_integer(
    "timed_steps", 96, "Steps to time; the first third, which includes compilation, is dropped.", 6
)


def main() -> None:
    """Times this machine and prints the recommendation."""
    cli_scenes.check(_SCENE.value)
    rows = table.read(Path(_TABLE.value))
    scene = cli_scenes.opened(_SCENE.value)
    images = len(scene_folder.read_frames(scene, "test").names)
    base = table.base_of(rows)
    print(f"Timing {_TIMED_STEPS.value} steps of the table's base point ...", flush=True)
    timing = recommend.time_machine(scene, base, _TIMED_STEPS.value)
    machine = recommend.compare(timing, base, images)
    print(
        f"A step takes {1e3 * timing.seconds_per_step:.1f} ms here and "
        f"{1e3 * base.seconds_per_step:.1f} ms in the table: times are scaled by "
        f"{machine.ratio:.2f}. Startup and compilation take {machine.startup:.0f} s."
    )
    choice = recommend.choose(rows, machine, 60.0 * _MINUTES.value)
    print("\n".join(recommend.describe(choice, machine, scene)))


if __name__ == "__main__":
    app.run(main, again="repeat the command to time this machine again; nothing is written.")
