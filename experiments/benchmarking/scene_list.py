"""The scenes that a benchmark's option names."""

import glob
from collections.abc import Sequence
from pathlib import Path

from experiments.benchmarking import fingerprints
from experiments.benchmarking.settings import Scene
from experiments.cli import scenes as cli_scenes
from refref_jax.data import scene_names


def find(words: Sequence[str]) -> list[Scene]:
    """Returns scenes in the order of their names.

    Args:
      words: folders, with wildcards or without, or `hf:CONFIG/SCENE`. What a wildcard matches and
        is no scene is passed over.

    Raises:
      ValueError: if there is none, if a folder holds none, or two have one name.
    """
    folders = [folder for word in words if word for folder in _folders(word.strip())]
    if not folders:
        raise ValueError(
            f"--scenes={','.join(words)} names no scene. Give folders that hold "
            "transforms_train.json, as in --scenes='scenes/*'."
        )
    found: dict[str, Scene] = {}
    for folder in dict.fromkeys(folder.resolve() for folder in folders):
        name = scene_names.of_folder(folder)
        if name in found:
            raise ValueError(
                f"Both {found[name].path} and {folder} are named {name}. Rename one of them."
            )
        found[name] = Scene(name, str(folder), fingerprints.fingerprint(folder))
    return [found[name] for name in sorted(found)]


def _folders(word: str) -> list[Path]:
    if cli_scenes.has_wildcards(word):
        return [Path(path) for path in sorted(glob.glob(word)) if _is_scene(Path(path))]
    folder = cli_scenes.opened(word)
    if not _is_scene(folder):
        raise ValueError(
            f"{folder} is no scene: it holds no transforms_train.json. Give the folder of one."
        )
    return [folder]


def _is_scene(folder: Path) -> bool:
    return (folder / "transforms_train.json").is_file()
