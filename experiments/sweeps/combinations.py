"""Several turns of a measured table at once, by what each gave alone.

A guess that is told as one: gains in dB are added, and times of a step and of an image multiplied.
Knobs are taken for independent, which they are only roughly: two that mend the same error share its
gain.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence

from experiments.sweeps import table as trade_table
from experiments.sweeps.points import BASE, OF_EVALUATION
from experiments.sweeps.table import NOISE, Row


def combine(rows: Sequence[Row], cost: Callable[[Row], float], most: float) -> Row:
    """Returns the base with the turns that promise most in the time there is.

    Turn after turn is added, always the one that gives most decibels for its time, at most one of
    each knob; one that gives no more than noise is none.

    Args:
      rows: a table, with the base.
      cost: seconds that a row takes.
      most: seconds that there are.

    Returns:
      A row that was not measured, or the base itself. It may take longer than there is time, if
      the base does.
    """
    base = trade_table.base_of(rows)
    useful = [row for row in rows if row.quality > base.quality + NOISE and row.knob != "paths"]
    chosen: list[Row] = []
    while True:
        now = _together(base, chosen)
        taken = {row.knob for row in chosen}
        options = [
            (_worth(together, now, cost), index)
            for index, row in enumerate(useful)
            if row.knob not in taken and cost(together := _together(base, [*chosen, row])) <= most
        ]
        if not options:
            return now
        chosen.append(useful[max(options)[1]])


def _worth(together: Row, now: Row, cost: Callable[[Row], float]) -> float:
    """Returns the decibels that a turn gives for a second."""
    gain, price = together.quality - now.quality, cost(together) - cost(now)
    return gain / price if price > 0.0 else math.inf


def _together(base: Row, turns: Sequence[Row]) -> Row:
    gain = sum(row.quality - base.quality for row in turns)
    pace, image, steps = base.seconds_per_step, base.seconds_per_image, base.steps
    for row in turns:
        pace *= row.seconds_per_step / base.seconds_per_step
        image *= row.seconds_per_image / base.seconds_per_image
        steps = row.steps if row.knob == "steps" else steps
    quality = {"psnr": base.psnr + sum(row.psnr - base.psnr for row in turns)}
    if base.psnr_masked is not None:
        quality["psnr_masked"] = base.psnr_masked + gain
    return dataclasses.replace(
        base,
        name=" ".join(row.name for row in turns) or BASE,
        training=_options(base.training, [row for row in turns if row.knob not in OF_EVALUATION]),
        evaluation=_options(base.evaluation, [row for row in turns if row.knob in OF_EVALUATION]),
        steps=steps,
        seconds_per_step=pace,
        seconds_per_image=image,
        **quality,
    )


def _options(base: str, turns: Sequence[Row]) -> str:
    options = dict(word.split("=", 1) for word in base.split())
    options |= {f"--{row.knob}": row.value for row in turns}
    return " ".join(f"{name}={value}" for name, value in options.items())
