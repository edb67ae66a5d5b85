"""Where the files of the published data set are: in local copies, or on Hugging Face (NumPy only).

    data/{scene}-00000-of-00002.parquet       or {config}/ instead of data/
    mesh_files/{category}/{object}_{material}.ply
    scene_files/{scene}/...                   scene.json, meshes/, textures: all else of its folder

The first are of the repository `yinyue27/RefRef`, the second of `yinyue27/RefRef_additional`; the
last are of our own conversions alone, and go before the second.
A name here is a path below such a repository, with slashes.
"""

import hashlib
import importlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from refref_jax.data import scene_names
from refref_jax.data.errors import SceneError
from refref_jax.data.meshes import published_stems
from refref_jax.data.scene_names import CATEGORIES, CONFIGS, SceneName

REPOSITORIES = ("yinyue27/RefRef", "yinyue27/RefRef_additional")

_FOLDERS = ("data", *CONFIGS, "mesh_files", "scene_files")

_SHARD = re.compile(rf"({'|'.join(_FOLDERS[:-2])})/(.+)-(\d+)-of-(\d+)\.parquet")


class LocalCopy:
    """Folders that together hold what the published repositories do, or a part of it.

    Attributes:
      where: how messages call it.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        """Lists the files.

        Raises:
          SceneError: if a folder does not exist.
        """
        self.where = ", ".join(map(str, folders))
        self._paths: dict[str, Path] = {}
        for folder in folders:
            if not folder.is_dir():
                raise SceneError(
                    f"{folder} is no folder, but should hold a scene or a copy of the data set. "
                    "Correct what named it: the scene, or REFREF_HF."
                )
            for path in (path for place in _FOLDERS for path in (folder / place).rglob("*")):
                if path.is_file():
                    self._paths.setdefault(path.relative_to(folder).as_posix(), path)

    def names(self) -> list[str]:
        """Returns the names of all files."""
        return sorted(self._paths)

    def fetch(self, name: str) -> Path:
        """Returns where a file is."""
        return self._paths[name]

    def key(self, scene: SceneName) -> str:
        """Returns a name of a folder, another one where the scene's files are others."""
        names = [*find_shards(self, scene), *find_others(self, scene).values()]
        stats = [(self._paths[name].resolve(), self._paths[name].stat()) for name in names]
        text = "\n".join(f"{path} {stat.st_size} {stat.st_mtime_ns}" for path, stat in stats)
        return hashlib.sha256(text.encode()).hexdigest()[:12]


class Hub:
    """The published repositories, downloaded file by file.

    Attributes:
      where: how messages call it.
    """

    where = "huggingface.co"

    def __init__(self) -> None:
        """Finds the user's `huggingface_hub`.

        Raises:
          SceneError: if it is not installed.
        """
        try:
            self._hub: Any = importlib.import_module("huggingface_hub")
        except ImportError as error:
            raise SceneError(
                "There is neither a local copy of the data set nor huggingface_hub to download it. "
                "Set REFREF_HF to the folder of a copy, or pip install huggingface_hub."
            ) from error
        self._owners: dict[str, str] = {}

    def names(self) -> list[str]:
        """Returns the names of all files."""
        for repository in REPOSITORIES if not self._owners else ():
            for name in self._try(
                self._hub.HfApi().list_repo_files, repository, repo_type="dataset"
            ):
                self._owners.setdefault(name, repository)
        return sorted(self._owners)

    def fetch(self, name: str) -> Path:
        """Returns where a file is on this machine, and downloads it if need be."""
        self.names()
        download = self._hub.hf_hub_download
        return Path(self._try(download, self._owners[name], name, repo_type="dataset"))

    def key(self, scene: SceneName) -> str:
        """Returns a name of a folder: always one, so that it can be found without a network."""
        del scene
        return "huggingface"

    def _try(self, call: Any, repository: str, *arguments: str, **options: str) -> Any:
        try:
            return call(repository, *arguments, **options)
        except Exception as error:  # whatever the network, the service and its client raise
            raise SceneError(
                f"{' '.join((repository, *arguments))} can not be had from {self.where} "
                f"({type(error).__name__}: {error}). Check the connection, or set REFREF_HF to the "
                "folder of a local copy."
            ) from error


Repository = LocalCopy | Hub


def scenes_in(repository: Repository) -> list[SceneName]:
    """Returns all scenes that a repository holds parquet files of."""
    matches = [_SHARD.fullmatch(name) for name in repository.names()]
    names = sorted({match[2] for match in matches if match})
    return [scene_names.parse(name) for name in names if scene_names.is_name(name)]


def find_shards(repository: Repository, scene: SceneName) -> list[str]:
    """Returns the names of all parquet files of a scene, in order.

    Raises:
      SceneError: if there are none, or not all of them, or two sets.
    """
    sets: dict[tuple[str, int], dict[int, str]] = {}
    for name in repository.names():
        match = _SHARD.fullmatch(name)
        if match and match[2] == str(scene) and match[1] in ("data", scene.config):
            sets.setdefault((match[1], int(match[4])), {})[int(match[3])] = name
    if not sets:
        near = _nearest(scene, scenes_in(repository))
        advice = f"The nearest there is {near.source}." if near else "Copy it there."
        raise SceneError(f"There is no scene {scene} in {repository.where}. {advice}")
    (_, count), shards = next(iter(sets.items()))
    if len(sets) > 1:
        raise SceneError(
            f"{repository.where} holds the scene {scene} more than once, as {shards[min(shards)]} "
            "and others. Remove all but one set of files."
        )
    if missing := sorted(set(range(count)) - set(shards)):
        raise SceneError(
            f"Of {count} parquet files of {scene} in {repository.where} number {missing[0]} is "
            "missing. Copy it again."
        )
    return [shards[i] for i in range(count)]


def _nearest(scene: SceneName, scenes: Sequence[SceneName]) -> SceneName | None:
    """Returns a scene with an object of that or a similar name, before that background if any."""
    thing = scene_names.nearest(scene.object, {each.object for each in scenes})
    found = [each for each in scenes if each.object == thing]
    return max(found, key=lambda each: each.background == scene.background, default=None)


def find_others(repository: Repository, scene: SceneName) -> dict[str, str]:
    """Finds what belongs to a scene beside its parquet files.

    Returns:
      Names of files, by their places below the scene's folder.
    """
    names = repository.names()
    own = f"scene_files/{scene}/"
    found = {name.removeprefix(own): name for name in names if name.startswith(own)}
    if not any(place.startswith("meshes/") for place in found):
        folder = f"mesh_files/{CATEGORIES[scene.category]}/"
        meshes = {f"{stem}.ply" for stem in published_stems(scene.object)}
        found |= {
            f"meshes/{name.removeprefix(folder)}": name
            for name in names
            if name.removeprefix(folder) in meshes
        }
    return found
