"""Trains and evaluates runs through the command line, and says what they cost and gave.

Each training and each evaluation is a process of its own: as a user has it, with nothing compiled
before, and with a peak of memory that is its own. What has been measured is kept beside the run, in
`measured.json`, and is not measured again while its options are the same.
"""

import dataclasses
import itertools
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.cli import subprocesses
from refref_jax import atomic_files, configuration
from refref_jax.data import scene_folder
from refref_jax.training import run_folder

_MEASURED = "measured.json"

# Steps between two lines of metrics: whole pools of 32 batches, so that each interval has its share
# of the tracing.
_LOG_EVERY = 64

_MIB = 2.0**20


@dataclasses.dataclass(frozen=True)
class Training:
    """What a training cost.

    Attributes:
      steps: of it.
      seconds_per_step: median over its intervals, without the first, which also compiles.
      rays_per_second: batch over that.
      train_seconds: of all its steps, compiling included.
      startup_seconds: of its process beside the steps at that pace: starting, reading, compiling,
        saving. Too little if the training was resumed.
      peak_host_mib: largest resident set of its process; `None` if it had ended before, unmeasured.
      peak_device_mib: largest memory of its accelerator; `None` where there is none.
    """

    steps: int
    seconds_per_step: float
    rays_per_second: float
    train_seconds: float
    startup_seconds: float
    peak_host_mib: float | None
    peak_device_mib: float | None


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """What an evaluation gave: means over images; `None` for what the scene does not tell.

    What has a default was not measured always: it is `None` where an evaluation is older than it.

    Attributes:
      psnr: over the image, dB.
      psnr_masked: inside the mask.
      ssim: structural similarity; `None` for images smaller than its window.
      distance_mae: error of the distance, world units, by the median of the field's weights.
      distance_mae_masked: inside the mask.
      seconds_per_image: of rendering, without compiling.
      images: how many were rendered.
      lpips: distance of the images to a network; `None` without its weights.
      flip: difference of the images to an eye that flips between them; `None` if not installed.
      distance_rmse: root of the mean square of the distance's error, and so on for what follows;
        `refref_jax.training.evaluation` tells the three kinds of distances apart.
    """

    psnr: float
    psnr_masked: float | None
    ssim: float | None
    distance_mae: float | None
    distance_mae_masked: float | None
    seconds_per_image: float
    images: int
    lpips: float | None = None
    flip: float | None = None
    distance_rmse: float | None = None
    distance_rmse_masked: float | None = None
    surface_mae: float | None = None
    surface_mae_masked: float | None = None
    surface_rmse: float | None = None
    surface_rmse_masked: float | None = None
    substituted_mae: float | None = None
    substituted_mae_masked: float | None = None
    substituted_rmse: float | None = None
    substituted_rmse_masked: float | None = None


def train(
    run: Path, *, scene: Path, options: Sequence[str], log_every: int | None = None
) -> Training:
    """Trains a run, or goes on with it, or reads what it cost if it is finished.

    Args:
      run: its folder.
      scene: the scene.
      options: further ones of `experiments.train`; those that decide the result.
      log_every: steps of an interval that is timed; about a quarter of a short training if `None`.

    Raises:
      RunFailedError: if training ends with an error.
    """
    asked = [f"scene={scene.resolve()}", *options]
    known = _read(run)
    if known.get("asked") == asked:
        return Training(**known["training"])
    steps = _steps_in(options)
    every = log_every or min(_LOG_EVERY, max(1, (steps or 4 * _LOG_EVERY) // 4))
    command = [f"--scene={scene}", f"--out={run}", "--resume", f"--log_every={every}", *options]
    trained_before = _has_ended(run, steps)
    wall, peak = subprocesses.run("train", *command, log=run.with_name(f"{run.name}.log"))
    if trained_before:
        wall, peak = 0.0, None
    training = read_training(run, wall=wall, peak_host_mib=peak)
    _write(run, {"asked": asked, "training": dataclasses.asdict(training)})
    return training


def evaluate(
    run: Path, *, scene: Path, options: Sequence[str] = (), split: str = "test"
) -> Evaluation:
    """Evaluates a trained run, or reads what an evaluation with the same options gave.

    Raises:
      RunFailedError: if it ends with an error.
    """
    known = _read(run)
    asked = [f"--split={split}", *options]
    key = " ".join(asked)
    if key not in known.get("evaluations", {}):
        # One with other options may be there.
        command = [f"--run={run}", f"--scene={scene}", *asked, "--overwrite"]
        subprocesses.run("evaluate", *command, log=run.with_name(f"{run.name}.log"))
        summary = configuration.parse_json(
            (run / "eval" / split / "metrics.json").read_text("utf-8")
        )
        names = {field.name for field in dataclasses.fields(Evaluation)}
        results = configuration.from_string_safe(summary["results"])
        values = {name: x for name, x in results.items() if name in names}
        known.setdefault("evaluations", {})[key] = values | {"images": len(summary["per_image"])}
        _write(run, known)
    return Evaluation(**known["evaluations"][key])


def check_masks(scene: Path, split: str = "test") -> None:
    """Refuses a scene whose images have no masks, before anything is trained.

    Raises:
      ValueError: naming the scene.
    """
    if scene_folder.read_frames(scene, split).masks is None:
        raise ValueError(
            f"The {split} images of {scene} have no masks. Add mask_file_path to their frames: "
            "what is compared is inside them."
        )


def read_training(run: Path, *, wall: float, peak_host_mib: float | None) -> Training:
    """Reads what a finished training cost from its metrics.

    Args:
      run: its folder.
      wall: seconds that its process took.
      peak_host_mib: largest resident set of that process, if that is known.
    """
    lines = run_folder.read_metrics(run)
    last = lines[-1]
    pace = seconds_per_step(lines)
    batch = run_folder.read_config(run).schedule.batch
    device = last.get("peak_device_bytes")
    return Training(
        steps=last["step"],
        seconds_per_step=pace,
        rays_per_second=batch / pace,
        train_seconds=last["seconds"],
        startup_seconds=max(0.0, wall - last["step"] * pace),
        peak_host_mib=peak_host_mib,
        peak_device_mib=None if device is None else device / _MIB,
    )


def seconds_per_step(lines: Sequence[dict[str, Any]]) -> float:
    """Returns the median pace between lines of metrics; the first interval also compiles.

    A training of one line has no other, and its pace includes compiling.
    """
    pairs = itertools.pairwise(lines)
    paces = [(b["seconds"] - a["seconds"]) / (b["step"] - a["step"]) for a, b in pairs]
    return statistics.median(paces) if paces else lines[0]["seconds"] / lines[0]["step"]


def _has_ended(run: Path, steps: int | None) -> bool:
    """Returns whether a run of so many steps is finished, so that training it takes no time."""
    lines = run_folder.read_metrics(run)
    return bool(lines) and lines[-1]["step"] == steps


def _steps_in(options: Sequence[str]) -> int | None:
    given = [option.partition("=")[2] for option in options if option.startswith("--steps=")]
    return int(given[-1]) if given else None


def _read(run: Path) -> dict[str, Any]:
    path = run / _MEASURED
    return scene_folder.read_json(path) if path.is_file() else {}


def _write(run: Path, record: dict[str, Any]) -> None:
    with atomic_files.written_file(run / _MEASURED) as draft:
        draft.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
