"""Configurations as files: the `config.json` of a run, or a part of one (without JAX).

A reconstruction that lies in the folder of the run, or beside that folder, is written as seen from
the run, so that both can move together. In memory its path is always one that can be opened.
"""

import os
from pathlib import Path
from typing import Any

from refref_jax import configuration
from refref_jax.training.config import TrainConfig

CONFIG = "config.json"
"""What makes a folder that of a run."""

# Of configurations that earlier versions wrote, beside those that are still there.
_KEYS_BEFORE = {"loss", "batch", "pool"}


def write(path: Path, config: TrainConfig) -> None:
    """Writes the configuration of a run, all or nothing."""
    made = config.scene.reconstruction
    if made:
        folder, run = Path(made).resolve(), path.parent.resolve()
        near = folder.is_relative_to(run.parent)
        made = Path(os.path.relpath(folder, run)).as_posix() if near else str(folder)
    configuration.write(path, config.decided(reconstruction=made))


def read(path: Path) -> TrainConfig:
    """Reads a configuration of this version, complete or partial.

    Raises:
      ValueError: if the file is missing, or is not one.
    """
    config = configuration.read(path, TrainConfig)
    made = config.scene.reconstruction
    if not made or Path(made).is_absolute():
        return config
    near = Path(os.path.normpath(path.parent.resolve() / made))
    # Written by hand, it may be as seen from the working directory, as a flag is.
    meant = Path(made) if Path(made).is_dir() and not near.is_dir() else near
    return config.decided(reconstruction=str(meant))


def read_to_begin(path: Path) -> TrainConfig:
    """Reads a configuration to begin a run with, complete or partial.

    Raises:
      ValueError: if the file is missing, or is not one, or is that of an earlier version's run.
    """
    if not path.is_file():
        raise ValueError(f"{path} is not a file. Give a configuration, as a run's {CONFIG}.")
    if of_an_earlier_version(path) is not None:
        raise ValueError(
            f"{path} is of an earlier version, and does not name the preset. Its run can be "
            "resumed, evaluated and rendered, but not begun again: give the options themselves."
        )
    return read(path)


def of_an_earlier_version(path: Path) -> dict[str, Any] | None:
    """Returns what the configuration of an earlier version says; `None` if it is not one."""
    try:
        content = configuration.parse_json(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError):
        return None  # `configuration.read` says what is wrong
    is_earlier = isinstance(content, dict) and set(content) >= _KEYS_BEFORE
    return content if is_earlier else None
