"""Writes a scene as a folder, with plain names or those of the raw release."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiments.dataset.scene_contents import Frame, SceneContents
from refref_jax import atomic_files
from refref_jax.data import scene_folder
from refref_jax.data.scene_folder import FrameFiles, Naming


def write(
    contents: SceneContents, target: Path, *, naming: Naming, step: Callable[[], None]
) -> None:
    """Writes a scene's folder atomically.

    All extras keep their paths; an EXR next to an image or a depth map is copied with it.

    Args:
      contents: contents of the scene.
      target: output folder, which must not exist.
      naming: naming of the frames' files.
      step: callback after every image.
    """
    with atomic_files.new_folder(target) as scene:
        for split, (frames, header) in contents.splits.items():
            records = []
            for number, frame in enumerate(frames):
                records.append(_write_frame(frame, scene, naming(split, number)))
                step()
            scene_folder.write_transforms(scene, split, header | {"frames": records})
        for place, path in contents.extras.items():
            _copy(path, scene / place)


def _write_frame(frame: Frame, scene: Path, files: FrameFiles) -> dict[str, Any]:
    """Copies the files of a frame, and returns its record under their new names."""
    record = frame.record | {"file_path": f"./{files.image}"}
    _copy(frame.image, scene / f"{files.image}.png")
    if frame.linear is not None:
        _copy(frame.linear, scene / f"{files.image}.exr")
    if frame.mask is not None:
        record["mask_file_path"] = f"./{files.mask}"
        _copy(frame.mask, scene / files.mask)
    if frame.depth is not None:
        depth = Path(files.depth).with_suffix(frame.depth.suffix)
        record["depth_file_path"] = f"./{depth.as_posix()}"
        _copy(frame.depth, scene / depth)
        if frame.float_depth is not None:
            _copy(frame.float_depth, scene / depth.with_suffix(".exr"))
    return record


def _copy(path: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, target)
