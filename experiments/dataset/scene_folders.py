"""Finds the scenes of a folder or repository, in any layout, and opens them one by one."""

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

from experiments.cli import scenes as cli_scenes
from experiments.dataset import scene_contents
from refref_jax import configuration
from refref_jax.data import SceneError, parquet_scenes, scene_names, scene_source
from refref_jax.data.scene_source import LocalCopy

_T = TypeVar("_T")


class FoundScene(NamedTuple):
    """A scene to read.

    Attributes:
      name: name of the scene, or of its folder.
      images: number of images.
      folder: folder of the scene; `None` if it is in parquet files.
      copy: copy that holds the parquet files; `None` if the scene is a folder.
    """

    name: str
    images: int
    folder: Path | None
    copy: LocalCopy | None


def find(place: str, chosen: Sequence[str] | None = None) -> list[FoundScene]:
    """Finds the scenes of a folder or repository, and checks that their files exist.

    Args:
      place: `hf:CONFIG/SCENE`, a scene's folder, a folder of such folders, one in the raw release's
        layout, or a folder of parquet files.
      chosen: names of the requested scenes; all if `None`.

    Raises:
      SceneError: if there are no scenes, if a requested one is missing, or if one is broken.
    """
    if place.startswith("hf:"):
        return _chosen([_in_folder(cli_scenes.opened(place))], chosen, place)
    top = Path(place)
    if any(top.glob("transforms_*.json")):
        return _chosen([_in_folder(top)], chosen, place)
    copy = LocalCopy([top])
    if names := scene_source.scenes_in(copy):
        return [
            FoundScene(str(name), _images(copy, name), None, copy)
            for name in _wanted({str(name): name for name in names}, chosen, place)
        ]
    folders = _folders(top)
    if not folders:
        raise SceneError(
            f"{top} holds no scene: neither transforms_train.json, nor folders with it, nor "
            "parquet files in data. Give a scene, or a folder of scenes."
        )
    wanted = _wanted({scene_names.of_folder(folder): folder for folder in folders}, chosen, place)
    return [_in_folder(folder) for folder in wanted]


@contextlib.contextmanager
def opened(scene: FoundScene, out: Path, step: Callable[[], None]) -> Iterator[Path]:
    """Yields the scene's folder; parquet files are unpacked into a temporary one.

    Args:
      scene: scene to open.
      out: existing folder for the temporary one.
      step: callback for every unpacked image.
    """
    if scene.folder is not None:
        yield scene.folder
        return
    with tempfile.TemporaryDirectory(prefix=".converting-", dir=out) as beside:
        folder = Path(beside) / scene.name
        name = scene_names.parse(scene.name)
        scene_source.unpack_scene(scene.copy, name, folder, progress=lambda done, total: step())
        yield folder


def _in_folder(folder: Path) -> FoundScene:
    contents = scene_contents.read(folder)
    images = sum(len(split.frames) for split in contents.splits.values())
    return FoundScene(scene_names.of_folder(folder), images, folder, None)


def _images(copy: LocalCopy, name: scene_names.SceneName) -> int:
    shards = [copy.fetch(shard) for shard in scene_source.find_shards(copy, name)]
    return sum(parquet_scenes.read_contents(shards).frames.values())


def _folders(top: Path) -> list[Path]:
    """Returns the folders of scenes below a folder, without incomplete ones (leading dot)."""
    for pattern in ("*", "image_data/*/*/*", "*/*/*"):
        found = {path.parent for path in top.glob(f"{pattern}/transforms_*.json")}
        found = {path for path in found if not path.name.startswith(".")}
        if found:
            return sorted(found)
    return []


def _chosen(found: list[FoundScene], chosen: Sequence[str] | None, place: str) -> list[FoundScene]:
    return _wanted({scene.name: scene for scene in found}, chosen, place)


def _wanted(found: dict[str, _T], chosen: Sequence[str] | None, place: str) -> list[_T]:
    """Returns the requested scenes."""
    for name in chosen or ():
        if name not in found:
            near = configuration.nearest(name, found)
            advice = f"The nearest there is {near}." if near else f"There are {', '.join(found)}."
            raise SceneError(f"There is no scene {name} in {place}. {advice}")
    return [found[name] for name in (found if chosen is None else dict.fromkeys(chosen))]
