"""Recommends options of training for the time that there is.

python -m experiments.recommend --scene=experiments/data/cube_smcvx_ball --minutes=5

Reads the table that `experiments.trade_off` measured, times a short training of its base point on
this machine, and scales the table's times by the ratio. Printed are the options that gave the
highest PSNR inside the mask of those that fit, and the next cheaper and dearer ones. Only what was
measured is recommended: PSNR is that of the table's scene, and nothing between or beyond its points
is guessed.
"""

import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path

from absl import flags

from experiments import commands, trade_table, trained_runs
from experiments.trade_table import Row
from experiments.trained_runs import RunFailedError, Training
from refref_jax.data import local_layout

_BUNDLED = Path(__file__).parent / "data" / "trade_off.csv"

_SCENE = flags.DEFINE_string("scene", None, "Folder of the scene to train on.", required=True)
_MINUTES = flags.DEFINE_float(
    "minutes", None, "Time for training and evaluation.", 0.0, required=True
)
_TABLE = flags.DEFINE_string("table", str(_BUNDLED), "Table of a sweep, trade_off.csv.")
_TIMED_STEPS = flags.DEFINE_integer(
    "timed_steps", 96, "Steps of the timing; the first third, which compiles, is left out.", 6
)


@dataclasses.dataclass(frozen=True)
class Machine:
    """How this machine compares with that of a table.

    Attributes:
      ratio: time of a step here over that in the table.
      startup: seconds that a command takes beside its steps: starting, compiling, saving.
      images: that an evaluation renders.
    """

    ratio: float
    startup: float
    images: int


@dataclasses.dataclass(frozen=True)
class Choice:
    """What to train with.

    Attributes:
      best: the best that fits.
      cheaper: the next below it that nothing beats; `None` if there is none.
      dearer: the next above it, which does not fit; `None` if nothing better was measured.
    """

    best: Row
    cheaper: Row | None
    dearer: Row | None


def main() -> None:
    """Times this machine and prints the recommendation."""
    rows = trade_table.read(Path(_TABLE.value))
    scene = Path(_SCENE.value)
    images = len(local_layout.read_frames(scene, "test").names)
    base = trade_table.base_of(rows)
    print(f"Timing {_TIMED_STEPS.value} steps of the table's base point ...", flush=True)
    timing = time_machine(scene, base, _TIMED_STEPS.value)
    machine = compare(timing, base, images)
    print(
        f"A step takes {1e3 * timing.seconds_per_step:.1f} ms here and "
        f"{1e3 * base.seconds_per_step:.1f} ms in the table: times are scaled by "
        f"{machine.ratio:.2f}. Starting and compiling takes {machine.startup:.0f} s."
    )
    choice = choose(rows, machine, 60.0 * _MINUTES.value)
    print("\n".join(told(choice, machine, scene)))


def time_machine(scene: Path, base: Row, steps: int) -> Training:
    """Trains the table's base point for a few steps, in a folder that is deleted again."""
    options = [word for word in base.training.split() if not word.startswith("--steps=")]
    with tempfile.TemporaryDirectory() as folder:
        try:
            return trained_runs.train(
                Path(folder) / "timing",
                scene=scene,
                options=[*options, f"--steps={steps}"],
                log_every=steps // 3,
            )
        except RunFailedError as error:
            # The log goes with the folder.
            raise ValueError(
                f"Timing the table's base point ({' '.join(options)}) failed: {error}. Give a "
                "table whose base this scene can be trained with."
            ) from error


def compare(timing: Training, base: Row, images: int) -> Machine:
    """Returns how this machine compares with the table's, by the same training on both."""
    return Machine(
        ratio=timing.seconds_per_step / base.seconds_per_step,
        startup=timing.startup_seconds,
        images=images,
    )


def seconds_of(row: Row, machine: Machine) -> float:
    """Returns the seconds that training and evaluating a point are expected to take here.

    Training and evaluation both start and compile, for as long as it took in the timing. Images
    are taken to be of the size of the table's.
    """
    working = row.stepping + machine.images * row.seconds_per_image
    return machine.ratio * working + 2.0 * machine.startup


def choose(rows: Sequence[Row], machine: Machine, seconds: float) -> Choice:
    """Returns the point with the highest PSNR that fits, and its neighbours on the Pareto front.

    Raises:
      ValueError: if none fits.
    """
    front = trade_table.pareto(rows, lambda row: seconds_of(row, machine))
    fitting = [row for row in front if seconds_of(row, machine) <= seconds]
    if not fitting:
        least = seconds_of(front[0], machine)
        raise ValueError(
            f"No measured point takes less than {least / 60:.1f} minutes here ({front[0].name}). "
            "Give more time, or a table with smaller points."
        )
    at = len(fitting) - 1
    return Choice(
        best=front[at],
        cheaper=front[at - 1] if at else None,
        dearer=front[at + 1] if at + 1 < len(front) else None,
    )


def told(choice: Choice, machine: Machine, scene: Path) -> list[str]:
    """Returns the recommendation, line by line."""
    best = choice.best
    out = f"runs/{scene.resolve().name}"
    evaluation = f" {best.evaluation}" if best.evaluation else ""
    lines = [
        "",
        f"Use {best.name}: {_expected(best, machine)}.",
        f"  python -m experiments.train --scene={scene} --out={out} {best.training}",
        f"  python -m experiments.evaluate --run={out} --split=test{evaluation}",
        "",
    ]
    for label, row in (("Cheaper", choice.cheaper), ("Dearer", choice.dearer)):
        if row is not None:
            options = " ".join(filter(None, (row.training, row.evaluation)))
            lines.append(f"{label}: {row.name}: {_expected(row, machine)}.\n  {options}")
    if choice.cheaper is None:
        lines.append("Cheaper: nothing was measured that takes less time.")
    if choice.dearer is None:
        lines.append(
            "Dearer: nothing was measured that gives more, so the time beyond it is of no use "
            "here. A sweep with longer or larger points may tell of some."
        )
    return lines


def _expected(row: Row, machine: Machine) -> str:
    where = "" if row.psnr_masked is None else " inside the mask"
    minutes = seconds_of(row, machine) / 60.0
    return f"about {minutes:.1f} minutes, {row.quality:.1f} dB{where} on {row.scene}"


if __name__ == "__main__":
    commands.run(main)
