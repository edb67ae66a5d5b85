"""Options that commands which read a scene's meshes share."""

import math

from absl import flags

from experiments.cli import choosable

RULE = flags.DEFINE_enum(
    "rule",
    "nested",
    choosable.RULES,
    "What lies outside each mesh: the part around it, always air (as Cycles does it), or, of "
    "meshes that overlap, the one with the highest 'priority' in scene.json.",
)
IOR = flags.DEFINE_multi_string(
    "ior", [], "Index of refraction of a material or a mesh, as glass=1.52. May be repeated."
)


def given_indices() -> dict[str, float]:
    """Returns the indices of refraction that `--ior=NAME=NUMBER` options give.

    Raises:
      ValueError: if one is not of that form, or no index.
    """
    return dict(map(_parse, IOR.value))


def _parse(word: str) -> tuple[str, float]:
    name, _, number = word.partition("=")
    try:
        index = float(number)
    except ValueError:
        index = math.nan
    if not name or not 0.0 < index < math.inf:
        raise ValueError(
            f"--ior={word} is not NAME=NUMBER with a positive number. Write as in --ior=glass=1.52."
        )
    return name, index
