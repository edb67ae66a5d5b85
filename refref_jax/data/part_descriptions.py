"""What the optional `scene.json` of a scene says about its meshes (NumPy only).

    {"parts": [{"mesh": "meshes/cup_glass.ply",
                "ior_inside": 1.5,                        index of refraction
                "smooth_normals": true,                   how it was shaded
                "colour_per_interface": [0.9, 1.0, 0.9],  linear RGB factor at its surface
                "absorption": [0.1, 0.0, 0.1],            linear RGB, per world unit inside
                "priority": 3}]}                          where bodies overlap the highest wins

Only `mesh` is needed.
"""

import math
from pathlib import Path
from typing import Any, Literal, NamedTuple

from refref_jax import configuration
from refref_jax.choices import CLEAR, NO_ABSORPTION, Colour
from refref_jax.data.errors import SceneError

Shading = Literal["auto", "smooth", "flat"]


class PartDescription(NamedTuple):
    """What is known of one mesh, or the default where nothing is.

    Attributes:
      index: index of refraction inside, relative to air; `None` leaves it to the file's name.
      shading: `smooth`, `flat`, or `auto` for smooth up to the crease angle.
      tint: factor of linear RGB light at every reflection and every crossing, 0 to 1.
      absorption: of the medium inside, linear RGB, per world unit.
      priority: of overlapping bodies the highest wins.
      colour_known: whether tint or absorption were told; then what is not told of the two takes no
        light.
    """

    index: float | None = None
    shading: Shading = "auto"
    tint: Colour = CLEAR
    absorption: Colour = NO_ABSORPTION
    priority: int = 0
    colour_known: bool = False


def read_part_descriptions(path: Path) -> dict[str, PartDescription]:
    """Returns the description of each mesh file that `scene.json` names, by file name.

    Raises:
      SceneError: if the file can not be understood, or a value has no physical meaning.
    """
    if not path.is_file():
        return {}
    try:
        parts = configuration.parse_json(path.read_text(encoding="utf-8")).get("parts", [])
        named = {Path(part["mesh"]).name: dict(part) for part in parts}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise SceneError(
            f"{path} can not be understood ({error}). Correct it, or remove it: it is optional."
        ) from error
    return {name: _describe(f"{path}: {name}", part) for name, part in named.items()}


def _describe(where: str, part: dict[str, Any]) -> PartDescription:
    found: dict[str, Any] = {}
    if "ior_inside" in part:
        found["index"] = index = _number(part["ior_inside"])
        if not 0.0 < index < math.inf:
            raise _refusal(where, part, "ior_inside", "a positive number, such as 1.5 for glass")
    if "smooth_normals" in part:
        if not isinstance(part["smooth_normals"], bool):
            raise _refusal(where, part, "smooth_normals", "true or false")
        found["shading"] = "smooth" if part["smooth_normals"] else "flat"
    if "colour_per_interface" in part:
        found["tint"] = tint = _colour(part["colour_per_interface"])
        if not all(0.0 <= channel <= 1.0 for channel in tint):
            wanted = "three numbers from 0 to 1, since no surface adds light"
            raise _refusal(where, part, "colour_per_interface", wanted)
    if "absorption" in part:
        found["absorption"] = absorption = _colour(part["absorption"])
        if not all(0.0 <= channel < math.inf for channel in absorption):
            wanted = "three numbers that are 0 or positive, per world unit"
            raise _refusal(where, part, "absorption", wanted)
    if "priority" in part:
        found["priority"] = part["priority"]
        if not isinstance(part["priority"], int) or isinstance(part["priority"], bool):
            raise _refusal(where, part, "priority", "a whole number; the highest wins")
    found["colour_known"] = "tint" in found or "absorption" in found
    return PartDescription(**found)


def _number(value: Any) -> float:
    """Returns a number, or NaN for what is none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _colour(value: Any) -> Colour:
    """Returns three numbers, or three times NaN for what is none."""
    if not isinstance(value, list) or len(value) != 3:
        return math.nan, math.nan, math.nan
    red, green, blue = map(_number, value)
    return red, green, blue


def _refusal(where: str, part: dict[str, Any], key: str, wanted: str) -> SceneError:
    return SceneError(f"{where} has the {key} {part[key]!r}. Give {wanted}.")
