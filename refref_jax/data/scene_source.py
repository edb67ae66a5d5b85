"""Opens a scene from a folder or from `hf:CONFIG/SCENE`, and finds several (NumPy only).

The latter is a scene of the published data set in parquet files, in a local copy of its
repositories or on Hugging Face:

    data/{scene}-00000-of-00002.parquet       or {config}/ instead of data/
    mesh_files/{category}/{object}_{material}.ply
    scene_files/{scene}/...                   scene.json, meshes/, textures: all else of its folder

The parquet files are in the repository `yinyue27/RefRef`, the meshes in
`yinyue27/RefRef_additional`; scene files only exist in conversions by this library, and take
precedence over the meshes. The name of a file is its path in the repository, with slashes.

A scene is unpacked once, into a folder in the local layout below REFREF_CACHE, which appears when
it is complete. Its `scene.json` then states what its layout implies: the interface rule of Cycles,
unless it has a rule already. REFREF_HF is the folder of the local copy, or several, separated like
the entries of PATH. The cache may be removed at any time.
"""

import difflib
import hashlib
import importlib
import json
import os
import re
import shutil
import tempfile
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from refref_jax import atomic_files, configuration
from refref_jax.data import SceneError, parquet_scenes, scene_names
from refref_jax.data.meshes import published_meshes
from refref_jax.data.parquet_scenes import Progress
from refref_jax.data.scene_names import CATEGORIES, CONFIGS, SceneName

REPOSITORIES = ("yinyue27/RefRef", "yinyue27/RefRef_additional")

_FOLDERS = ("data", *CONFIGS, "mesh_files", "scene_files")

_SHARD = re.compile(rf"({'|'.join(_FOLDERS[:-2])})/(.+)-(\d+)-of-(\d+)\.parquet")

_UNPACKING = ".unpacking-"

# Increased when scenes are unpacked differently, so that those in the cache are unpacked again.
_FORMAT = 2

# Number of names that are suggested instead of a pattern.
_NEAREST = 3

# Age in seconds at which a folder of an unfinished unpacking is considered abandoned.
_ABANDONED = 24 * 3600


class LocalCopy:
    """Local folders that together hold all or some files of the published repositories.

    Attributes:
      where: name in messages.
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
                    f"{folder} is not a folder, but should hold a scene or a copy of the data set. "
                    "Correct the path of the scene, or REFREF_HF."
                )
            for path in (path for place in _FOLDERS for path in (folder / place).rglob("*")):
                if path.is_file():
                    self._paths.setdefault(path.relative_to(folder).as_posix(), path)

    def names(self) -> list[str]:
        """Returns the names of all files."""
        return sorted(self._paths)

    def fetch(self, name: str) -> Path:
        """Returns the path of a file."""
        return self._paths[name]

    def key(self, scene: SceneName) -> str:
        """Returns a folder name for the scene, which changes with its files."""
        names = [*find_shards(self, scene), *find_others(self, scene).values()]
        stats = [(self._paths[name].resolve(), self._paths[name].stat()) for name in names]
        texts = [f"{path} {stat.st_size} {stat.st_mtime_ns}" for path, stat in stats]
        text = "\n".join([*texts, f"format {_FORMAT}"])
        return hashlib.sha256(text.encode()).hexdigest()[:12]


class Hub:
    """The published repositories, downloaded file by file.

    Attributes:
      where: name in messages.
    """

    where = "huggingface.co"

    def __init__(self) -> None:
        """Imports `huggingface_hub`, an optional dependency.

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
        """Returns the local path of a file, and downloads it if necessary."""
        self.names()
        download = self._hub.hf_hub_download
        return Path(self._try(download, self._owners[name], name, repo_type="dataset"))

    def key(self, scene: SceneName) -> str:
        """Returns a constant folder name, so that the scene can be opened offline."""
        del scene
        return f"huggingface-{_FORMAT}"

    def _try(self, call: Any, repository: str, *arguments: str, **options: str) -> Any:
        try:
            return call(repository, *arguments, **options)
        except Exception as error:  # the network, the service and its client raise many types
            raise SceneError(
                f"{' '.join((repository, *arguments))} cannot be downloaded from {self.where} "
                f"({type(error).__name__}: {error}). Check the connection, or set REFREF_HF to the "
                "folder of a local copy."
            ) from error


Repository = LocalCopy | Hub


def scenes_in(repository: Repository) -> list[SceneName]:
    """Returns all scenes with parquet files in a repository."""
    matches = [_SHARD.fullmatch(name) for name in repository.names()]
    names = sorted({match[2] for match in matches if match})
    return [scene_names.parse(name) for name in names if scene_names.is_name(name)]


def find_shards(repository: Repository, scene: SceneName) -> list[str]:
    """Returns the names of all parquet files of a scene, in order.

    Raises:
      SceneError: if there are none, if some are missing, or if there are two sets.
    """
    sets: dict[tuple[str, int], dict[int, str]] = {}
    for name in repository.names():
        match = _SHARD.fullmatch(name)
        if match and match[2] == str(scene) and match[1] in ("data", scene.config):
            sets.setdefault((match[1], int(match[4])), {})[int(match[3])] = name
    if not sets:
        near = _nearest(scene, scenes_in(repository))
        advice = f"The nearest there is {near.source}." if near else "Copy its files there."
        raise SceneError(f"There is no scene {scene} in {repository.where}. {advice}")
    (_, count), shards = next(iter(sets.items()))
    if len(sets) > 1:
        raise SceneError(
            f"{repository.where} holds the scene {scene} more than once, as {shards[min(shards)]} "
            "and others. Keep only one set of files."
        )
    if missing := sorted(set(range(count)) - set(shards)):
        raise SceneError(
            f"File {missing[0]} of the {count} parquet files of {scene} in {repository.where} is "
            "missing. Copy it again."
        )
    return [shards[i] for i in range(count)]


def _nearest(scene: SceneName, scenes: Sequence[SceneName]) -> SceneName | None:
    """Returns a scene with the same or a similar object, preferably with the same background."""
    thing = configuration.nearest(scene.object, {each.object for each in scenes})
    found = [each for each in scenes if each.object == thing]
    return max(found, key=lambda each: each.background == scene.background, default=None)


def find_others(repository: Repository, scene: SceneName) -> dict[str, str]:
    """Finds the files of a scene other than parquet files.

    Returns:
      Names of files, by their paths relative to the scene folder.
    """
    names = repository.names()
    own = f"scene_files/{scene}/"
    found = {name.removeprefix(own): name for name in names if name.startswith(own)}
    if not any(place.startswith("meshes/") for place in found):
        folder = f"mesh_files/{CATEGORIES[scene.category]}/"
        paths = [Path(name) for name in names if name.startswith(folder) and name.endswith(".ply")]
        meshes = published_meshes(scene.object, paths)
        found |= {f"meshes/{path.name}": path.as_posix() for path in meshes}
    return found


class SceneWarning(UserWarning):
    """An optional part of a scene is missing."""


def open_scene(
    source: str | Path,
    *,
    copies: Sequence[Path] | None = None,
    cache: Path | None = None,
    progress: Progress = lambda done, total: None,
) -> Path:
    """Returns the folder of a scene in the local layout, plain or with the raw release's names.

    The path of a folder is returned unchanged; its readers check it.

    Args:
      source: path of a folder, or `hf:CONFIG/SCENE`.
      copies: folders of local copies of the published repositories; those of REFREF_HF if `None`.
        Without any, files are downloaded from Hugging Face.
      cache: folder for unpacked scenes; if `None`, REFREF_CACHE or else `~/.cache/refref_jax`.
      progress: function called after every frame that is unpacked.

    Raises:
      SceneError: if there is no such scene, if one of its files is missing or broken, or if a
        required package is not installed.
    """
    if not str(source).startswith("hf:"):
        folder = Path(source)
        _refuse_parquet(folder)
        return folder
    name = scene_names.parse_source(str(source))
    repository = _repository(copies)
    scene = _place(repository, name, cache)
    if not scene.is_dir():
        _unpack_whole(repository, name, scene, progress)
    if not (scene / "meshes").is_dir():
        warnings.warn(
            f"{name} has no meshes, so rays through it are straight. Put them into "
            f"mesh_files/{CATEGORIES[name.category]} of a folder in REFREF_HF, as "
            f"{name.object}_glass.ply, or into {scene / 'meshes'}.",
            SceneWarning,
            stacklevel=2,
        )
    return scene


def is_unpacked(source: str | Path) -> bool:
    """Returns whether `open_scene` has nothing to unpack: the source is a folder, or unpacked."""
    if not str(source).startswith("hf:"):
        return True
    name = scene_names.parse_source(str(source))
    return _place(_repository(None), name, None).is_dir()


def expand(source: str, *, copies: Sequence[Path] | None = None) -> list[str]:
    """Returns the scenes that match `hf:all`, `hf:CONFIG` or a pattern with wildcards, by name.

    Any other source is returned unchanged.

    Args:
      source: a source of `open_scene`, or a pattern, see `scene_names.is_pattern`.
      copies: folders of local copies, as for `open_scene`.

    Raises:
      SceneError: if no scene matches.
    """
    if not scene_names.is_pattern(source):
        return [source]
    repository = _repository(copies)
    names = scenes_in(repository)
    if not names:
        raise SceneError(
            f"{source} matches no scene, because there are no parquet files in {repository.where}. "
            "Set REFREF_HF to a folder that contains data/."
        )
    found = [name.source for name in scene_names.select(source, names)]
    if not found:
        near = _nearest_to_pattern(source, names)
        raise SceneError(
            f"{source} matches none of the {len(names)} scenes in {repository.where}. "
            f"The nearest names there are {', '.join(near)}."
        )
    return found


def _nearest_to_pattern(source: str, names: Sequence[SceneName]) -> list[str]:
    """Returns up to three configurations or scenes similar to a pattern that matches nothing."""
    words = {each.source: f"{each.config}/{each}" for each in names}
    words |= {f"hf:{config}": config for config in sorted({each.config for each in names})}
    text = source.removeprefix("hf:")
    score = {
        near: difflib.SequenceMatcher(None, text, word).ratio() for near, word in words.items()
    }
    return sorted(words, key=lambda near: -score[near])[:_NEAREST]


def _repository(copies: Sequence[Path] | None) -> Repository:
    copies = copies_from_environment() if copies is None else copies
    return LocalCopy(copies) if copies else Hub()


def _place(repository: Repository, name: SceneName, cache: Path | None) -> Path:
    """Returns the folder of an unpacked scene."""
    return (cache or _cache()) / repository.key(name) / str(name)


def copies_from_environment() -> list[Path]:
    """Returns the folders in REFREF_HF."""
    return [Path(word) for word in os.environ.get("REFREF_HF", "").split(os.pathsep) if word]


def unpack_scene(
    repository: Repository, name: SceneName, scene: Path, *, progress: Progress
) -> None:
    """Writes a scene of a repository into a new folder in the local layout.

    Args:
      repository: repository of the scene.
      name: name of the scene.
      scene: the folder, which must not exist.
      progress: function called after every frame.

    Raises:
      SceneError: under the conditions of `open_scene`.
    """
    parquet_scenes.import_parquet()  # before anything is downloaded
    shards = [repository.fetch(shard) for shard in find_shards(repository, name)]
    scene.mkdir(parents=True)
    parquet_scenes.unpack(shards, scene, progress=progress)
    for place, other in find_others(repository, name).items():
        target = scene / place
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(repository.fetch(other), target)
    _state_rule(scene / "scene.json")


def _state_rule(path: Path) -> None:
    """Adds the rule of the published layout to `scene.json`, unless it has one or is broken."""
    try:
        text = path.read_text(encoding="utf-8") if path.is_file() else "{}"
        content = configuration.parse_json(text)
    except ValueError:
        return  # its readers report it
    if isinstance(content, dict) and "rule" not in content:
        content = {"rule": scene_names.PUBLISHED_RULE} | content
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _unpack_whole(repository: Repository, name: SceneName, scene: Path, progress: Progress) -> None:
    """Unpacks a scene to a temporary folder next to its path, and moves it when complete."""
    scene.parent.mkdir(parents=True, exist_ok=True)
    _remove_abandoned(scene.parent)
    with tempfile.TemporaryDirectory(prefix=_UNPACKING, dir=scene.parent) as beside:
        unpack_scene(repository, name, Path(beside) / scene.name, progress=progress)
        try:
            atomic_files.move(Path(beside) / scene.name, scene)
        except OSError:
            if not scene.is_dir():  # otherwise another process was first, with the same files
                raise


def _remove_abandoned(folder: Path) -> None:
    for path in folder.glob(f"{_UNPACKING}*"):
        if time.time() - path.stat().st_mtime > _ABANDONED:
            shutil.rmtree(path, ignore_errors=True)


def _refuse_parquet(folder: Path) -> None:
    """Refuses a folder of parquet files, with an explanation of how to open one of its scenes."""
    if any(folder.glob("transforms_*.json")) or not folder.is_dir():
        return
    copy = LocalCopy([folder])
    if scenes := scenes_in(copy):
        raise SceneError(
            f"{folder} holds parquet files of {len(scenes)} scenes, not a scene. Set "
            f"REFREF_HF={folder}, and open a scene as {scenes[0].source}."
        )


def _cache() -> Path:
    return Path(os.environ.get("REFREF_CACHE") or Path.home() / ".cache" / "refref_jax")
