"""Writes parquet files as the published data set has them, and breaks them."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pyarrow
import pyarrow.parquet

from experiments.dataset import catalogue
from refref_jax.data import scene_names
from tests.factories.small_scenes import HEIGHT, WIDTH

NAME, CONFIG = "cube_smcvx_ball", "cubebg_single-convex"

Edit = Callable[[list[dict[str, Any]]], None]

_IMAGE = pyarrow.struct({"bytes": pyarrow.binary(), "path": pyarrow.string()})
_POSE = pyarrow.list_(pyarrow.list_(pyarrow.float64()))


def write_copy(
    copy: Path,
    *,
    name: str = NAME,
    rows: int = 300,
    shards: int = 1,
    folder: str = "data",
    metadata: dict[bytes, bytes] | None = None,
    edit: Edit = lambda rows: None,
    drop: tuple[str, ...] = (),
) -> list[Path]:
    """Writes a scene of tiny images into a copy of the repository; returns its files."""
    records = [row(i) for i in range(rows)]
    edit(records)
    types = dict.fromkeys(("image", "depth", "mask"), _IMAGE) | {"transform_matrix": _POSE}
    types = {column: kind for column, kind in types.items() if column not in drop}
    schema = pyarrow.schema(types, metadata=metadata)
    records = [{column: record[column] for column in types} for record in records]
    paths = []
    for shard in range(shards):
        part = records[rows * shard // shards : rows * (shard + 1) // shards]
        path = copy / folder / f"{name}-{shard:05d}-of-{shards:05d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        table = pyarrow.Table.from_pylist(part, schema=schema)
        # Groups that are no multiple of what is read at once.
        pyarrow.parquet.write_table(table, path, row_group_size=7)
        paths.append(path)
    return paths


def write_all(copy: Path) -> list[str]:
    """Writes the same three views as each scene of the data set; returns the scenes' names."""
    names = [
        f"{background}_{item.category}_{item.name}"
        for background in scene_names.BACKGROUNDS
        for item in catalogue.OBJECTS.values()
    ]
    (first,) = write_copy(copy, name=names[0], rows=3)
    for name in names[1:]:
        shutil.copyfile(first, first.with_name(f"{name}-00000-of-00001.parquet"))
    return names


def row(number: int) -> dict[str, Any]:
    """Returns a row whose image, depth and pose tell its number."""
    colour = np.full((HEIGHT, WIDTH, 3), (number % 256, number // 256, 7))
    mask = np.zeros((HEIGHT, WIDTH))
    mask[number % HEIGHT, number % WIDTH] = 255
    pose = np.eye(4)
    pose[:3, 3] = [number, 1.0 / 3.0, 4.0]
    return {
        "image": {"bytes": png(colour), "path": f"r_{number}.png"},
        "depth": {"bytes": png(np.full((HEIGHT, WIDTH), number % 256)), "path": None},
        "mask": {"bytes": png(mask), "path": None},
        "transform_matrix": pose.tolist(),
    }


def png(pixels: np.ndarray) -> bytes:
    """Returns an 8-bit PNG file."""
    return iio.imwrite("<bytes>", pixels.astype(np.uint8), plugin="pillow", extension=".png")
