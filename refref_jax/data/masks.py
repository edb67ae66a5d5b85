"""Masks of a scene: their margins, and import from a segmentation model (NumPy only).

Masks without the pixels at their outlines, which see both sides (NumPy only).

Gives a scene without masks the masks of a segmentation model, in a copy (NumPy only).

Which model is the user's affair: it is asked image by image, and answers with the pixels that show
the object. `docs/masks.md` has examples.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from scipy.ndimage import binary_dilation, binary_erosion

from refref_jax import atomic_files
from refref_jax.data import SceneError, image_files, scene_folder

Masks = Bool[np.ndarray, "frames h w"]

# Neighbours within an image, corners included, and none in another one.
_AROUND = np.ones((1, 3, 3), bool)

Segment = Callable[[Path], Bool[np.ndarray, "h w"]]
"""Takes the path of an image; returns which of its pixels show the object."""


def well_inside(masks: Masks, *, margin: int = 1) -> Masks:
    """Returns the pixels that are so many pixels inside of a mask, and of the image."""
    return binary_erosion(masks, _AROUND, iterations=margin) if margin else masks


def well_outside(masks: Masks, *, margin: int = 2) -> Masks:
    """Returns the pixels that are so many pixels away from a mask."""
    return ~(binary_dilation(masks, _AROUND, iterations=margin) if margin else masks)


def add_masks(scene: Path, out: Path, segment: Segment) -> int:
    """Writes a copy of a scene in which every frame of every split has a mask.

    Masks go to `mask/` under the images' names, as the data set has them. The scene itself stays as
    it is; masks that it has already are replaced in the copy. The copy appears when it is whole.

    Args:
      scene: a folder in the local layout.
      out: the copy; must not exist, nor lie within the scene.
      segment: is called once for each image.

    Returns:
      The number of masks.

    Raises:
      SceneError: if the copy exists, the scene is broken, or a mask is not a boolean one of its
        image's size that marks something.
    """
    scene_folder.read_json(scene / "transforms_train.json")
    if out.exists():
        raise SceneError(f"{out} exists, and nothing is overwritten. Give a new folder.")
    if scene.resolve() in out.resolve().parents:
        raise SceneError(f"{out} lies within the scene {scene}. Give a folder beside it.")
    with atomic_files.new_folder(out) as draft:
        shutil.copytree(scene, draft, dirs_exist_ok=True)
        paths = (draft / f"transforms_{split}.json" for split in scene_folder.SPLITS)
        count = sum(_add_to_split(scene, path, segment) for path in paths if path.is_file())
    return count


def _add_to_split(scene: Path, path: Path, segment: Segment) -> int:
    """Writes the masks of one split of the copy, and names them in its transforms file."""
    content = scene_folder.read_json(path)
    frames = scene_folder.get(content, "frames", path)
    for frame in frames:
        stem = scene_folder.get_text(frame, "file_path", path)
        if Path(stem).is_absolute() or ".." in Path(stem).parts:
            raise SceneError(
                f"{path} names the image {stem}, which is not in the scene's folder. Move the "
                "images there, and name them from there."
            )
        mask = _mask_of(scene / f"{stem}.png", segment)
        name = Path("mask") / f"{stem}.png"
        (path.parent / name).parent.mkdir(parents=True, exist_ok=True)
        image_files.write_mask(path.parent / name, mask)
        frame["mask_file_path"] = f"./{name.as_posix()}"
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return len(frames)


def _mask_of(image: Path, segment: Segment) -> Bool[np.ndarray, "h w"]:
    expected = image_files.read_rgb(image).shape[:2]
    mask = np.asarray(segment(image))
    if mask.dtype != bool or mask.shape != expected:
        raise SceneError(
            f"The mask of {image} is an array {mask.dtype}{list(mask.shape)}, not "
            f"bool{list(expected)}. Compare the model's output with a threshold, and resize it to "
            "the image without blending."
        )
    if not mask.any():
        raise SceneError(
            f"The mask of {image} marks nothing. Mark the object there by hand, or take the frame "
            "out of the transforms file."
        )
    return mask
