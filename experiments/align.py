"""Aligns the meshes of an object with the images: its direction, its place and its size.

python -m experiments.align --scene=SCENE --mesh=SCENE/meshes --out=runs/aligned
python -m experiments.train --scene=SCENE --reconstruction=runs/aligned --out=runs/model

For a scanned or modelled object that lies a little wrong: within some 5 degrees and 5 percent. The
outlines of the masks come first, then the light that is refracted through the object. {out} can be
used like a reconstruction. `docs/captures.md` explains the method.
"""

import dataclasses
from pathlib import Path

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.r3f import flags as r3f_flags
from experiments.runs import refraction_indices

with epy.lazy_imports():
    from experiments.r3f import alignment, chain
    from refref_jax.data import meshes, scene_properties

_SCENE = cli_flags.scene("The scene whose images show the object")
_MESH = flags.DEFINE_string(
    "mesh", None, "Folder of .ply files whose names end on a material; the scene's own by default."
)
_IOR = cli_flags.ior()
_SPACE = r3f_flags.space()
_PROPERTIES = cli_flags.properties()
_SEED = cli_flags.seed()
cli_flags.allow_outside()
_OUT = cli_flags.out("Folder to write to.")
_OVERWRITE = cli_flags.overwrite("an earlier alignment")

_WRITES = (
    *("placement.json", "reconstruction.json", "errors.png"),
    *("background", "light", "geometry"),
)


def main() -> None:
    """Aligns the object of a scene."""
    out, indices = Path(_OUT.value), refraction_indices.parse_named(_IOR.value)
    place = {"module": __name__, "writes": _WRITES, "overwrite": _OVERWRITE.value}
    outputs.replaceable(out, **place)
    cli_scenes.check(_SCENE.value)
    scene = cli_scenes.opened(_SCENE.value)
    told = scene_properties.read(scene, overlay=_PROPERTIES.value)
    folder = None if _MESH.value is None else Path(_MESH.value)
    if folder is not None:
        if not folder.is_dir() or not meshes.mesh_files(scene, folder=folder):
            raise ValueError(f"--mesh={folder} is not a folder with .ply files. Give a folder.")
        described = {name: part for name, part in told.parts.items() if (folder / name).is_file()}
        told = dataclasses.replace(told, parts=described)
    if told.rule not in (None, "nested"):
        raise ValueError(
            f"The rule of this scene is {told.rule}, but objects are aligned under the rule nested "
            "only. Remove the rule from scene.json if its parts do not overlap."
        )
    parts = meshes.read_meshes(scene, indices=indices, properties=told, folder=folder)
    alignment.placed_object(parts)  # refuses unsuitable ones before anything is written
    space, radius, centre = chain.bounds_of(
        scene, _PROPERTIES.value or "", space=_SPACE.chosen(), radius=_SPACE.radius.value
    )
    with outputs.fresh(out, **place) as draft:
        background = alignment.Background(space, radius, centre)
        facts = alignment.align(scene, parts, draft, background, seed=_SEED.value)
    print(alignment.describe(facts))
    print(f"Placement: {out / alignment.PLACEMENT}")
    if facts.given is not None:
        print(f"Pixels:    {out / alignment.FIGURE}")
    given = [f"--scene={_SCENE.value}", f"--reconstruction={out}", f"--out={out}_run"]
    print(f"Next: {app.shell('train', *given)}")


if __name__ == "__main__":
    app.run(main, again="repeat the command to align again; nothing was written.")
