"""What a run writes: configuration, model and metrics, all readable text.

{run}/config.json      the resolved `TrainingConfig`
{run}/model.json       see `render.saved`
{run}/metrics.jsonl    one line for every logged step
"""

import json
from pathlib import Path
from typing import Any

from refref_jax import configuration
from refref_jax.optics.wavefront import Geometry
from refref_jax.render import saved
from refref_jax.render.saved import SavedModel
from refref_jax.training.config import TrainingConfig

_CONFIG = "config.json"
_METRICS = "metrics.jsonl"


def exists(run: Path) -> bool:
    """Returns whether a folder holds a run."""
    return (run / _CONFIG).is_file()


def create(run: Path, config: TrainingConfig, model: SavedModel, geometry: Geometry) -> None:
    """Opens a new run; the configuration comes last, so that a half-made folder is no run.

    Raises:
      ValueError: if the folder holds a run already.
    """
    if exists(run):
        raise ValueError(
            f"{run} holds a run already. Continue it with --resume, or give another --out."
        )
    run.mkdir(parents=True, exist_ok=True)
    saved.save_scene(run, model, geometry)
    configuration.write(run / _CONFIG, config)


def read_config(run: Path) -> TrainingConfig:
    """Reads the configuration of a run."""
    return configuration.read(run / _CONFIG, TrainingConfig)


def check_unchanged(run: Path, config: TrainingConfig, model: SavedModel) -> None:
    """Checks that a run was made with this very configuration.

    Raises:
      ValueError: if not.
    """
    if read_config(run) != config or saved.read_static(run) != model:
        raise ValueError(
            f"{run} was begun with other options than the ones given now. Give --out and "
            "--resume alone to continue it as it was, or choose another --out."
        )


def append_metrics(run: Path, line: dict[str, Any]) -> None:
    """Adds one line to the metrics."""
    with (run / _METRICS).open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def rewind_metrics(run: Path, step: int) -> float:
    """Drops the lines after a step, which a resumed run will write again.

    Returns:
      The seconds of training that the kept lines account for.
    """
    path = run / _METRICS
    if not path.is_file():
        return 0.0
    lines = [json.loads(text) for text in path.read_text(encoding="utf-8").splitlines()]
    kept = [line for line in lines if line["step"] <= step]
    path.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="utf-8")
    return kept[-1]["seconds"] if kept else 0.0
