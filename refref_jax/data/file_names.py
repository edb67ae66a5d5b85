"""How a scene's files are called in the layouts of folders (NumPy only).

    plain    {split}/r_000.png    mask/{split}/r_000.png         depth/{split}/r_000.png
    raw      {split}/r_0.png      {split}/r_0_mask_0000.png      {split}/r_0_depth_0000.png

`raw` is that of the data set's raw release. Readers go by the transforms file, never by these.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

from refref_jax.choices import Split

SPLITS: tuple[Split, ...] = get_args(Split)

TRANSFORMS = "transforms_{}.json"
"""Name of a split's transforms file."""


class FrameFiles(NamedTuple):
    """Files of one frame, below the scene's folder.

    Attributes:
      image: without its ending, which is `.png`.
      mask: with it.
      depth: with it.
    """

    image: str
    mask: str
    depth: str


Naming = Callable[[str, int], FrameFiles]
"""From a split and the number of a frame to its files."""


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
      files: the frame's.
      pose: 4 x 4, camera to world.
      masked: whether it has a mask.
      deep: whether it has a depth map.
    """
    record: dict[str, Any] = {"file_path": f"./{files.image}"}
    if masked:
        record["mask_file_path"] = f"./{files.mask}"
    if deep:
        record["depth_file_path"] = f"./{files.depth}"
    return record | {"transform_matrix": [list(row) for row in pose]}
