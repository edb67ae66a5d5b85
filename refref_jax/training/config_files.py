"""Reads and writes configurations as files: the `config.json` of a run, or a part of one (no JAX).

If a reconstruction is in the folder of the run, or next to that folder, its path is stored relative
to the run, so that both can be moved together. In memory, the path can always be opened.
"""

import os
from pathlib import Path
from typing import Any

from refref_jax import configuration
from refref_jax.training.config import BACKDROP_PIXELS, TrainConfig

CONFIG = "config.json"
"""Name of the file that marks a folder as a run."""

# Keys of configurations of earlier versions that no longer exist.
_KEYS_BEFORE = {"loss", "batch", "pool"}


def write(path: Path, config: TrainConfig) -> None:
    """Writes the configuration of a run atomically."""
    made = config.scene.reconstruction
    if made:
        folder, run = Path(made).resolve(), path.parent.resolve()
        near = folder.is_relative_to(run.parent)
        made = Path(os.path.relpath(folder, run)).as_posix() if near else str(folder)
    configuration.write(path, config.decided(reconstruction=made))


def read(path: Path) -> TrainConfig:
    """Reads a configuration of this version, complete or partial.

    Raises:
      ValueError: if the file is missing, or is not a configuration.
    """
    config = configuration.read(path, TrainConfig)
    if config.model.far_field is None and config.schedule.steps is not None:
        config = config.decided(far_field="field")  # of a version that knew nothing else
    if config.model.far_field == "backdrop" and config.schedule.steps is not None:
        usual = {"most_pixels": BACKDROP_PIXELS, "exposure": "fixed", "view_dependence": "none"}
        missing = {name: x for name, x in usual.items() if config.get(name) is None}
        config = config.decided(**missing)  # of a version that knew nothing else
    made = config.scene.reconstruction
    if not made or Path(made).is_absolute():
        return config
    near = Path(os.path.normpath(path.parent.resolve() / made))
    # In a file written by hand, the path may be relative to the working directory.
    meant = Path(made) if Path(made).is_dir() and not near.is_dir() else near
    return config.decided(reconstruction=str(meant))


def read_to_begin(path: Path) -> TrainConfig:
    """Reads a configuration to start a run with, complete or partial.

    Raises:
      ValueError: if the file is missing, is not a configuration, or is from a run of an earlier
        version.
    """
    if not path.is_file():
        raise ValueError(
            f"{path} is not a file. Give a configuration, such as the {CONFIG} of a run."
        )
    if of_an_earlier_version(path) is not None:
        raise ValueError(
            f"{path} is from an earlier version, and lacks the preset. Its run can be resumed, "
            "evaluated and rendered, but not started again: give the options themselves."
        )
    return read(path)


def of_an_earlier_version(path: Path) -> dict[str, Any] | None:
    """Returns the content of a configuration of an earlier version; `None` for any other file."""
    try:
        content = configuration.parse_json(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError):
        return None  # `configuration.read` raises the error
    is_earlier = isinstance(content, dict) and set(content) >= _KEYS_BEFORE
    return content if is_earlier else None
