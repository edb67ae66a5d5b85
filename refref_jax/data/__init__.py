"""Scenes on disk: images, cameras, meshes. NumPy only, without a device."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from refref_jax import configuration

ALLOW_OUTSIDE = "REFREF_ALLOW_OUTSIDE"
"""Environment variable: if it is set, files may name files outside of their scene's folder."""

FARTHEST = 1e6
"""Largest coordinate of a scene, world units: beyond it single precision resolves no tenth."""

_LONGEST_NAME = 1024


class SceneError(ValueError):
    """A file of a scene is missing, broken or contradicts another.

    The message names the file and the remedy.
    """


def file_inside(folders: Sequence[Path], name: Any, *, where: str, path: Path) -> Path:
    """Returns the path of a file that another file names, relative to the first folder.

    Symbolic links in the folders are followed.

    Args:
      folders: folders in one of which the file has to be, unless `ALLOW_OUTSIDE` is set.
      name: name of the file, as read.
      where: key of the name, for messages.
      path: path of the file that names it, for messages.

    Raises:
      SceneError: if the name is not text, cannot be the name of a file, or leads outside.
    """
    shown = configuration.abridged(name)
    try:
        plain = configuration.convert(name, str, name=where)
    except ValueError as error:
        raise SceneError(f"{path}: {where} is {shown}. Use the name of a file.") from error
    if not 0 < len(plain) <= _LONGEST_NAME:
        raise SceneError(f"{path}: {where} is {shown}. Use the name of a file, as in train/r_000.")
    found = os.path.abspath(folders[0] / plain)
    inside = any(Path(found).is_relative_to(os.path.abspath(folder)) for folder in folders)
    inside |= any(Path(found).resolve().is_relative_to(folder.resolve()) for folder in folders)
    if not inside and os.environ.get(ALLOW_OUTSIDE) != "1":
        raise SceneError(
            f"{path}: {where} is {shown}, which is outside of {folders[0]}. Move the file there, "
            f"or, if you trust this scene, use --allow_outside (in Python, set {ALLOW_OUTSIDE}=1)."
        )
    return folders[0] / plain
