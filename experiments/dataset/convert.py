"""Converts scenes between the layouts of the data set; images are carried byte for byte.

python -m experiments.dataset.convert --scene=experiments/data/cube_smcvx_ball --to=parquet \
    --out=converted

    local      {scene}/, files with plain names
    raw        image_data/{background}/{category}/{object}/, as in the raw release, and mesh_files/
    parquet    data/{scene}-*.parquet, as on Hugging Face, scene_files/ and mesh_files/

--scene takes one scene, or a folder of scenes in any of these layouts. A scene appears in --out
when it is whole, and none is overwritten. Parquet files have no place for maps of floats: these are
left out, and it is said. What `scene.json` names is kept beside them.
"""

import collections
from collections.abc import Callable, Sequence
from pathlib import Path

from absl import flags

from experiments import commands, scene_option
from experiments.dataset import (
    dataset_card,
    layout_folders,
    layout_parquet,
    published_meshes,
    scene_contents,
    scene_folders,
)
from experiments.dataset.scene_folders import FoundScene
from refref_jax.data import file_names, parquet_scenes, scene_names

_SCENE = flags.DEFINE_string(
    "scene", None, f"What to convert: {scene_option.FORMS}, or a folder of scenes.", required=True
)
_TO = flags.DEFINE_enum("to", None, ["local", "raw", "parquet"], "Layout to write.", required=True)
_OUT = flags.DEFINE_string("out", None, "Folder to write to.", required=True)
_SCENES = flags.DEFINE_list("scenes", None, "Only these scenes of a folder; all if not given.")


def main() -> None:
    """Converts all scenes that the options name."""
    layout, out = _TO.value, Path(_OUT.value)
    if layout == "parquet":
        parquet_scenes.import_parquet()  # before anything is read
    scenes = scene_folders.find(_SCENE.value, _SCENES.value)
    check_room(scenes, layout, out)
    out.mkdir(parents=True, exist_ok=True)
    left: collections.Counter[str] = collections.Counter()
    done = 0
    # What is in parquet files is unpacked first.
    images = sum(scene.images * (1 if scene.copy is None else 2) for scene in scenes)
    with commands.ProgressBar("convert", images) as bar:
        for scene in scenes:

            def step(name: str = scene.name) -> None:
                nonlocal done
                done += 1
                bar.show(done, name)

            left.update(convert(scene, layout, out, step=step))
            dataset_card.add_to_list(out, [scene.name])
    for kind, count in sorted(left.items()):
        print(f"left out: {count} files {kind}, which have no place in this layout")
    print(f"Scenes: {len(scenes)} in {out}")
    print(f"List:   {out / dataset_card.LIST}")
    name = scenes[0].name
    if layout == "parquet":
        card = dataset_card.write(out, dataset_card.names_in(out))
        print(f"Card:   {card or f'{out / dataset_card.CARD} is yours, and was left as it is'}")
        source, before = scene_names.parse(name).source, f"REFREF_HF={out} "
    else:
        source, before = str(folder_of(name, layout, out)), ""
    print(f"Next: {before}python -m experiments.train --scene={source} --out=runs/{name}")


def check_room(scenes: Sequence[FoundScene], layout: str, out: Path) -> None:
    """Refuses scenes that are there already, or whose names the layout does not know.

    Raises:
      ValueError: naming them.
    """
    there = [scene.name for scene in scenes if is_there(scene.name, layout, out)]
    if there:
        others = [scene.name for scene in scenes if scene.name not in there]
        advice = f", or convert the others with --scenes={','.join(others)}" if others else ""
        raise ValueError(
            f"{out} holds {len(there)} of the {len(scenes)} scenes already, as {there[0]}. Give "
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
      scene: the scene.
      layout: `local`, `raw` or `parquet`.
      out: existing folder of the whole layout.
      step: is called for every image that is unpacked, and for every one that is written.

    Returns:
      How many files were left out, by folder and ending.
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
            naming = file_names.plain if layout == "local" else file_names.raw
            layout_folders.write(
                contents, folder_of(scene.name, layout, out), naming=naming, step=step
            )
    kinds = [Path(place).parent / f"*{Path(place).suffix}" for place in left]
    return collections.Counter(map(str, kinds))


def _is_mesh(place: str) -> bool:
    return place.startswith("meshes/") and place.lower().endswith(".ply")


if __name__ == "__main__":
    commands.run(main)
