"""Reads and writes scene folders in the local layout of the data set (NumPy only).

    {scene}/transforms_{train,val,test}.json    poses and file names
    {scene}/{split}/*.png  mask/  depth/        named in the JSON
    {scene}/meshes/*.ply                        see `meshes`
    {scene}/scene.json                          optional, see `scene_properties`

Files are named in one of two ways; `raw` is that of the data set's raw release:

    plain    {split}/r_000.png    mask/{split}/r_000.png         depth/{split}/r_000.png
    raw      {split}/r_0.png      {split}/r_0_mask_0000.png      {split}/r_0_depth_0000.png

Readers use the names in the transforms file, never these patterns. A depth map that is named as PNG
is read from the float EXR of the same name if there is one.

`add_masks` copies a scene and adds the masks of a segmentation model. Users choose the model: it is
a function that takes the path of an image and returns the pixels that show the object.
`docs/masks.md` has examples.

Every function raises a `SceneError` that names the file and the remedy.
"""

import collections
import json
import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from refref_jax import atomic_files, configuration
from refref_jax.choices import SPLITS
from refref_jax.data import FARTHEST, SceneError, file_inside, image_files
from refref_jax.geometry.cameras import Cameras, focal_length, planar_depth_to_distance

# Poses are stored with at least six digits; a larger deviation is a scale or a shear.
_ROTATION_TOLERANCE = 1e-3

# Keys of a transforms file and of its frames; of others, those that are as similar are refused.
_FILE = "file_path"
_KEYS = ("camera_angle_x", "frames")
_FRAME_KEYS = (_FILE, "mask_file_path", "depth_file_path", "transform_matrix")
_MISSPELT = 0.9
_NAME_IN_NERFSTUDIO = {"mask_path": "mask_file_path"}

# Smallest field of view, radians; relative difference of lenses that count as the same.
_NARROWEST, _SAME_LENS = 1e-4, 2e-3

# Characters of a name in a message.
_LONGEST_SHOWN = 100

TRANSFORMS = "transforms_{}.json"
"""Pattern of the name of a split's transforms file."""

Segment = Callable[[Path], Bool[np.ndarray, "h w"]]
"""Segmentation model: takes the path of an image, returns the mask of the object."""


def read_json(path: Path) -> dict[str, Any]:
    """Reads a JSON object."""
    if not path.is_file():
        raise SceneError(
            f"{path} does not exist. Give the folder of a scene, with "
            "transforms_train.json, transforms_val.json and transforms_test.json."
        )
    try:
        content = configuration.parse_json(path.read_text(encoding="utf-8-sig"))
    except ValueError as error:
        raise SceneError(f"{path} is not valid JSON ({error}). Copy it again.") from error
    if not isinstance(content, dict):
        raise SceneError(f"{path} is not a JSON object. Copy it again.")
    return content


def get(record: Any, name: str, path: Path) -> Any:
    """Returns a required value of a record of a file."""
    if not isinstance(record, dict) or name not in record:
        raise SceneError(f"{path} lacks the key {name!r}. Add it, as the data format requires.")
    return record[name]


def get_text(record: Any, name: str, path: Path) -> str:
    """Returns a required string of a record of a file."""
    text = get(record, name, path)
    if not isinstance(text, str):
        shown = configuration.abridged(text)
        raise SceneError(f"{name} is {shown} in {path}. Use the name of a file.")
    return text


def rigid_motion(matrix: Any, name: str, path: Path) -> Float[np.ndarray, "3 4"]:
    """Returns the upper three rows of a 4 x 4 rotation and translation."""
    name = name[:_LONGEST_SHOWN]
    rows = matrix if isinstance(matrix, list) else []
    square = len(rows) == 4 and all(isinstance(row, list) and len(row) == 4 for row in rows)
    numbers = [[configuration.as_number(x) for x in row] for row in rows if square]
    pose = np.asarray(numbers, np.float64)
    if pose.shape != (4, 4) or not np.all(np.isfinite(pose)):
        raise SceneError(
            f"The transform_matrix of {name} in {path} is not a finite 4 x 4 matrix. Export the "
            "poses again."
        )
    rotation = pose[:3, :3]
    residual = np.max(np.abs(rotation @ rotation.T - np.eye(3)))
    if np.max(np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0])) > _ROTATION_TOLERANCE:
        raise SceneError(
            f"The transform_matrix of {name} in {path} ends with the row {pose[3]}, not "
            "0 0 0 1. Export camera-to-world matrices, with the position in the last column."
        )
    if residual > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise SceneError(
            f"The transform_matrix of {name} in {path} is not rigid: its axes are scaled, "
            f"sheared or mirrored (deviation {residual:.2g}). Export the poses without scale."
        )
    if np.max(np.abs(pose[:3, 3])) > FARTHEST:
        raise SceneError(
            f"The transform_matrix of {name} in {path} has the position {pose[:3, 3]}. Move the "
            f"scene to the origin: coordinates are at most {FARTHEST:g} world units."
        )
    return pose[:3]


class FrameFiles(NamedTuple):
    """Files of one frame, relative to the scene folder.

    Attributes:
      image: path of the image, without its extension `.png`.
      mask: path of the mask, with extension.
      depth: path of the depth map, with extension.
    """

    image: str
    mask: str
    depth: str


Naming = Callable[[str, int], FrameFiles]
"""Function from a split and the number of a frame to its files."""


def plain(split: str, number: int) -> FrameFiles:
    """Returns the plain names."""
    name = f"{split}/r_{number:03d}"
    return FrameFiles(name, f"mask/{name}.png", f"depth/{name}.png")


def raw(split: str, number: int) -> FrameFiles:
    """Returns the names of the raw release."""
    name = f"{split}/r_{number}"
    return FrameFiles(name, f"{name}_mask_0000.png", f"{name}_depth_0000.png")


def write_transforms(scene: Path, split: str, content: dict[str, Any]) -> None:
    """Writes the transforms file of a split; numbers are read back exactly."""
    text = json.dumps(content, indent=1) + "\n"
    (scene / TRANSFORMS.format(split)).write_text(text, encoding="utf-8")


def frame_record(
    files: FrameFiles, pose: Sequence[Sequence[float]], *, masked: bool, deep: bool
) -> dict[str, Any]:
    """Returns a frame of a transforms file.

    Args:
      files: files of the frame.
      pose: camera-to-world matrix, 4 x 4.
      masked: whether it has a mask.
      deep: whether it has a depth map.
    """
    record: dict[str, Any] = {"file_path": f"./{files.image}"}
    if masked:
        record["mask_file_path"] = f"./{files.mask}"
    if deep:
        record["depth_file_path"] = f"./{files.depth}"
    return record | {"transform_matrix": [list(row) for row in pose]}


class Frames(NamedTuple):
    """One split of a scene: paths of its files, and its cameras.

    Attributes:
      names: stem of each image, unique in the split.
      images: paths of the 8-bit images.
      masks: paths of the object masks, or `None` if the split has none.
      depths: paths of the planar depth maps, or `None` if the split has none.
      cameras: cameras of the frames.
    """

    names: tuple[str, ...]
    images: tuple[Path, ...]
    masks: tuple[Path, ...] | None
    depths: tuple[Path, ...] | None
    cameras: Cameras


def read_frames(scene: Path, split: str) -> Frames:
    """Reads the cameras of a split, and checks that all of its files exist.

    Args:
      scene: the scene folder.
      split: `train`, `val` or `test`.

    Raises:
      SceneError: if a file is missing or broken, or a pose is not a rigid motion.
    """
    path = scene / _transforms_name(split)
    content = read_json(path)
    frames = get(content, "frames", path)
    if not isinstance(frames, list) or not frames:
        raise SceneError(f"{path} lists no frames. Add frames, or remove the split.")
    stems = [get(frame, "file_path", path) for frame in frames]
    for record, known in ((content, _KEYS), *((frame, _FRAME_KEYS) for frame in frames)):
        _refuse_misspelt(record, known, path)
    named = (f"{stem}.png" if isinstance(stem, str) else stem for stem in stems)
    images = tuple(file_inside([scene], name, where=_FILE, path=path) for name in named)
    width, height = _image_size(images[0])
    angle = configuration.as_number(get(content, "camera_angle_x", path))
    if not _NARROWEST <= angle <= math.pi - _NARROWEST:
        shown = configuration.abridged(content["camera_angle_x"])
        raise SceneError(
            f"camera_angle_x is {shown} in {path}. Give the horizontal field of view in radians, "
            "between 0 and pi."
        )
    poses = np.stack(
        [
            rigid_motion(get(frame, "transform_matrix", path), stem, path)
            for frame, stem in zip(frames, stems, strict=True)
        ]
    )
    masks = _optional_files(scene, frames, stems, "mask_file_path", path)
    depths = _optional_files(scene, frames, stems, "depth_file_path", path)
    result = Frames(
        names=tuple(image.stem for image in images),
        images=images,
        masks=masks,
        depths=depths and tuple(_prefer_exr(depth) for depth in depths),
        cameras=Cameras(poses, width, height, focal_length(width, angle)),
    )
    for record in (content, *frames):
        _refuse_other_lenses(record, result.cameras, path)
    _check_files(result)
    return result


def _refuse_misspelt(record: Any, known: Sequence[str], path: Path) -> None:
    """Refuses keys that resemble one that is missing; other programs may write any other key."""
    for key in set(record) - set(known):
        missing = set(known) - set(record)
        near = configuration.nearest(key, missing, similarity=_MISSPELT)
        near = _NAME_IN_NERFSTUDIO.get(key, near)
        if near in missing:
            raise SceneError(
                f"{path}: {configuration.abridged(key)} is not a known key. Write {near!r}, or "
                "remove it."
            )


def _refuse_other_lenses(record: dict[str, Any], cameras: Cameras, path: Path) -> None:
    """Refuses intrinsics of nerfstudio that contradict this layout's pinhole."""
    width, height = cameras.width, cameras.height
    focal = dict.fromkeys(("fl_x", "fl_y"), cameras.focal)
    centre = {"cx": 0.5 * width, "cy": 0.5 * height, "w": float(width), "h": float(height)}
    distortion = dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), 0.0)
    for key, expected in (focal | centre | distortion).items():
        if record.get(key) is None:
            continue
        value = configuration.as_number(record[key])
        # Programs write rounding errors of k1, and a centre of (w - 1) / 2.
        near = {**dict.fromkeys(distortion, 1e-6), "cx": 0.5, "cy": 0.5}.get(key, 0.0)
        if not math.isclose(value, expected, rel_tol=_SAME_LENS, abs_tol=near):
            raise SceneError(
                f"{path}: {key} is {configuration.abridged(record[key])}, but camera_angle_x and "
                f"the images mean {expected:g}: this layout has undistorted pinholes with the "
                "principal point in the middle. Remove the key, or convert the images, as "
                "docs/data_formats.md explains."
            )


def check_scene(scene: Path, *, needed: Sequence[str] = ("train",)) -> None:
    """Reads every file of every split once, so that broken files are reported early.

    Args:
      scene: the scene folder.
      needed: splits that must exist.

    Raises:
      SceneError: at the first file that is broken or missing.
    """
    for split in SPLITS:
        if split in needed or (scene / _transforms_name(split)).is_file():
            frames = read_frames(scene, split)
            for readings in (_images(frames), _masks(frames), _depths(frames)):
                collections.deque(readings, maxlen=0)


def read_images(frames: Frames) -> UInt8[np.ndarray, "frames h w 3"]:
    """Reads the images of a split as 8-bit sRGB, composited over white."""
    return np.stack(list(_images(frames)))


def read_masks(frames: Frames) -> Bool[np.ndarray, "frames h w"]:
    """Reads the object masks of a split; those of views without the object are empty.

    Raises:
      SceneError: if the split has none.
    """
    if frames.masks is None:
        raise SceneError(
            f"The frames of {frames.images[0].parent} have no masks. Add mask_file_path to each "
            "frame of the transforms file; docs/masks.md explains how to import the masks of a "
            "segmentation model."
        )
    return np.stack(list(_masks(frames)))


def read_object_views(frames: Frames) -> tuple[Frames, Bool[np.ndarray, "views h w"]]:
    """Returns the frames of a split whose masks mark the object, and these masks.

    Raises:
      SceneError: if the split has no masks, or none of them marks the object.
    """
    masks, paths = read_masks(frames), frames.masks or ()
    shown = np.flatnonzero(masks.any(axis=(1, 2)))
    if not len(shown):
        raise SceneError(
            f"None of the {len(masks)} masks in {paths[0].parent} marks the object. Give "
            "masks in which the object is not black; docs/masks.md explains how to import them."
        )
    depths = frames.depths and tuple(frames.depths[i] for i in shown)
    kept = Frames(
        names=tuple(frames.names[i] for i in shown),
        images=tuple(frames.images[i] for i in shown),
        masks=tuple(paths[i] for i in shown),
        depths=depths,
        cameras=frames.cameras._replace(poses=frames.cameras.poses[shown]),
    )
    return kept, masks[shown]


def read_distances(frames: Frames) -> Float[np.ndarray, "frames h w"]:
    """Reads the depth maps of a split as distance along each pixel's unit ray, world units.

    Rays that hit nothing have `inf` in a float map. 8-bit maps saturate at a planar depth of 11.5.
    """
    if frames.depths is None:
        raise SceneError(
            f"The frames of {frames.images[0].parent} have no depth maps. Add depth_file_path to "
            "each frame of the transforms file."
        )
    return planar_depth_to_distance(frames.cameras, np.stack(list(_depths(frames))))


def _images(frames: Frames) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    for path in frames.images:
        yield _checked(image_files.read_rgb(path), path, frames)


def _masks(frames: Frames) -> Iterator[Bool[np.ndarray, "h w"]]:
    for path in frames.masks or ():
        yield _checked(image_files.read_mask(path), path, frames)


def _depths(frames: Frames) -> Iterator[Float[np.ndarray, "h w"]]:
    for path in frames.depths or ():
        yield _checked(image_files.read_depth(path), path, frames)


def _transforms_name(split: str) -> str:
    return f"transforms_{split}.json"


def _optional_files(
    scene: Path, frames: list[Any], stems: list[str], key: str, path: Path
) -> tuple[Path, ...] | None:
    """Returns the files that all frames name under a key, or `None` if no frame does."""
    lacking = [stem for frame, stem in zip(frames, stems, strict=True) if key not in frame]
    if len(lacking) == len(frames):
        return None
    if lacking:
        raise SceneError(
            f"The frame {lacking[0]} of {path} lacks {key!r}, like {len(lacking)} of {len(frames)} "
            "frames. Add it to these, or remove it from all."
        )
    return tuple(file_inside([scene], frame[key], where=key, path=path) for frame in frames)


def _prefer_exr(path: Path) -> Path:
    exr = path.with_suffix(".exr")
    return exr if exr.is_file() else path


def _image_size(path: Path) -> tuple[int, int]:
    height, width, _ = image_files.read_rgb(path).shape
    return width, height


def _check_files(frames: Frames) -> None:
    for paths in (frames.images, frames.masks or (), frames.depths or ()):
        for path in paths:
            if not path.is_file():
                raise SceneError(
                    f"{path} does not exist, but the transforms file names it. Copy the scene "
                    "again, or remove the frame."
                )
    name, count = collections.Counter(frames.names).most_common(1)[0]
    if count > 1:
        raise SceneError(
            f"{count} frames of {frames.images[0].parent} have the same file name, {name}. Give "
            "every frame a unique name."
        )


def _checked(pixels: np.ndarray, path: Path, frames: Frames) -> np.ndarray:
    """Checks that an image has the size of its split."""
    expected = (frames.cameras.height, frames.cameras.width)
    if pixels.shape[:2] != expected:
        height, width = pixels.shape[:2]
        raise SceneError(
            f"{path} is {width} x {height} pixels, but the split's images are {expected[1]} x "
            f"{expected[0]}. Render it again at that size."
        )
    return pixels


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
      SceneError: if the copy exists, the scene is broken, or a mask is not boolean or not of the
        size of its image, or if no mask marks the object.
    """
    read_json(scene / "transforms_train.json")
    if out.exists():
        raise SceneError(f"{out} exists, and nothing is overwritten. Give a new folder.")
    if scene.resolve() in out.resolve().parents:
        raise SceneError(f"{out} is inside the scene {scene}. Give a folder next to it.")
    with atomic_files.new_folder(out) as draft:
        shutil.copytree(scene, draft, dirs_exist_ok=True)
        paths = (draft / f"transforms_{split}.json" for split in SPLITS)
        marked = [
            each for path in paths if path.is_file() for each in _add_to_split(scene, path, segment)
        ]
        if not any(marked):
            raise SceneError(
                f"None of the {len(marked)} masks of {scene} marks the object. Check the model, or "
                "the level above which its output is the object."
            )
    return len(marked)


def _add_to_split(scene: Path, path: Path, segment: Segment) -> list[bool]:
    """Writes masks of a split of the copy; returns whether each of them marks the object."""
    marked = []
    content = read_json(path)
    frames = get(content, "frames", path)
    for frame in frames:
        stem = get_text(frame, "file_path", path)
        if Path(stem).is_absolute() or ".." in Path(stem).parts:  # it names a file that is written
            raise SceneError(
                f"{path} names the image {stem}, which is not in the scene's folder. Move the "
                "images there, and give their names relative to it."
            )
        mask = _mask_of(scene / f"{stem}.png", segment)
        marked.append(bool(mask.any()))
        name = Path("mask") / f"{stem}.png"
        (path.parent / name).parent.mkdir(parents=True, exist_ok=True)
        image_files.write_mask(path.parent / name, mask)
        frame["mask_file_path"] = f"./{name.as_posix()}"
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return marked


def _mask_of(image: Path, segment: Segment) -> Bool[np.ndarray, "h w"]:
    expected = image_files.read_rgb(image).shape[:2]
    mask = np.asarray(segment(image))
    if mask.dtype != bool or mask.shape != expected:
        raise SceneError(
            f"The mask of {image} is an array {mask.dtype}{list(mask.shape)}, not "
            f"bool{list(expected)}. Compare the model's output with a threshold, and resize it to "
            "the image without interpolation."
        )
    return mask
