"""Gives a scene without masks those of a segmentation model, in a copy of the scene.

python -m experiments.import_masks --scene=FOLDER --masks=FOLDER --out=FOLDER

The masks are named as the images: that of {scene}/train/r_000.png is {masks}/train/r_000.png, of
the same size; what is not black shows the object. `docs/masks.md` tells how models make them.
"""

from pathlib import Path

import numpy as np
from absl import flags
from jaxtyping import Bool

from experiments import commands
from refref_jax.data import files, mask_import
from refref_jax.data.errors import SceneError

_SCENE = flags.DEFINE_string("scene", None, "The scene, in the local layout.", required=True)
_MASKS = flags.DEFINE_string("masks", None, "Folder of the masks.", required=True)
_OUT = flags.DEFINE_string("out", None, "The copy to write; must not exist.", required=True)


def main() -> None:
    """Writes the copy."""
    scene, masks, out = Path(_SCENE.value), Path(_MASKS.value), Path(_OUT.value)
    if not masks.is_dir():
        raise SceneError(f"{masks} is no folder. Give the folder that holds the masks.")

    def read(image: Path) -> Bool[np.ndarray, "h w"]:
        path = masks / image.relative_to(scene)
        if not path.is_file():
            raise SceneError(
                f"There is no mask of {image}: {path} does not exist. Save it there, or take the "
                "frame out of the transforms file."
            )
        return files.read_mask(path)

    count = mask_import.add_masks(scene, out, read)
    print(f"Masks: {count}")
    print(f"Scene: {out}")


if __name__ == "__main__":
    commands.run(main)
