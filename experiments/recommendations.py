"""What to train with in the time that there is, from a measured table; see `recommend`."""

import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path

from experiments import trade_table, trained_runs
from experiments.child_process import RunFailedError
from experiments.trade_table import Row
from experiments.trained_runs import Training
from refref_jax.data import scene_names


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


def time_machine(scene: Path, base: Row, steps: int) -> Training:
    """Trains the table's base point for a few steps, in a folder that is deleted again.

    So few steps see no pixel twice, and keep no light paths: where the table's base does, a step is
    taken to be up to a tenth slower here than it will be.
    """
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
    out = f"runs/{scene_names.of_folder(scene)}"
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
