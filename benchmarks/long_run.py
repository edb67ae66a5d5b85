"""Claim: a long training stays finite, and bfloat16 learns what float32 does.

    python -m benchmarks.long_run [--scene=FOLDER] [--steps=20000] [--paths=tree]

Trains --steps steps of the preset and asserts that no line of metrics and no parameter of the last
checkpoint has a NaN or an infinity. Then trains --curve_steps steps with the fields in float32 and
again in bfloat16, from the same seed on the same pixels, prints the PSNR of both side by side, and
asserts that they end less than 0.5 dB apart. Each PSNR is the mean over the batches logged in an
interval, since a single batch of a thousand pixels is too noisy.

An interrupted benchmark resumes where it stopped.
"""

import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from absl import app, flags, logging

from experiments.runs import measured_runs
from refref_jax.optics.path_settings import PATH_PRESETS
from refref_jax.render.checkpoint_io import load_model
from refref_jax.training import run_folder
from refref_jax.training.presets import PRESETS

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Folder of the scene.")
_PRESET = flags.DEFINE_enum("preset", "tiny", list(PRESETS), "Preset of all trainings.")
_PATHS = flags.DEFINE_enum("paths", "tree", list(PATH_PRESETS), "Path settings of all trainings.")
_STEPS = flags.DEFINE_integer("steps", 20_000, "Steps of the long training; 0 for none.", 0)
_CURVE_STEPS = flags.DEFINE_integer("curve_steps", 2500, "Steps in each precision; 0 for none.", 0)
_OUT = flags.DEFINE_string("out", "runs/long_run", "Output folder of the runs.")

_PRECISIONS = ("float32", "bfloat16")

# Largest difference of the final PSNR, in decibels.
_APART = 0.5

# Number of lines of a printed curve.
_INTERVALS = 10

# Number of logged lines per curve, enough to average out the noise of single batches.
_LINES = 20 * _INTERVALS


def main(arguments: list[str]) -> None:
    del arguments
    # Suppresses thirty lines of logs on reading a checkpoint.
    logging.set_verbosity(logging.ERROR)
    if _STEPS.value:
        check_finite(_train("float32", _STEPS.value))
    if _CURVE_STEPS.value:
        runs = [_train(precision, _CURVE_STEPS.value) for precision in _PRECISIONS]
        compare(*[curve(run_folder.read_metrics(run), _CURVE_STEPS.value) for run in runs])


def _train(precision: str, steps: int) -> Path:
    """Trains a run, or resumes it; a finished one is reused."""
    scene = Path(_SCENE.value)
    name = f"{_PRESET.value}_{_PATHS.value}_{precision}_{steps}"
    run = Path(_OUT.value) / scene.resolve().name / name
    options = [f"--preset={_PRESET.value}", f"--paths={_PATHS.value}"]
    options += [f"--precision={precision}", f"--steps={steps}"]
    print(f"{scene.resolve().name}: {precision}, {steps} steps ...", flush=True)
    measured_runs.train(run, scene=scene, options=options, log_every=max(1, steps // _LINES))
    return run


def check_finite(run: Path) -> None:
    """Asserts that all metrics of a run, and the parameters of its last checkpoint, are finite."""
    lines = run_folder.read_metrics(run)
    for line in lines:
        broken = [name for name, value in line.items() if not math.isfinite(float(value))]
        assert not broken, f"step {line['step']}: {', '.join(broken)} not finite"
    leaves = jax.tree_util.tree_leaves_with_path(load_model(run).params)
    for path, leaf in leaves:
        assert np.isfinite(leaf).all(), f"{jax.tree_util.keystr(path)} is not finite"
    numbers = sum(leaf.size for _, leaf in leaves)
    largest = max(float(np.abs(leaf).max()) for _, leaf in leaves)
    print(
        f"{lines[-1]['step']} steps: {len(lines)} lines of metrics and {numbers} parameters are "
        f"finite, the largest {largest:.3g}. Dropped throughput: at most "
        f"{max(line['dropped'] for line in lines):.2g}."
    )


def curve(lines: Sequence[dict[str, Any]], steps: int) -> list[tuple[int, float]]:
    """Returns the mean PSNR of each interval of a training, with the step at its end."""
    ends = [round(steps * (i + 1) / _INTERVALS) for i in range(_INTERVALS)]
    points, begin = [], 0
    for end in ends:
        within = [float(line["psnr"]) for line in lines if begin < line["step"] <= end]
        if within:
            points.append((end, statistics.mean(within)))
        begin = end
    return points


def compare(wide: Sequence[tuple[int, float]], narrow: Sequence[tuple[int, float]]) -> None:
    """Prints two curves side by side, and asserts that their ends agree."""
    print("\n| step | float32: PSNR | bfloat16: PSNR | difference |")
    print("|---|---|---|---|")
    for (step, first), (_, second) in zip(wide, narrow, strict=True):
        print(f"| {step} | {first:.2f} | {second:.2f} | {second - first:+.2f} |")
    apart = narrow[-1][1] - wide[-1][1]
    assert abs(apart) < _APART, f"bfloat16 ends {apart:+.2f} dB from float32"


if __name__ == "__main__":
    app.run(main)
