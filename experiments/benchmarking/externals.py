"""Reads `--external=NAME=FOLDER`: renderings of a method that this package did not train.

They are measured like the results of trained methods, see `experiments.runs.renderings` for the
files. A folder has one folder for each scene, under its name; that of a single scene may be given
itself. All files are checked before anything is trained.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from etils import epy

from experiments.benchmarking.methods import METHODS, RECONSTRUCTION

with epy.lazy_imports():
    from experiments.runs import renderings
    from refref_jax.data import scene_folder

OPTIONS = "external"
"""Key among the options of a record whose images were given; its value is their digest."""

# Names are those of folders, parts of `scene/method`, and keys of the report.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")

# The groups of --methods, the reference of the report, and the shared reconstruction.
_TAKEN = (*METHODS, RECONSTRUCTION, "main", "baselines", "ablations", "all", "truth")

# Length of a digest.
_LETTERS = 16


class External(NamedTuple):
    """A method whose renderings are given.

    Attributes:
      name: name in tables and folders.
      folder: folder with the renderings of all scenes, or of the only one.
    """

    name: str
    folder: str


def parse(words: Sequence[str]) -> list[External]:
    """Returns the methods of all flags, in order.

    Args:
      words: values of the flag, `NAME=FOLDER`.

    Raises:
      ValueError: if a value has another form, or a name is unsafe, taken or repeated.
    """
    found: dict[str, External] = {}
    for word in words:
        name, equals, folder = word.partition("=")
        if not equals or not name or not folder:
            raise ValueError(
                f"--external={word} is not NAME=FOLDER. Give both, as in --external=mine=renders."
            )
        if not _NAME.fullmatch(name):
            raise ValueError(
                f"--external={word} has the name {name!r}. Use at most 64 letters, digits, dots, "
                "hyphens and underscores, of which the first is a letter or a digit."
            )
        if name.casefold() in map(str.casefold, (*_TAKEN, *found)):
            owner = "another --external" if name.casefold() in map(str.casefold, found) else "ours"
            raise ValueError(
                f"The name {name} of --external={word} is taken by {owner}. Choose another name."
            )
        found[name] = External(name, str(Path(folder).absolute()))
    return list(found.values())


def folder_of(external: External, scene: str, *, alone: bool) -> Path:
    """Returns the folder with the renderings of a scene.

    Args:
      external: method whose renderings are given.
      scene: name of the scene.
      alone: whether it is the only scene, whose renderings may be in the method's folder itself.

    Raises:
      ValueError: if there is none.
    """
    whole = Path(external.folder)
    if not whole.is_dir():
        raise ValueError(
            f"{whole} of --external={external.name} is not a folder. Give the folder of its "
            "renderings."
        )
    if (whole / scene).is_dir():
        return whole / scene
    if alone:
        return whole
    raise ValueError(
        f"{whole} of --external={external.name} has no folder {scene}. Save the renderings of "
        "this scene there, or leave it out of --scenes."
    )


def digest(folder: Path, scene: Path, *, split: str, limit: int | None) -> str:
    """Checks the renderings of a scene, and returns a hash of their contents.

    Raises:
      ValueError: if a view is missing, or has another size than the scene's images.
    """
    found = renderings.find(folder, scene_folder.read_frames(scene, split), limit=limit)
    return renderings.digest(found)[:_LETTERS]
