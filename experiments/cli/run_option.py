"""How commands find the run that `--run` names, before anything that reads it is imported."""

from collections.abc import Sequence
from pathlib import Path

RUN = "config.json"
"""What the folder of a run holds."""

RECONSTRUCTION = "reconstruction.json"
"""What the folder of a reconstruction holds."""


def check(folder: Path, *, holds: Sequence[str] = (RUN,)) -> None:
    """Refuses a folder that is no run's.

    Args:
      folder: what the option names.
      holds: files by one of which it is known.

    Raises:
      ValueError: if it has none of them.
    """
    if not any((folder / name).is_file() for name in holds):
        raise ValueError(
            f"{folder / holds[0]} does not exist. Give the folder that a training wrote, as in "
            "--run=runs/demo."
        )
