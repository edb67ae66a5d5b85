"""Options that commands which read a scene's meshes share."""

from absl import flags

from experiments import choosable

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
      ValueError: if one is not of that form.
    """
    indices = {}
    for word in IOR.value:
        name, separator, number = word.partition("=")
        try:
            indices[name] = float(number)
        except ValueError:
            separator = ""
        if not separator or not name:
            raise ValueError(f"--ior={word} is not NAME=NUMBER. Write as in --ior=glass=1.52.")
    return indices
