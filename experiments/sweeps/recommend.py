"""Recommends training options for a time limit from a measured table; see `recommend`.

`combine` predicts the effect of several changes from their single effects: gains in dB are added,
and times per step and per image are multiplied. This treats options as independent, which is only
roughly true: two changes that fix the same error share its gain.
"""

import dataclasses
import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from experiments.cli import app
from experiments.runs import measured_runs
from experiments.runs.measured_runs import Training
from experiments.runs.subprocesses import RunFailedError
from experiments.sweeps import table
from experiments.sweeps.options import OF_EVALUATION
from experiments.sweeps.points import BASE
from experiments.sweeps.table import NOISE, Row
from refref_jax.data import scene_names

# Iterations of a timed backdrop: a round of its solver.
_ITERATIONS = 8

# Times within this ratio count as equal.
_SAME_TIME = 1.0 + table.TIME_NOISE / 100.0


@dataclasses.dataclass(frozen=True)
class Machine:
    """Speed of this machine relative to that of a table.

    Attributes:
      ratio: time of a step here over that in the table.
      startup: seconds that a command takes in addition to its steps: starting, compiling, saving.
      images: number of images that an evaluation renders.
    """

    ratio: float
    startup: float
    images: int


@dataclasses.dataclass(frozen=True)
class Choice:
    """Recommended points. Differences below `table.NOISE` are ignored.

    Attributes:
      best: the cheapest point in the time limit with the highest PSNR, up to noise; the base, if it
        is as good.
      cheaper: the best point that takes less time; `None` if there is none.
      dearer: the cheapest better point, over the time limit; `None` if none was measured.
      combined: expected joint gain of the single changes, if it exceeds that of the best; it was
        not measured.
    """

    best: Row
    cheaper: Row | None
    dearer: Row | None
    combined: Row | None


def time_machine(scene: Path, base: Row, steps: int) -> Training:
    """Trains the table's base point for a few steps, in a temporary folder.

    So few steps never repeat a pixel, and do not cache light paths: if the table's base does, the
    time per step is overestimated by up to a tenth. Of a backdrop, all views are traced and a round
    of iterations is timed, whatever the number of steps.
    """
    name, count = ("iterations", _ITERATIONS) if base.has_backdrop else ("steps", steps)
    options = [word for word in base.training.split() if not word.startswith(f"--{name}=")]
    with tempfile.TemporaryDirectory() as folder:
        try:
            return measured_runs.train(
                Path(folder) / "timing",
                scene=scene,
                options=[*options, f"--{name}={count}"],
                log_every=steps // 3,
            )
        except RunFailedError as error:
            # The log is deleted with the folder.
            raise ValueError(
                f"Timing the table's base point ({' '.join(options)}) failed: {error}. Give a "
                "table with a base that can be trained on this scene."
            ) from error


def compare(timing: Training, base: Row, images: int) -> Machine:
    """Returns the speed of this machine relative to the table's, from the same training on both."""
    return Machine(
        ratio=timing.seconds_per_step / base.seconds_per_step,
        startup=timing.startup_seconds,
        images=images,
    )


def seconds_of(row: Row, machine: Machine) -> float:
    """Returns the expected seconds to train and evaluate a point on this machine.

    Training and evaluation each start and compile once, which takes as long as it did in the
    timing. Images are assumed to have the size of the table's.
    """
    working = row.stepping + machine.images * row.seconds_per_image
    return machine.ratio * working + 2.0 * machine.startup


def choose(rows: Sequence[Row], machine: Machine, seconds: float) -> Choice:
    """Returns the point with the highest PSNR in the time limit, and its neighbours.

    Raises:
      ValueError: if no point fits the limit.
    """

    def cost(row: Row) -> float:
        return seconds_of(row, machine)

    front = table.pareto(rows, cost)
    fitting = [row for row in front if cost(row) <= seconds]
    if not fitting:
        raise ValueError(
            f"No measured point takes less than {cost(front[0]) / 60:.1f} minutes here "
            f"({front[0].name}). Give more time, or a table with smaller points."
        )
    enough = fitting[-1].quality - table.NOISE
    best = next(row for row in fitting if row.quality >= enough)
    base = table.base_of(rows)
    if base.quality >= enough and cost(base) <= min(seconds, cost(best) * _SAME_TIME):
        best = base
    more = best.quality + table.NOISE
    cheaper = [row for row in front if cost(row) * _SAME_TIME < cost(best)]
    combined = combine(rows, cost, seconds)
    return Choice(
        best=best,
        cheaper=cheaper[-1] if cheaper else None,
        dearer=next((row for row in front if row.quality > more and cost(row) > seconds), None),
        combined=combined if combined.quality > more else None,
    )


def describe(choice: Choice, machine: Machine, scene: Path) -> list[str]:
    """Returns the recommendation, line by line."""
    lines = ["", f"Use {choice.best.name}: {_expected(choice.best, machine)}."]
    lines += [*_commands(choice.best, scene), ""]
    if choice.combined is not None:
        lines += [
            f"Predicted from single changes, not measured together: "
            f"{choice.combined.name}: {_expected(choice.combined, machine)}.",
            *_commands(choice.combined, scene),
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
            "Dearer: the table has no better single point. Longer trainings and larger "
            "models were not measured: python -m experiments.trade_off can."
        )
    return lines


def _commands(row: Row, scene: Path) -> list[str]:
    run = f"runs/{scene_names.of_folder(scene)}"
    train = app.shell("train", f"--scene={scene}", f"--out={run}", *row.training.split())
    evaluate = app.shell("evaluate", f"--run={run}", "--split=test", *row.evaluation.split())
    return [f"  {train}", f"  {evaluate}"]


def _expected(row: Row, machine: Machine) -> str:
    where = "" if row.psnr_masked is None else " inside the mask"
    minutes = seconds_of(row, machine) / 60.0
    return f"about {minutes:.1f} minutes, {row.quality:.1f} dB{where} on {row.scene}"


def combine(rows: Sequence[Row], cost: Callable[[Row], float], most: float) -> Row:
    """Returns the base with the best predicted combination of changes within a time limit.

    Changes are added greedily by decibels per second, at most one of each option; those that gain
    no more than noise are ignored.

    Args:
      rows: rows of a table, with the base.
      cost: function that returns the seconds that a row takes.
      most: time limit, seconds.

    Returns:
      A predicted row, or the base itself. It may exceed the time limit if the base does.
    """
    base = table.base_of(rows)
    useful = [
        row
        for row in rows
        if row.quality > base.quality + NOISE and row.option not in ("paths", "far_field")
    ]
    chosen: list[Row] = []
    while True:
        now = _together(base, chosen)
        taken = {row.option for row in chosen}
        options = [
            (_worth(together, now, cost), index)
            for index, row in enumerate(useful)
            if row.option not in taken and cost(together := _together(base, [*chosen, row])) <= most
        ]
        if not options:
            return now
        chosen.append(useful[max(options)[1]])


def _worth(together: Row, now: Row, cost: Callable[[Row], float]) -> float:
    """Returns the decibels per second of a change."""
    gain, price = together.quality - now.quality, cost(together) - cost(now)
    return gain / price if price > 0.0 else math.inf


def _together(base: Row, turns: Sequence[Row]) -> Row:
    gain = sum(row.quality - base.quality for row in turns)
    pace, image, steps = base.seconds_per_step, base.seconds_per_image, base.steps
    training = base.train_seconds
    for row in turns:
        training *= row.train_seconds / base.train_seconds
        pace *= row.seconds_per_step / base.seconds_per_step
        image *= row.seconds_per_image / base.seconds_per_image
        steps = row.steps if row.option in ("steps", "iterations") else steps
    quality = {"psnr": base.psnr + sum(row.psnr - base.psnr for row in turns)}
    if base.psnr_masked is not None:
        quality["psnr_masked"] = base.psnr_masked + gain
    return dataclasses.replace(
        base,
        name=" ".join(row.name for row in turns) or BASE,
        training=_options(base.training, [row for row in turns if row.option not in OF_EVALUATION]),
        evaluation=_options(base.evaluation, [row for row in turns if row.option in OF_EVALUATION]),
        steps=steps,
        seconds_per_step=pace,
        train_seconds=training,
        seconds_per_image=image,
        **quality,
    )


def _options(base: str, turns: Sequence[Row]) -> str:
    options = dict(word.split("=", 1) for word in base.split())
    options |= {f"--{row.option}": row.value for row in turns}
    return " ".join(f"{name}={value}" for name, value in options.items())
