"""Reads the views of a scene folder, and writes a copy with refined poses (NumPy only)."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from experiments.cameras.bundle import Views
from experiments.cameras.refinement import Photo, Refined
from experiments.cameras.through_object import RefinedThrough
from refref_jax import atomic_files
from refref_jax.choices import SPLITS
from refref_jax.data import SceneError, image_files, scene_folder

RECORD = "cameras.json"
"""File of a refined scene with the corrections of all views."""


class SceneViews(NamedTuple):
    """The views of all splits of a scene.

    Attributes:
      views: their cameras.
      photos: their images and masks.
      names: split and name of each.
    """

    views: Views
    photos: Sequence[Photo]
    names: Sequence[tuple[str, str]]


def read(scene: Path) -> SceneViews:
    """Reads all splits of a scene folder.

    Raises:
      SceneError: if a file is missing or broken, or there are fewer than three views.
    """
    poses, focals, middles, photos, names = [], [], [], [], []
    for split in SPLITS:
        if split != "train" and not (scene / scene_folder.TRANSFORMS.format(split)).is_file():
            continue
        frames = scene_folder.read_frames(scene, split)
        images = scene_folder.read_images(frames)
        for number, name in enumerate(frames.names):
            mask = None
            if frames.masks is not None:
                mask = image_files.read_mask(frames.masks[number])
            photos.append(Photo(images[number], mask))
            poses.append(frames.cameras.poses[number])
            focals.append(frames.cameras.focal)
            middles.append([0.5 * frames.cameras.width, 0.5 * frames.cameras.height])
            names.append((split, name))
    if len(names) < 3:
        raise SceneError(f"{scene} has {len(names)} views. Give three or more to refine cameras.")
    return SceneViews(Views(np.array(poses), np.array(focals), np.array(middles)), photos, names)


def check_place(scene: Path, out: Path) -> None:
    """Rejects an output folder that exists, or that is inside the scene.

    Raises:
      SceneError: if it is one of them.
    """
    if out.exists():
        raise SceneError(f"{out} exists, and nothing is overwritten. Give a new folder.")
    if scene.resolve() in out.resolve().parents:
        raise SceneError(f"{out} is inside the scene {scene}. Give a folder next to it.")


def write(scene: Path, out: Path, before: SceneViews, refined: Refined | RefinedThrough) -> None:
    """Writes a copy of a scene with refined poses, which appears when it is complete.

    Args:
      scene: folder of the scene.
      out: folder of the copy; see `check_place`.
      before: views of the scene, as `read` returns them.
      refined: the refinement.
    """
    check_place(scene, out)
    with atomic_files.new_folder(out) as draft:
        shutil.copytree(scene, draft, dirs_exist_ok=True)
        start = 0
        for split in dict.fromkeys(split for split, _ in before.names):
            path = draft / scene_folder.TRANSFORMS.format(split)
            content = scene_folder.read_json(path)
            for frame in content["frames"]:
                frame["transform_matrix"] = _square(refined.poses[start])
                start += 1
            path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        record = json.dumps(_record(before, refined), indent=1, allow_nan=False) + "\n"
        (draft / RECORD).write_text(record, encoding="utf-8")


def _square(pose: Float[np.ndarray, "3 4"]) -> list[list[float]]:
    return [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]


def _record(before: SceneViews, refined: Refined | RefinedThrough) -> dict[str, object]:
    facts, of_views = refined.record()
    return {
        **facts,
        "views": [
            {
                "split": split,
                "name": name,
                **{key: values[number].item() for key, values in of_views.items()},
                "turned_degrees": float(np.degrees(np.linalg.norm(correction[:3]))),
                "moved": float(np.linalg.norm(correction[3:])),
                "given": _square(before.views.poses[number]),
            }
            for number, ((split, name), correction) in enumerate(
                zip(before.names, refined.corrections, strict=True)
            )
        ],
    }
