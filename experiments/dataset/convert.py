r"""Converts scenes between the layouts of the data set; images are carried byte for byte.

python -m experiments.dataset.convert --scene=experiments/data/cube_smcvx_ball --to=parquet \
    --out=converted

    local      {scene}/, files with plain names
    raw        image_data/{background}/{category}/{object}/, as in the raw release, and mesh_files/
    parquet    data/{scene}-*.parquet, as on Hugging Face, scene_files/ and mesh_files/

--scene takes one scene, or a folder of scenes in any of these layouts. A scene appears in --out
when it is complete, and existing ones are never overwritten. Parquet files cannot hold float maps:
these are omitted, with a message. Files named in `scene.json` are kept next to them.
"""

import collections
from pathlib import Path

from absl import flags
from etils import epy

from experiments.cli import app
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar
from refref_jax.data import scene_names

with epy.lazy_imports():
    from experiments.dataset import conversion, dataset_card, scene_folders
    from refref_jax.data import parquet_scenes

_SCENE = cli_flags.scene("Scene to convert, or a folder of scenes")
_TO = flags.DEFINE_enum("to", None, ["local", "raw", "parquet"], "Layout to write.", required=True)
_OUT = cli_flags.out("Output folder.")
_SCENES = flags.DEFINE_list("scenes", None, "Names of the scenes to convert; all if not given.")
cli_flags.allow_outside()


def main() -> None:
    """Converts all selected scenes."""
    cli_scenes.check_place(_SCENE.value)
    layout, out = _TO.value, Path(_OUT.value)
    if layout == "parquet":
        parquet_scenes.import_parquet()  # before anything is read
    scenes = scene_folders.find(_SCENE.value, _SCENES.value)
    conversion.check_space(scenes, layout, out)
    out.mkdir(parents=True, exist_ok=True)
    left: collections.Counter[str] = collections.Counter()
    done = 0
    # Scenes in parquet files are unpacked first.
    images = sum(scene.images * (1 if scene.copy is None else 2) for scene in scenes)
    with ProgressBar("convert", images) as bar:
        for scene in scenes:

            def step(name: str = scene.name) -> None:
                nonlocal done
                done += 1
                bar.show(done, name)

            left.update(conversion.convert(scene, layout, out, step=step))
            dataset_card.add_to_list(out, [scene.name])
    for kind, count in sorted(left.items()):
        print(f"left out: {count} files {kind}, which this layout cannot hold")
    print(f"Scenes: {len(scenes)} in {out}")
    print(f"List:   {out / dataset_card.LIST}")
    name = scenes[0].name
    if layout == "parquet":
        card = dataset_card.write(out, dataset_card.names_in(out))
        print(f"Card:   {card or f'{out / dataset_card.CARD} was edited, and is kept'}")
        source, before = scene_names.parse(name).source, f"REFREF_HF={out} "
    else:
        source, before = str(conversion.folder_of(name, layout, out)), ""
    print(f"Next: {before}python -m experiments.train --scene={source} --out=runs/{name}")


if __name__ == "__main__":
    app.run(main, again="existing scenes are refused, and never replaced.")
