"""Trains and evaluates runs through the command line, and measures their cost and quality.

Each training and each evaluation is a separate process, as for a user: nothing is compiled
beforehand, and the peak memory is its own. Measurements are stored in the run's folder, in
`measured.json`, and reused while their options are the same.
"""

import dataclasses
import itertools
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.runs import subprocesses
from refref_jax import atomic_files, configuration
from refref_jax.data import scene_folder
from refref_jax.render import checkpoint_io
from refref_jax.training import run_folder

_MEASURED = "measured.json"

# Steps between two lines of metrics: whole batches of pre-traced paths (32 steps), so that each
# interval includes its share of the tracing.
_LOG_EVERY = 64

_MIB = 2.0**20


@dataclasses.dataclass(frozen=True)
class Training:
    """Cost of a training.

    Attributes:
      steps: number of steps.
      seconds_per_step: median over the logged intervals, without the first, which includes
        compilation; of a backdrop the mean over its iterations after the first, since those that
        begin a round take longer.
      rays_per_second: batch size divided by `seconds_per_step`; `None` for a backdrop, whose
        iterations have no batches.
      train_seconds: duration of all steps, compilation included.
      startup_seconds: remaining duration of the process at that pace: startup, reading,
        compilation, saving; of a backdrop without compilation, which `train_seconds` includes. Too
        small if the training was resumed.
      peak_host_mib: largest resident set of the process; `None` if it had ended before, unmeasured.
      peak_device_mib: largest memory of the accelerator; `None` if there is none.
    """

    steps: int
    seconds_per_step: float
    rays_per_second: float | None
    train_seconds: float
    startup_seconds: float
    peak_host_mib: float | None
    peak_device_mib: float | None


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Quality of a run: means over images; `None` if the scene lacks the reference.

    Attributes with a default were added later: they are `None` in older evaluations.

    Attributes:
      psnr: PSNR over the image, dB.
      psnr_masked: PSNR inside the mask, dB.
      ssim: structural similarity; `None` for images smaller than its window.
      distance_mae: mean absolute error of the distance, world units, for the median of the weights.
      distance_mae_masked: the same inside the mask.
      seconds_per_image: rendering time, without compilation.
      images: number of rendered images.
      lpips: LPIPS of the images; `None` without its weights.
      flip: FLIP error of the images; `None` if the package is not installed.
      distance_rmse: root mean square error of the distance; likewise for the following attributes,
        whose three kinds of distances are explained in `refref_jax.training.evaluation`.
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
    """Trains a run or resumes it; reads its cost if it is finished.

    Args:
      run: folder of the run.
      scene: scene to train on.
      options: further flags of `experiments.train` that affect the result.
      log_every: steps per timed interval; about a quarter of a short training if `None`.

    Raises:
      RunFailedError: if training fails.
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
    """Evaluates a trained run, or reads the result of an evaluation with the same options.

    Raises:
      RunFailedError: if the evaluation fails.
    """
    known = _read(run)
    asked = [f"--split={split}", *options]
    key = " ".join(asked)
    if key not in known.get("evaluations", {}):
        # There may be an evaluation with other options.
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
    """Rejects a scene whose images have no masks, before training starts.

    Raises:
      ValueError: if masks are missing.
    """
    if scene_folder.read_frames(scene, split).masks is None:
        raise ValueError(
            f"The {split} images of {scene} have no masks. Add mask_file_path to their frames, as "
            "metrics are computed inside the masks."
        )


def read_training(run: Path, *, wall: float, peak_host_mib: float | None) -> Training:
    """Reads the cost of a finished training from its metrics.

    Args:
      run: folder of the run.
      wall: duration of its process, seconds.
      peak_host_mib: largest resident set of that process, or `None` if unknown.
    """
    lines = run_folder.read_metrics(run)
    last = lines[-1]
    config = run_folder.read_config(run)
    backdrop = config.model.far_field == "backdrop"
    pace = seconds_per_step([lines[0], last] if backdrop and len(lines) > 1 else lines)
    device = last.get("peak_device_bytes")
    working = last["seconds"] if backdrop else last["step"] * pace
    return Training(
        steps=last["step"],
        seconds_per_step=pace,
        rays_per_second=None if backdrop else config.schedule.batch / pace,
        train_seconds=last["seconds"],
        startup_seconds=max(0.0, wall - working),
        peak_host_mib=peak_host_mib,
        peak_device_mib=None if device is None else device / _MIB,
    )


def seconds_per_step(lines: Sequence[dict[str, Any]]) -> float:
    """Returns the median pace between lines of metrics, without the first, which compiles.

    A training with a single line has no other interval, so its pace includes compilation.
    """
    pairs = itertools.pairwise(lines)
    paces = [(b["seconds"] - a["seconds"]) / (b["step"] - a["step"]) for a, b in pairs]
    return statistics.median(paces) if paces else lines[0]["seconds"] / lines[0]["step"]


def _has_ended(run: Path, steps: int | None) -> bool:
    """Returns whether a run is finished, so that training it takes no time."""
    lines = run_folder.read_metrics(run)
    if not lines:
        return False
    model = run_folder.read_config(run).model
    if model.far_field == "backdrop":  # whose solver may end before its last iteration
        return (run / checkpoint_io.CHECKPOINTS / str(model.iterations)).is_dir()
    return lines[-1]["step"] == steps


def _steps_in(options: Sequence[str]) -> int | None:
    given = [option.partition("=")[2] for option in options if option.startswith("--steps=")]
    return int(given[-1]) if given else None


def _read(run: Path) -> dict[str, Any]:
    path = run / _MEASURED
    return scene_folder.read_json(path) if path.is_file() else {}


def _write(run: Path, record: dict[str, Any]) -> None:
    with atomic_files.written_file(run / _MEASURED) as draft:
        draft.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
