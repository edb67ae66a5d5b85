"""Writes a scene as a capture in nerfstudio's format; images are copied byte for byte."""

import shutil
from collections.abc import Callable
from pathlib import Path

from experiments.captures import nerfstudio
from experiments.captures.scenes import Sense
from refref_jax import atomic_files
from refref_jax.data import SceneError, image_files, scene_folder
from refref_jax.data.scene_folder import Frames


def read_splits(scene: Path) -> dict[str, Frames]:
    """Reads all splits of a scene."""
    names = [
        split
        for split in scene_folder.SPLITS
        if split == "train" or (scene / f"transforms_{split}.json").is_file()
    ]
    return {split: scene_folder.read_frames(scene, split) for split in names}


def write_capture(
    splits: dict[str, Frames], out: Path, sense: Sense, *, step: Callable[[], None]
) -> None:
    """Writes a capture, which appears when it is complete. Images are copied byte for byte.

    Args:
      splits: splits of the scene.
      out: folder of the capture; must not exist.
      sense: meaning of white in the masks: `object` or `background`; `none` drops the masks.
      step: function called after every image.

    Raises:
      SceneError: if the folder exists, or a mask is broken.
    """
    if out.exists():
        raise SceneError(f"{out} exists, and nothing is overwritten. Give a new folder.")
    digits = len(str(max(len(frames.names) for frames in splits.values())))
    images: dict[str, list[str]] = {}
    masks: dict[str, list[str]] = {}
    with atomic_files.new_folder(out) as folder:
        for name in ("images", "masks"):
            (folder / name).mkdir()
        for split, frames in splits.items():
            # Names are unique across folders, as nerfstudio's search for downscaled copies needs.
            files_of = [f"{split}_{i:0{digits}d}.png" for i in range(len(frames.names))]
            images[split] = [f"images/{name}" for name in files_of]
            if frames.masks is not None and sense != "none":
                masks[split] = [f"masks/{name}" for name in files_of]
            for number, name in enumerate(images[split]):
                shutil.copyfile(frames.images[number], folder / name)
                if frames.masks is not None and split in masks:
                    _write_mask(frames.masks[number], folder / masks[split][number], sense)
                step()
        if not masks:
            (folder / "masks").rmdir()
        cameras = {split: frames.cameras for split, frames in splits.items()}
        _check_masks(images, masks)
        nerfstudio.write_capture(folder, cameras, images, masks)


def _write_mask(source: Path, target: Path, sense: Sense) -> None:
    seen = image_files.read_mask(source)
    image_files.write_mask(target, seen if sense == "object" else ~seen)


def _check_masks(images: dict[str, list[str]], masks: dict[str, list[str]]) -> None:
    if masks and set(masks) != set(images):
        lacking = next(split for split in images if split not in masks)
        raise SceneError(
            f"The {lacking} split has no masks, but another has, and nerfstudio requires all or "
            "none. Use sense='none' to leave all masks out, or add the missing ones."
        )
