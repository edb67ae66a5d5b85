"""The JSON that places a scene's cameras: what it must hold (NumPy only).

Every function raises a `SceneError` that names the file and says what to do.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from refref_jax import configuration
from refref_jax.data.errors import SceneError

# Poses are written with six digits or more; a larger deviation is a scale or a shear.
_ROTATION_TOLERANCE = 1e-3


def read_json(path: Path) -> dict[str, Any]:
    """Reads a JSON object."""
    if not path.is_file():
        raise SceneError(
            f"{path} does not exist. Give the folder of a scene, which holds "
            "transforms_train.json, transforms_val.json and transforms_test.json."
        )
    try:
        content = configuration.parse_json(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise SceneError(f"{path} is not valid JSON ({error}). Copy it again.") from error
    if not isinstance(content, dict):
        raise SceneError(f"{path} is not a JSON object. Copy it again.")
    return content


def get(record: Any, name: str, path: Path) -> Any:
    """Returns a value that a record of a file must have."""
    if not isinstance(record, dict) or name not in record:
        raise SceneError(f"{path} lacks the key {name!r}. Add it, as the data format asks.")
    return record[name]


def get_text(record: Any, name: str, path: Path) -> str:
    """Returns a text that a record of a file must have."""
    text = get(record, name, path)
    if not isinstance(text, str):
        raise SceneError(f"{name} is {text!r} in {path}. Give the name of a file.")
    return text


def rigid_motion(matrix: Any, name: str, path: Path) -> Float[np.ndarray, "3 4"]:
    """Returns the upper three rows of a 4 x 4 matrix that rotates and moves, nothing else."""
    try:
        pose = np.asarray(matrix, np.float64)
    except (TypeError, ValueError):
        pose = np.empty(0)
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
            f"The transform_matrix of {name} in {path} does not rotate: its axes are scaled, "
            f"sheared or mirrored (deviation {residual:.2g}). Export the poses without scale."
        )
    return pose[:3]
