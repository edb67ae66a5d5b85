"""Unpacks a scene from parquet files, as the data set is published on Hugging Face (NumPy only).

One row is one frame. Its columns:

    image, mask, depth    the bytes of an image file, alone or as {bytes, path}; the last two may be
                          missing or empty
    transform_matrix      4 x 4, camera to world

The first third of the rows is `train`, the second `val`, the last `test`, and the field of view is
that of the data set. Metadata in the schema of a file, under `METADATA_KEY`, override both.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from refref_jax import configuration
from refref_jax.choices import SPLITS
from refref_jax.data import SceneError, scene_folder

CAMERA_ANGLE_X = 1.1656107902526855
"""Horizontal field of view of all published images, radians."""

METADATA_KEY = b"refref_jax"

IMAGE_COLUMNS = ("image", "depth", "mask")
POSE_COLUMN = "transform_matrix"

_ROWS_AT_ONCE = 16

Progress = Callable[[int, int], None]
"""Function of the number of frames done and their total."""


class Contents(NamedTuple):
    """Contents of a scene's parquet files.

    Attributes:
      frames: number of frames of each split, in the order of the rows.
      camera_angle_x: horizontal field of view, radians.
    """

    frames: dict[str, int]
    camera_angle_x: float = CAMERA_ANGLE_X


def encode(contents: Contents) -> bytes:
    """Returns the value under `METADATA_KEY`."""
    return json.dumps(contents._asdict()).encode()


def read_contents(shards: Sequence[Path]) -> Contents:
    """Reads the contents of a scene's parquet files, but no images.

    Args:
      shards: all files of one scene, in order.

    Raises:
      SceneError: if pyarrow is missing, if a file is broken or lacks a column, or if the number
        of rows is wrong.
    """
    rows, metadata = 0, None
    for shard in shards:
        with _opened(shard) as file:
            names = set(file.schema_arrow.names)
            if missing := {"image", POSE_COLUMN} - names:
                raise SceneError(
                    f"{shard} lacks the column {', '.join(sorted(missing))}; it has "
                    f"{', '.join(sorted(names)) or 'none'}. Use a file of the data set, or one "
                    "with the columns image and transform_matrix."
                )
            rows += file.metadata.num_rows
            metadata = metadata or (file.schema_arrow.metadata or {}).get(METADATA_KEY)
    return _thirds(rows, shards[0]) if metadata is None else _decoded(metadata, rows, shards[0])


def unpack(shards: Sequence[Path], scene: Path, *, progress: Progress) -> None:
    """Writes the frames of a scene to a folder in the local layout, with images byte for byte.

    Args:
      shards: all files of the scene, in order.
      scene: the folder, which must exist.
      progress: function called after every frame.

    Raises:
      SceneError: under the conditions of `read_contents`, or if a row is broken.
    """
    contents = read_contents(shards)
    total, done = sum(contents.frames.values()), 0
    rows = _rows(shards)
    for split, count in contents.frames.items():
        records: list[dict[str, Any]] = []
        for number in range(count):
            record = _write_frame(scene, split, number, *next(rows))
            if records and set(record) != set(records[0]):
                raise SceneError(
                    f"A row of {split} in {shards[0]} has no mask or depth map, but others have. "
                    "Copy the file again, or add it to all rows of the split."
                )
            records.append(record)
            done += 1
            progress(done, total)
        if count:
            content = {"camera_angle_x": contents.camera_angle_x, "frames": records}
            scene_folder.write_transforms(scene, split, content)


def import_parquet() -> Any:
    """Returns the module `pyarrow.parquet`.

    Raises:
      SceneError: if it is not installed.
    """
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise SceneError(
            "Parquet files are read by pyarrow, which is not installed. Install it: "
            "pip install -e '.[parquet]'."
        ) from error
    return pyarrow.parquet


def _opened(shard: Path) -> Any:
    parquet = import_parquet()
    try:
        return parquet.ParquetFile(shard)
    except Exception as error:  # pyarrow's own errors, and OSError
        raise _unreadable(shard, error) from error


def _rows(shards: Sequence[Path]) -> Iterator[tuple[dict[str, Any], str, Path]]:
    """Yields each row, its name for messages, and its file."""
    for shard in shards:
        with _opened(shard) as file:
            present = set(file.schema_arrow.names)
            columns = [name for name in (*IMAGE_COLUMNS, POSE_COLUMN) if name in present]
            batches, number = file.iter_batches(_ROWS_AT_ONCE, columns=columns), 0
            while (batch := _next(batches, shard)) is not None:
                for row in batch.to_pylist():
                    yield row, f"row {number}", shard
                    number += 1


def _next(batches: Iterator[Any], shard: Path) -> Any:
    try:
        return next(batches, None)
    except Exception as error:  # as above
        raise _unreadable(shard, error) from error


def _write_frame(
    scene: Path, split: str, number: int, row: dict[str, Any], name: str, shard: Path
) -> dict[str, Any]:
    """Writes the images of a row, and returns its record in the transforms file."""
    files = scene_folder.plain(split, number)
    pose = row[POSE_COLUMN]
    scene_folder.rigid_motion(pose, name, shard)
    paths = {"image": f"{files.image}.png", "mask": files.mask, "depth": files.depth}
    found = {column: _bytes(row.get(column), column, name, shard) for column in paths}
    if found["image"] is None:
        raise SceneError(f"{name} of {shard} has no image. Copy the file again.")
    for column, content in found.items():
        if content is not None:
            path = scene / paths[column]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
    masked, deep = found["mask"] is not None, found["depth"] is not None
    return scene_folder.frame_record(files, pose, masked=masked, deep=deep)


def _bytes(value: Any, column: str, name: str, shard: Path) -> bytes | None:
    if isinstance(value, dict):
        value = value.get("bytes")
    if value is None or isinstance(value, bytes):
        return value or None
    raise SceneError(
        f"The {column} of {name} in {shard} is not the bytes of an image file. Store the "
        "encoded images, not paths or pixels."
    )


def _thirds(rows: int, shard: Path) -> Contents:
    """Returns the published splits for a number of rows: three equal ones."""
    if rows == 0 or rows % len(SPLITS):
        raise SceneError(
            f"{shard} and the other files of its scene hold {rows} rows, not three equal splits. "
            "The data set has 300 rows per scene: copy the files again."
        )
    return Contents(dict.fromkeys(SPLITS, rows // len(SPLITS)))


def _decoded(metadata: bytes, rows: int, shard: Path) -> Contents:
    """Returns the contents that the metadata describe."""
    try:
        record = configuration.parse_json(metadata)
        frames: dict[str, int] = {split: int(record["frames"].get(split, 0)) for split in SPLITS}
        angle = float(record["camera_angle_x"])
        valid = min(frames.values()) >= 0
    except (ValueError, TypeError, KeyError, AttributeError):
        valid = False
    if not valid:
        raise SceneError(
            f"The metadata of {shard} are not valid. Convert the scene again with this version."
        )
    if sum(frames.values()) != rows:
        counts = ", ".join(f"{count} {split}" for split, count in frames.items())
        raise SceneError(
            f"{shard} and the other files of its scene hold {rows} rows, but should hold {counts}. "
            "Copy them again."
        )
    return Contents(frames, angle)


def _unreadable(shard: Path, error: Exception) -> SceneError:
    return SceneError(
        f"{shard} cannot be read as parquet ({error}). It may be truncated: copy it again."
    )
