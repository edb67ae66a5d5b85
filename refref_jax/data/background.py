"""Whether a scene's background is near or infinitely far (NumPy only)."""

import json
from pathlib import Path

from refref_jax.data.errors import SceneError

_UNBOUNDED = {"cube": False, "sphere": False, "env": True}


def is_unbounded(scene: Path) -> bool:
    """Returns whether the background is an environment map.

    `scene.json` decides if it names the background; otherwise the folder's name does, which
    begins with `env` in the data set, and with `cube` or `sphere` where there are walls.
    """
    path = scene / "scene.json"
    if path.is_file():
        try:
            background = json.loads(path.read_text(encoding="utf-8")).get("background", {})
            if "type" in background:
                return _UNBOUNDED[background["type"]]
        except (ValueError, AttributeError, TypeError, KeyError) as error:
            raise SceneError(
                f"{path} can not be understood ({error!r}). The type of its background is one of "
                f"{', '.join(_UNBOUNDED)}. Correct it, or remove it: it is optional."
            ) from error
    return scene.resolve().name.split("_")[0] == "env"
