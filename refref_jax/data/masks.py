"""Masks of a scene: their margins, and their import from a segmentation model (NumPy only).

The pixels at the outline of a mask see both sides; margins leave them out.

`add_masks` copies a scene and adds the masks of a segmentation model. Users choose the model: it is
a function that takes the path of an image and returns the pixels that show the object.
`docs/masks.md` has examples.
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

# Neighbours of a pixel, including diagonal ones, within its own image.
_AROUND = np.ones((1, 3, 3), bool)

Segment = Callable[[Path], Bool[np.ndarray, "h w"]]
"""Segmentation model: takes the path of an image, returns the mask of the object."""


def well_inside(masks: Masks, *, margin: int = 1) -> Masks:
    """Returns the pixels at least `margin` pixels inside a mask, and inside the image."""
    return binary_erosion(masks, _AROUND, iterations=margin) if margin else masks


def well_outside(masks: Masks, *, margin: int = 2) -> Masks:
    """Returns the pixels more than `margin` pixels away from a mask."""
    return ~(binary_dilation(masks, _AROUND, iterations=margin) if margin else masks)


def add_masks(scene: Path, out: Path, segment: Segment) -> int:
    """Writes a copy of a scene in which every frame of every split has a mask.

    Masks are written to `mask/` under the names of the images, as in the data set. The scene itself
    is not changed; masks that it has already are replaced in the copy. The copy appears when it is
    complete.

    Args:
      scene: a folder in the local layout.
      out: folder of the copy; must not exist, nor be inside the scene.
      segment: segmentation model, called once for each image.

    Returns:
      The number of masks.

    Raises:
      SceneError: if the copy exists, the scene is broken, or a mask is not boolean, not of the size
        of its image, or empty.
    """
    scene_folder.read_json(scene / "transforms_train.json")
    if out.exists():
        raise SceneError(f"{out} exists, and nothing is overwritten. Give a new folder.")
    if scene.resolve() in out.resolve().parents:
        raise SceneError(f"{out} is inside the scene {scene}. Give a folder next to it.")
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
                "images there, and give their names relative to it."
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
            "the image without interpolation."
        )
    if not mask.any():
        raise SceneError(
            f"The mask of {image} marks no object. Mark the object by hand, or remove the frame "
            "from the transforms file."
        )
    return mask
