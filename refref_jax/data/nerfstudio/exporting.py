"""Writes a scene of ours for nerfstudio (NumPy only)."""

import shutil
from collections.abc import Callable
from pathlib import Path

from refref_jax import atomic_files
from refref_jax.data import files, local_layout
from refref_jax.data.errors import SceneError
from refref_jax.data.local_layout import Frames
from refref_jax.data.nerfstudio import capture as nerfstudio
from refref_jax.data.nerfstudio.importing import Sense


def read_splits(scene: Path) -> dict[str, Frames]:
    """Returns the splits that a scene has."""
    names = [
        split
        for split in local_layout.SPLITS
        if split == "train" or (scene / f"transforms_{split}.json").is_file()
    ]
    return {split: local_layout.read_frames(scene, split) for split in names}


def write_capture(
    splits: dict[str, Frames], out: Path, sense: Sense, *, step: Callable[[], None]
) -> None:
    """Writes a capture, which appears when it is whole. Images are copied byte for byte.

    Args:
      splits: of the scene.
      out: its folder; must not exist.
      sense: what is to be white in the masks.
      step: is called after every image.

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
            # Every name is its own, whatever its folder: nerfstudio looks for smaller copies so.
            files_of = [f"{split}_{i:0{digits}d}.png" for i in range(len(frames.names))]
            images[split] = [f"images/{name}" for name in files_of]
            if frames.masks is not None and sense != "none":
                masks[split] = [f"masks/{name}" for name in files_of]
            for number, name in enumerate(images[split]):
                shutil.copyfile(frames.images[number], folder / name)
                if split in masks:
                    _write_mask(frames.masks[number], folder / masks[split][number], sense)
                step()
        if not masks:
            (folder / "masks").rmdir()
        cameras = {split: frames.cameras for split, frames in splits.items()}
        _check_masks(images, masks)
        nerfstudio.write_capture(folder, cameras, images, masks)


def _write_mask(source: Path, target: Path, sense: Sense) -> None:
    seen = files.read_mask(source)
    files.write_mask(target, seen if sense == "object" else ~seen)


def _check_masks(images: dict[str, list[str]], masks: dict[str, list[str]]) -> None:
    if masks and set(masks) != set(images):
        lacking = next(split for split in images if split not in masks)
        raise SceneError(
            f"The {lacking} split has no masks, but another has, and nerfstudio wants all or none. "
            "Give the sense none to leave them all out, or add them."
        )
