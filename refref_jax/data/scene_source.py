"""Opens a scene wherever it is: a folder, or `hf:CONFIG/SCENE` (NumPy only).

The latter is a scene in parquet files, in a local copy of the data set or on Hugging Face, see
`published_files`. It is unpacked once, into a folder in the local layout below REFREF_CACHE, which
appears when it is whole. REFREF_HF names the folder of the local copy, or several, separated like
the entries of PATH. What is in the cache may be removed at any time.
"""

import os
import shutil
import tempfile
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

from refref_jax import atomic_files
from refref_jax.data import parquet_scenes, published_files, scene_names
from refref_jax.data.errors import SceneError
from refref_jax.data.parquet_scenes import Progress
from refref_jax.data.published_files import Hub, LocalCopy, Repository
from refref_jax.data.scene_names import CATEGORIES, SceneName

_UNPACKING = ".unpacking-"

# Seconds after which a folder that is being unpacked must have been abandoned.
_ABANDONED = 24 * 3600


class SceneWarning(UserWarning):
    """Something that a scene lacks, without which it can be read."""


def open_scene(
    source: str | Path,
    *,
    copies: Sequence[Path] | None = None,
    cache: Path | None = None,
    progress: Progress = lambda done, total: None,
) -> Path:
    """Returns the folder of a scene in the local layout, plain or with the raw release's names.

    A folder is returned as it is; its readers check it.

    Args:
      source: a folder, or `hf:CONFIG/SCENE`.
      copies: folders of local copies of the published repositories; those of REFREF_HF if `None`,
        and if there are none, Hugging Face itself.
      cache: where to unpack; REFREF_CACHE if `None`, else `~/.cache/refref_jax`.
      progress: is told of every frame that is unpacked.

    Raises:
      SceneError: if there is no such scene, if a file of it is missing or broken, or if what reads
        it is not installed.
    """
    if not str(source).startswith("hf:"):
        folder = Path(source)
        _refuse_parquet(folder)
        return folder
    name = scene_names.parse_source(str(source))
    copies = copies_from_environment() if copies is None else copies
    repository = LocalCopy(copies) if copies else Hub()
    scene = (cache or _cache()) / repository.key(name) / str(name)
    if not scene.is_dir():
        _unpack_whole(repository, name, scene, progress)
    if not (scene / "meshes").is_dir():
        warnings.warn(
            f"{name} has no meshes, so that light goes straight through it. Put them into "
            f"mesh_files/{CATEGORIES[name.category]} of a folder in REFREF_HF, as "
            f"{name.object}_glass.ply, or into {scene / 'meshes'}.",
            SceneWarning,
            stacklevel=2,
        )
    return scene


def copies_from_environment() -> list[Path]:
    """Returns the folders that REFREF_HF names."""
    return [Path(word) for word in os.environ.get("REFREF_HF", "").split(os.pathsep) if word]


def unpack_scene(
    repository: Repository, name: SceneName, scene: Path, *, progress: Progress
) -> None:
    """Writes a scene of a repository into a new folder in the local layout.

    Args:
      repository: where it is.
      name: of the scene.
      scene: the folder, which must not exist.
      progress: is told of every frame.

    Raises:
      SceneError: as `open_scene`.
    """
    parquet_scenes.import_parquet()  # before anything is downloaded
    shards = [repository.fetch(shard) for shard in published_files.find_shards(repository, name)]
    scene.mkdir(parents=True)
    parquet_scenes.unpack(shards, scene, progress=progress)
    for place, other in published_files.find_others(repository, name).items():
        target = scene / place
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(repository.fetch(other), target)


def _unpack_whole(repository: Repository, name: SceneName, scene: Path, progress: Progress) -> None:
    """Unpacks a scene beside its place, and moves it there when it is whole."""
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
    """Says how a copy of the parquet files is read, where its folder is given as a scene's."""
    if any(folder.glob("transforms_*.json")) or not folder.is_dir():
        return
    copy = LocalCopy([folder])
    if scenes := published_files.scenes_in(copy):
        raise SceneError(
            f"{folder} holds parquet files of {len(scenes)} scenes, not a scene. Set "
            f"REFREF_HF={folder}, and give the scene as in {scenes[0].source}."
        )


def _cache() -> Path:
    return Path(os.environ.get("REFREF_CACHE") or Path.home() / ".cache" / "refref_jax")
