"""Converts one scene to one of the layouts of the data set; see `convert`."""

import collections
from collections.abc import Callable, Sequence
from pathlib import Path

from experiments.dataset import (
    layout_folders,
    layout_parquet,
    published_meshes,
    scene_contents,
    scene_folders,
)
from experiments.dataset.scene_folders import FoundScene
from refref_jax.data import scene_folder, scene_names


def check_space(scenes: Sequence[FoundScene], layout: str, out: Path) -> None:
    """Rejects scenes that exist already, or whose names do not fit the layout.

    Raises:
      ValueError: if there are such scenes; the message names them.
    """
    there = [scene.name for scene in scenes if is_there(scene.name, layout, out)]
    if there:
        others = [scene.name for scene in scenes if scene.name not in there]
        advice = f", or convert the others with --scenes={','.join(others)}" if others else ""
        raise ValueError(
            f"{out} holds {len(there)} of the {len(scenes)} scenes already, e.g. {there[0]}. Give "
            f"another --out{advice}."
        )


def is_there(name: str, layout: str, out: Path) -> bool:
    """Returns whether a folder of a layout holds a scene."""
    if layout == "parquet":
        return bool(layout_parquet.files_of(scene_names.parse(name), out))
    return folder_of(name, layout, out).exists()


def folder_of(name: str, layout: str, out: Path) -> Path:
    """Returns the folder of a scene in the layouts `local` and `raw`."""
    if layout == "local":
        return out / name
    return out / "image_data" / scene_names.parse(name).raw_folder


def convert(
    scene: FoundScene, layout: str, out: Path, *, step: Callable[[], None]
) -> collections.Counter[str]:
    """Converts a scene.

    Args:
      scene: scene to convert.
      layout: name of the layout: `local`, `raw` or `parquet`.
      out: existing folder of the complete layout.
      step: callback for every unpacked and for every written image.

    Returns:
      Number of omitted files, by folder and suffix.
    """
    left: dict[str, Path] = {}
    with scene_folders.opened(scene, out, step) as folder:
        contents = scene_contents.read(folder)
        if layout != "local":
            parts = [path for place, path in contents.extras.items() if _is_mesh(place)]
            published_meshes.write(parts, scene_names.parse(scene.name), out)
        if layout == "parquet":
            left = layout_parquet.write(contents, scene_names.parse(scene.name), out, step=step)
        else:
            naming = scene_folder.plain if layout == "local" else scene_folder.raw
            layout_folders.write(
                contents, folder_of(scene.name, layout, out), naming=naming, step=step
            )
    kinds = [Path(place).parent / f"*{Path(place).suffix}" for place in left]
    return collections.Counter(map(str, kinds))


def _is_mesh(place: str) -> bool:
    return place.startswith("meshes/") and place.lower().endswith(".ply")
