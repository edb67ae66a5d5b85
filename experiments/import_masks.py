"""Copies a scene without masks and adds those of a segmentation model.

python -m experiments.import_masks --scene=FOLDER --masks=FOLDER --out=FOLDER

Masks are named like the images: the mask of {scene}/train/r_000.png is {masks}/train/r_000.png, of
the same size; all pixels that are not black show the object. `docs/masks.md` describes segmentation
models.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags
from etils import epy

from experiments.cli import app
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from refref_jax.data import SceneError

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Bool

with epy.lazy_imports():
    from refref_jax.data import image_files, scene_folder

_SCENE = flags.DEFINE_string("scene", None, "The scene, in the local layout.", required=True)
_MASKS = flags.DEFINE_string("masks", None, "Folder of the masks.", required=True)
_OUT = cli_flags.out("Copy to write, which must not exist.")
cli_flags.allow_outside()


def main() -> None:
    """Writes the copy."""
    scene, folder, out = Path(_SCENE.value), Path(_MASKS.value), Path(_OUT.value)
    cli_scenes.check(scene)
    if not folder.is_dir():
        raise SceneError(f"{folder} is not a folder. Give the folder that contains the masks.")

    empty: list[Path] = []

    def read(image: Path) -> Bool[np.ndarray, "h w"]:
        path = folder / image.relative_to(scene)
        if not path.is_file():
            raise SceneError(
                f"There is no mask of {image}: {path} does not exist. Save it there, or remove the "
                "frame from the transforms file."
            )
        mask = image_files.read_mask(path)
        empty.extend([] if mask.any() else [path])
        return mask

    count = scene_folder.add_masks(scene, out, read)
    print(f"Masks: {count}")
    if empty:
        print(f"{len(empty)} mark no object, such as {empty[0]}: R3F leaves out these views")
    print(f"Scene: {out}")
    print(f"Next: {app.shell('reconstruct', f'--scene={out}', f'--out={out}_r3f')}")


if __name__ == "__main__":
    app.run(main, again="an existing copy is never replaced.")
