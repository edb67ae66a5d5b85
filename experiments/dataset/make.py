"""Makes scenes of the data set: objects before backgrounds, rendered by Blender.

python -m experiments.dataset.make --out=runs/dataset --scenes=all --workers=4

Each scene gets a folder in --out. Blender requires a separate environment, created by `make
dataset-env`. To resume an interrupted command, repeat it: the result is the same, to the bit.
Existing files are never replaced.

A mesh of your own, closed and in any units, takes the place of the objects:

    python -m experiments.dataset.make --out=runs/mine --mesh=vase.ply --material=glass

`--preview` renders one test view of each scene instead, into {out}/preview, and contact sheets.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.dataset.render_settings import LEAST_TEXTURE, Device, PerSplit, RenderSettings
from refref_jax.choices import TwoSidedRule
from refref_jax.data.scene_names import BACKGROUNDS, SceneName

with epy.lazy_imports():
    from experiments.dataset import (
        blender_meshes,
        catalogue,
        contact_sheet,
        frame_files,
        production,
        scenes,
        user_meshes,
    )
    from experiments.dataset.parts import Object

_OUT = cli_flags.out("Output folder, with a folder for each scene.")
_SCENES = flags.DEFINE_string(
    "scenes",
    "all",
    "all, or names separated by commas: scenes such as cube_smcvx_ball, objects such as ball for "
    "all their backgrounds, or either with wildcards such as 'sphere_*'.",
)
_SIZE = flags.DEFINE_integer("size", 800, "Width and height of images in pixels.", lower_bound=1)
_SPP = flags.DEFINE_integer("spp", 512, "Samples per pixel of train and val.", lower_bound=1)
_TEST_SPP = flags.DEFINE_integer(
    "test_spp", None, "Samples per pixel of test; those of --spp if not given.", lower_bound=1
)
_VIEWS = flags.DEFINE_integer("views", 100, "Views of each split.", lower_bound=0)
_SPLIT_VIEWS = {
    split: flags.DEFINE_integer(
        f"{split}_views", None, f"Views of {split}; those of --views if not given.", lower_bound=0
    )
    for split in cli_flags.SPLITS
}
_WORKERS = flags.DEFINE_integer(
    "workers", None, "Number of Blender processes; one for each core if not given.", lower_bound=1
)
_RULE = flags.DEFINE_enum(
    "rule",
    "nested",
    get_args(TwoSidedRule),
    "Medium outside a part: the part around it, or always air, the default in Blender.",
)
_TEXTURE_SIZE = flags.DEFINE_integer(
    "texture_size", 1024, "Rows of each image of the background.", lower_bound=LEAST_TEXTURE
)
_EXR = flags.DEFINE_enum(
    "exr", "test", ["all", "test", "none"], "Splits that also keep their images as linear EXRs."
)
_MESH = flags.DEFINE_multi_string(
    "mesh", [], "Mesh of an object of your own. Repeat the flag for an object of several parts."
)
_MATERIAL = flags.DEFINE_multi_string(
    "material", ["glass"], "Material of each --mesh, in their order, or one for all."
)
app.check(_SCENES, lambda words: _MESH.value or scenes.choose(words, catalogue.OBJECTS))
_DEVICE = flags.DEFINE_enum("device", "CPU", get_args(Device), "Device of Cycles.")
_PREVIEW = flags.DEFINE_bool("preview", False, "One test view of each scene, and contact sheets.")
_BLENDER = flags.DEFINE_string(
    "blender", ".venv-dataset/bin/python", "Python of the environment that has Blender."
)

# Width and height of an image on a contact sheet, pixels.
_TILE = 200


def main() -> None:
    """Makes the missing files of the chosen scenes."""
    objects = _objects()
    chosen = scenes.choose(_SCENES.value, objects)
    settings = _settings()
    blender = Path(_BLENDER.value).absolute()
    if not blender.is_file():
        raise ValueError(
            f"--blender={_BLENDER.value} does not exist. Run make dataset-env, or give "
            "the Python of an environment with bpy 5.0.1 as --blender."
        )
    out = Path(_OUT.value) / "preview" if _PREVIEW.value else Path(_OUT.value)
    if not _MESH.value and any(scene.object == "monkey" for scene in chosen):
        blender_meshes.export_monkey(catalogue.SUZANNE, blender=blender)
    with app.Interrupt() as interrupt:
        whole = production.produce(
            out,
            chosen,
            settings,
            objects=objects,
            blender=blender,
            workers=_WORKERS.value,
            stopped=lambda: interrupt.requested,
        )
    outputs.note(out, __name__)
    if not whole:
        print("Stopped. The same command resumes from here.")
        sys.exit(app.INTERRUPTED)
    if _PREVIEW.value:
        _write_contact_sheets(out, chosen, settings)
    print(f"Scenes: {out / str(chosen[0])}" + f" and {len(chosen) - 1} more" * (len(chosen) > 1))
    print(f"Next: {app.shell('dataset.check', str(out))}")


def _settings() -> RenderSettings:
    test_spp = _SPP.value if _TEST_SPP.value is None else _TEST_SPP.value
    views = (
        _VIEWS.value if _SPLIT_VIEWS[split].value is None else _SPLIT_VIEWS[split].value
        for split in cli_flags.SPLITS
    )
    return RenderSettings(
        size=_SIZE.value,
        spp=PerSplit(_SPP.value, _SPP.value, test_spp),
        views=PerSplit(*views),
        rule=_RULE.value,
        texture_size=_TEXTURE_SIZE.value,
        linear=_EXR.value,
        preview=_PREVIEW.value,
        device=_DEVICE.value,
        source=user_meshes.digest(*_user_meshes()) if _MESH.value else "",
    )


def _objects() -> dict[str, Object]:
    """Returns the objects by name: those of the data set, or the user's own."""
    if not _MESH.value:
        return catalogue.OBJECTS
    own = user_meshes.read_object(*_user_meshes())
    return {own.name: own}


def _user_meshes() -> tuple[list[Path], list[str]]:
    paths = [Path(name) for name in _MESH.value]
    if missing := [path for path in paths if not path.is_file()]:
        raise ValueError(f"--mesh={missing[0]} does not exist. Give a mesh file.")
    return paths, _MATERIAL.value


def _write_contact_sheets(out: Path, chosen: Sequence[SceneName], settings: RenderSettings) -> None:
    """Writes a contact sheet for each kind of background."""
    (number,) = settings.numbers("test")
    image = frame_files.relative("test", number).image
    for kind in BACKGROUNDS:
        pictures = [(s.object, out / str(s) / image) for s in chosen if s.background == kind]
        if pictures:
            path = out / f"contact_sheet_{kind}.png"
            contact_sheet.write(path, pictures, tile=_TILE)
            print(f"Contact sheet: {path}")


if __name__ == "__main__":
    app.run(
        main,
        again="it resumes; existing views are not rendered again.",
    )
