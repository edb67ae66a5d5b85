"""Whether a scene's background is near or infinitely far, and where it stands (NumPy only).

`scene.json` may tell; the data set's own scenes have none.
"""

import math
from pathlib import Path
from typing import Any

from refref_jax.data import transforms
from refref_jax.data.errors import SceneError
from refref_jax.sampling.domains import Space

_FILE = "scene.json"
_SPACES: dict[str, Space] = {"cube": "bounded", "sphere": "bounded", "env": "unbounded"}


def space(scene: Path) -> Space:
    """Returns `unbounded` if the background is an environment map.

    `scene.json` decides if it names the background; otherwise the folder's name does, which
    begins with `env` in the data set, and with `cube` or `sphere` where there are walls.
    """
    kind = _background(scene).get("type")
    if kind is None:
        return "unbounded" if scene.resolve().name.split("_")[0] == "env" else "bounded"
    if not isinstance(kind, str) or kind not in _SPACES:
        raise SceneError(
            f"The type of the background is {kind!r} in {scene / _FILE}, not one of "
            f"{', '.join(_SPACES)}. Correct it, or remove the file: it is optional."
        )
    return _SPACES[kind]


def half_extent(scene: Path) -> float | None:
    """Returns half the edge of the cube that the walls form, if `scene.json` tells it."""
    extent = _background(scene).get("half_extent")
    if extent is None:
        return None
    if not isinstance(extent, (int, float)) or not 0.0 < extent < math.inf:
        raise SceneError(
            f"The half_extent of the background is {extent!r} in {scene / _FILE}. Give a positive "
            "number, or remove it: it is optional."
        )
    return float(extent)


def _background(scene: Path) -> dict[str, Any]:
    path = scene / _FILE
    background = transforms.read_json(path).get("background", {}) if path.is_file() else {}
    if not isinstance(background, dict):
        raise SceneError(
            f"The background is {background!r} in {path}, not an object. Correct it, or remove the "
            "file: it is optional."
        )
    return background
