"""The measured trade-off between speed and accuracy: its table, Pareto front and summary."""

import csv
import dataclasses
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from experiments.sweeps.options import OF_EVALUATION, present_name
from experiments.sweeps.points import BASE
from refref_jax import atomic_files

NOISE = 0.3
"""Typical difference in decibels between equivalent trainings; see `BUILD_NOTES.md`."""

TIME_NOISE = 3.0
"""Differences of times below this percentage are noise, on an otherwise idle machine."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A measured point; undocumented fields are those of `measured_runs`.

    Attributes:
      scene: name of the scene's folder.
      name: name of the point.
      option: option that differs from the base; empty for the base.
      value: value of that option.
      training: options of `experiments.train`, separated by blanks.
      evaluation: options of `experiments.evaluate`, likewise.
    """

    scene: str
    name: str
    option: str
    value: str
    training: str
    evaluation: str
    steps: int
    seconds_per_step: float
    rays_per_second: float | None
    train_seconds: float
    startup_seconds: float
    peak_host_mib: float | None
    peak_device_mib: float | None
    psnr: float
    psnr_masked: float | None
    ssim: float
    distance_mae: float | None
    distance_mae_masked: float | None
    seconds_per_image: float
    images: int

    @property
    def quality(self) -> float:
        """Masked PSNR in dB, or PSNR of the image if there are no masks."""
        return self.psnr if self.psnr_masked is None else self.psnr_masked

    @property
    def has_backdrop(self) -> bool:
        """Whether a backdrop was solved for; its steps are iterations."""
        return "--far_field=backdrop" in self.training.split()

    @property
    def stepping(self) -> float:
        """Seconds of all steps, without compiling.

        Of a backdrop they include compiling, since tracing the images, which no iteration
        includes, is not measured apart from it.
        """
        return self.train_seconds if self.has_backdrop else self.steps * self.seconds_per_step


class Turn(NamedTuple):
    """Effect of changing one option.

    Attributes:
      row: the changed point.
      gain: dB over the base.
      percent: additional time relative to the base: training time or, for an option of evaluation,
        rendering time.
    """

    row: Row
    gain: float
    percent: float


def write(path: Path, rows: Sequence[Row]) -> None:
    """Writes a table as CSV, atomically; unknown values stay empty."""
    with (
        atomic_files.written_file(path) as draft,
        draft.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(field.name for field in dataclasses.fields(Row))
        writer.writerows(dataclasses.astuple(row) for row in rows)


def read(path: Path) -> list[Row]:
    """Reads a table written by `write`.

    Raises:
      ValueError: if the file does not exist, or is not such a table.
    """
    if not path.is_file():
        raise ValueError(
            f"There is no table {path}. Measure one with python -m experiments.trade_off, and give "
            "it with --table=DIR/trade_off.csv."
        )
    with path.open(newline="", encoding="utf-8") as file:
        records = list(csv.DictReader(file))
    kinds = typing.get_type_hints(Row)
    try:
        rows = [
            Row(**{name: _parse(record[name], kind) for name, kind in kinds.items()})
            for record in map(_with_present_names, records)
        ]
    except (KeyError, ValueError, TypeError) as error:
        raise ValueError(
            f"{path} is not a table of experiments.trade_off ({error!r}). Give another file."
        ) from error
    if not any(row.name == BASE for row in rows):
        raise ValueError(
            f"{path} has no row of the base point. Measure it with experiments.trade_off."
        )
    return rows


def _with_present_names(record: dict[str, str]) -> dict[str, str]:
    """Renames the columns and options of a table of an earlier version."""
    flags = [present_name(flag.removeprefix("--")) for flag in record["training"].split()]
    return record | {
        "name": present_name(record["name"]),
        "option": present_name(record.get("option", record.get("knob", ""))),
        "training": " ".join(f"--{flag}" for flag in flags),
    }


def pareto(
    rows: Sequence[Row],
    cost: Callable[[Row], float],
    quality: Callable[[Row], float] = lambda row: row.quality,
) -> list[Row]:
    """Returns the Pareto front of cost and quality, cheapest first."""
    front: list[Row] = []
    for row in sorted(rows, key=lambda row: (cost(row), -quality(row))):
        if not front or quality(row) > quality(front[-1]):
            front.append(row)
    return front


def base_of(rows: Sequence[Row]) -> Row:
    """Returns the row of the base point."""
    return next(row for row in rows if row.name == BASE)


def turns(rows: Sequence[Row]) -> list[Turn]:
    """Returns the effect of each change, relative to the base."""
    base = base_of(rows)
    found = []
    for row in rows:
        if row.option:
            cost = _rendering if row.option in OF_EVALUATION else _training
            percent = 100.0 * (cost(row) / cost(base) - 1.0)
            found.append(Turn(row, row.quality - base.quality, percent))
    return found


def worth_turning(found: Sequence[Turn]) -> list[Turn]:
    """Returns the best change of each option that gains more than noise, most worthwhile first.

    Changes without additional time come first, sorted by their gain. The others follow, sorted by
    decibels per percent of time.
    """
    gaining = [turn for turn in found if turn.gain > NOISE]
    return _best_of_each(
        gaining, lambda turn: _rate(turn.gain, 0.0 if is_free(turn) else turn.percent)
    )


def is_free(turn: Turn) -> bool:
    """Returns whether a change takes no additional time, to within the noise of timings."""
    return turn.percent <= TIME_NOISE


def worth_saving(found: Sequence[Turn]) -> list[Turn]:
    """Returns the best change of each option that saves time and gains nothing, cheapest first.

    Changes that lose no more than noise come first, sorted by the time that they save. The others
    follow, sorted by the percent of time that they save per decibel lost.
    """
    saving = [turn for turn in found if turn.percent < -TIME_NOISE and turn.gain <= NOISE]

    def worth(turn: Turn) -> tuple[bool, float]:
        return _rate(-turn.percent, -turn.gain if turn.gain < -NOISE else 0.0)

    return _best_of_each(saving, worth)


def _rate(gain: float, price: float) -> tuple[bool, float]:
    """Returns a sort key by gain per price; free changes rank above all."""
    return (True, gain) if price <= 0.0 else (False, gain / price)


def _best_of_each(found: Sequence[Turn], worth: Callable[[Turn], tuple[bool, float]]) -> list[Turn]:
    best: dict[str, Turn] = {}
    for turn in sorted(found, key=worth, reverse=True):
        best.setdefault(turn.row.option, turn)
    return list(best.values())


def _training(row: Row) -> float:
    return row.stepping


def _rendering(row: Row) -> float:
    return row.seconds_per_image


def _parse(text: str, kind: object) -> object:
    if kind is str:
        return text
    if kind is int:
        return int(text)
    return None if kind == float | None and text == "" else float(text)
