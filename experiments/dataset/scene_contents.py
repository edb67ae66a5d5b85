"""Lists the files of a scene's folder by type: the first half of every conversion (NumPy only).

A frame is its image, mask and depth map; all other files are *extras*, by their path relative to
the folder: `scene.json`, meshes, textures, float maps.
"""

from pathlib import Path
from typing import Any, NamedTuple

from refref_jax import configuration
from refref_jax.data import SceneError, meshes, scene_folder


class Frame(NamedTuple):
    """Files of a frame.

    Attributes:
      image: 8-bit image.
      mask: mask of the object, if it exists.
      depth: depth map, if the transforms file names one.
      linear: EXR next to the image, if it exists.
      float_depth: EXR next to the depth map, if it exists.
      record: record of the frame in the transforms file.
    """

    image: Path
    mask: Path | None
    depth: Path | None
    linear: Path | None
    float_depth: Path | None
    record: dict[str, Any]


class Split(NamedTuple):
    """One split: its frames, and the other contents of its transforms file."""

    frames: tuple[Frame, ...]
    header: dict[str, Any]


class SceneContents(NamedTuple):
    """Contents of a scene's folder.

    Attributes:
      splits: frames by the name of the split; only existing splits.
      extras: all other files, by their path relative to the folder; meshes of the raw release are
        in `meshes/`.
    """

    splits: dict[str, Split]
    extras: dict[str, Path]


def read(scene: Path) -> SceneContents:
    """Lists the files of a scene, and checks its cameras and that all files exist.

    Raises:
      SceneError: if a file is missing or broken.
    """
    present = [
        split
        for split in scene_folder.SPLITS
        if split == "train" or (scene / scene_folder.TRANSFORMS.format(split)).is_file()
    ]
    splits = {split: _read_split(scene, split) for split in present}
    known = {
        path.resolve()
        for split in splits.values()
        for frame in split.frames
        for path in frame[:-1]
        if path is not None
    }
    known |= {(scene / scene_folder.TRANSFORMS.format(split)).resolve() for split in present}
    places = {path.relative_to(scene): path for path in sorted(scene.rglob("*")) if path.is_file()}
    extras = {
        place.as_posix(): path
        for place, path in places.items()
        if path.resolve() not in known and not any(part.startswith(".") for part in place.parts)
    }
    extras |= {f"meshes/{path.name}": path for path in meshes.mesh_files(scene)}
    return SceneContents(splits, extras)


def named_extras(contents: SceneContents) -> dict[str, Path]:
    """Returns the extras that are named in `scene.json`.

    These are `scene.json` itself, all meshes, and files such as textures.
    """
    words = _texts(_scene_json(contents))
    return {
        place: path
        for place, path in contents.extras.items()
        if place == "scene.json" or place.startswith("meshes/") or place in words
    }


def _read_split(scene: Path, split: str) -> Split:
    scene_folder.read_frames(scene, split)  # raises if a file is missing, or a pose is wrong
    content = scene_folder.read_json(scene / scene_folder.TRANSFORMS.format(split))
    records = content.pop("frames")
    return Split(tuple(_frame(scene, record) for record in records), content)


def _frame(scene: Path, record: dict[str, Any]) -> Frame:
    mask, depth = (record.get(f"{kind}_file_path") for kind in ("mask", "depth"))
    image = scene / f"{record['file_path']}.png"
    return Frame(
        image=image,
        mask=None if mask is None else scene / mask,
        depth=None if depth is None else scene / depth,
        linear=_exr_beside(image),
        float_depth=None if depth is None else _exr_beside(scene / depth),
        record=record,
    )


def _exr_beside(path: Path) -> Path | None:
    exr = path.with_suffix(".exr")
    return exr if exr.is_file() and exr != path else None


def _scene_json(contents: SceneContents) -> Any:
    path = contents.extras.get("scene.json")
    if path is None:
        return None
    try:
        return configuration.parse_json(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise SceneError(
            f"{path} is not valid JSON ({error}). Correct it, or remove it: it is optional."
        ) from error


def _texts(value: Any) -> set[str]:
    """Returns all strings in parsed JSON, normalized as paths."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return set().union(*map(_texts, value))
    return {Path(value).as_posix()} if isinstance(value, str) else set()
