"""What commands that read a scene's meshes share: their options, and the lint's report."""

from collections.abc import Sequence

from absl import flags

from refref_jax.data import lint, rule_advice
from refref_jax.data.containment import Containment
from refref_jax.data.meshes import MeshPart
from refref_jax.optics.interface_rules import RULES

RULE = flags.DEFINE_enum(
    "rule",
    "nested",
    list(RULES),
    "What lies outside each mesh: the part around it, always air (as Cycles does it), or, of "
    "meshes that overlap, the one with the highest 'priority' in scene.json.",
)
IOR = flags.DEFINE_multi_string(
    "ior", [], "Index of refraction of a material or a mesh, as glass=1.52. May be repeated."
)


def report_meshes(parts: Sequence[MeshPart], tree: Containment, *, rule: str) -> None:
    """Prints which rule the meshes need, and what a lint finds in them.

    Raises:
      ValueError: if some of it must be mended first.
    """
    findings = lint.lint(parts, tree)
    if rule == "priority":
        findings += rule_advice.examine_priorities(parts, tree)
    if parts:
        print(rule_advice.advise(parts, tree))
    else:
        print("note: there are no meshes, so all light goes straight.")
    errors = [finding for finding in findings if finding.severity == "error"]
    for finding in findings:
        if finding not in errors:
            print(finding)
    if errors:
        told = "\n".join(f"  {finding.part}: {finding.message}" for finding in errors)
        raise ValueError(f"the meshes must be mended first.\n{told}")


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
