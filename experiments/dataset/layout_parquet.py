"""Writes a scene as parquet files, as the data set is published on Hugging Face.

One row is one frame, the splits one after the other. The schema's metadata holds the features of
`datasets`, so that it shows the columns as images, and the number of frames of each split. All
other files that our readers can use are stored next to it, see `refref_jax.data.scene_source`.
"""

import json
import math
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from experiments.dataset import scene_contents
from experiments.dataset.scene_contents import Frame, SceneContents
from refref_jax import atomic_files
from refref_jax.data import SceneError, parquet_scenes
from refref_jax.data.parquet_scenes import IMAGE_COLUMNS, POSE_COLUMN
from refref_jax.data.scene_names import SceneName

# The file size of Hugging Face's own converter.
_BYTES_OF_A_SHARD = 500_000_000

# Small enough to show single images without reading the complete file, and to fit in memory.
_ROWS_OF_A_GROUP = 25

_FEATURES = {column: {"_type": "Image"} for column in IMAGE_COLUMNS} | {
    POSE_COLUMN: {
        "_type": "Sequence",
        "feature": {"_type": "Sequence", "feature": {"_type": "Value", "dtype": "float64"}},
    }
}


def write(
    contents: SceneContents, name: SceneName, out: Path, *, step: Callable[[], None]
) -> dict[str, Path]:
    """Writes the files of a scene atomically.

    Args:
      contents: contents of the scene.
      name: name of the scene.
      out: folder of the complete layout.
      step: callback after every image.

    Returns:
      Omitted files: extras by their paths, EXRs of frames by kind and split.

    Raises:
      SceneError: if pyarrow is missing, or the layout cannot hold the scene.
    """
    rows = [(split, frame) for split, found in contents.splits.items() for frame in found.frames]
    metadata = _metadata(contents, name)
    size = sum(path.stat().st_size for _, frame in rows for path in frame[:3] if path is not None)
    count = max(1, math.ceil(size / _BYTES_OF_A_SHARD))
    kept = scene_contents.named_extras(contents)
    (out / "data").mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".converting-", dir=out / "data") as beside:
        shards = [f"{name}-{i:05d}-of-{count:05d}.parquet" for i in range(count)]
        for i, shard in enumerate(shards):
            first, last = len(rows) * i // count, len(rows) * (i + 1) // count
            _write_shard(Path(beside) / shard, rows[first:last], metadata, step)
        _write_extras(kept, out / "scene_files" / str(name))
        for shard in shards:
            atomic_files.move(Path(beside) / shard, out / "data" / shard)
    left = {place: path for place, path in contents.extras.items() if place not in kept}
    for split, frame in rows:
        for kind, path in (("image", frame.linear), ("depth", frame.float_depth)):
            if path is not None:
                left[f"{kind}/{split}/{path.name}"] = path
    return left


def files_of(name: SceneName, out: Path) -> list[Path]:
    """Returns the parquet files of a scene in a folder."""
    return sorted((out / "data").glob(f"{name}-[0-9]*-of-[0-9]*.parquet"))


def _metadata(contents: SceneContents, name: SceneName) -> dict[bytes, bytes]:
    angles = {split.header["camera_angle_x"] for split in contents.splits.values()}
    if len(angles) > 1:
        raise SceneError(
            f"The splits of {name} have different fields of view, {sorted(angles)}, but parquet "
            "files have only one. Leave the scene as a folder."
        )
    frames = {split: len(found.frames) for split, found in contents.splits.items()}
    contents = parquet_scenes.Contents(frames, float(angles.pop()))
    return {
        b"huggingface": json.dumps({"info": {"features": _FEATURES}}).encode(),
        parquet_scenes.METADATA_KEY: parquet_scenes.encode(contents),
    }


def _write_shard(
    path: Path,
    rows: Sequence[tuple[str, Frame]],
    metadata: dict[bytes, bytes],
    step: Callable[[], None],
) -> None:
    parquet = parquet_scenes.import_parquet()
    import pyarrow

    image = pyarrow.struct({"bytes": pyarrow.binary(), "path": pyarrow.string()})
    pose = pyarrow.list_(pyarrow.list_(pyarrow.float64()))
    types = dict.fromkeys(IMAGE_COLUMNS, image) | {POSE_COLUMN: pose}
    schema = pyarrow.schema(types, metadata=metadata)
    # All images differ: a dictionary would not help.
    with parquet.ParquetWriter(path, schema, use_dictionary=False) as file:
        for start in range(0, len(rows), _ROWS_OF_A_GROUP):
            group = []
            for split, frame in rows[start : start + _ROWS_OF_A_GROUP]:
                group.append(_row(split, frame))
                step()
            file.write_table(pyarrow.Table.from_pylist(group, schema=schema))


def _row(split: str, frame: Frame) -> dict[str, Any]:
    if frame.depth is not None and frame.depth.suffix == ".exr":
        raise SceneError(
            f"{frame.depth} is a float map, but parquet files hold 8-bit depth. Write such a "
            "PNG next to it, and name it in the transforms file."
        )
    files = {"image": frame.image, "depth": frame.depth, "mask": frame.mask}
    row: dict[str, Any] = {
        column: path and {"bytes": path.read_bytes(), "path": f"{split}/{path.name}"}
        for column, path in files.items()
    }
    return row | {POSE_COLUMN: frame.record["transform_matrix"]}


def _write_extras(extras: dict[str, Path], folder: Path) -> None:
    # Without parquet files, the folder is left over from an interrupted conversion.
    shutil.rmtree(folder, ignore_errors=True)
    if not extras:
        return
    with atomic_files.new_folder(folder) as beside:
        for place, path in extras.items():
            (beside / place).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, beside / place)
