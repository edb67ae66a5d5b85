"""What the commands say of a scene's meshes before anything else."""

from collections.abc import Sequence

from refref_jax.data import lint, rule_advice
from refref_jax.data.containment import Containment
from refref_jax.data.findings import refuse_errors
from refref_jax.data.meshes import MeshPart


def report_meshes(parts: Sequence[MeshPart], tree: Containment, *, rule: str) -> None:
    """Prints which rule the meshes need, and what a lint finds in them.

    Raises:
      SceneError: if some of it must be mended first.
    """
    findings = lint.lint(parts, tree)
    if rule == "priority":
        findings += rule_advice.examine_priorities(parts, tree)
    if parts:
        print(rule_advice.advise(parts, tree))
    else:
        print("note: there are no meshes, so all light goes straight.")
    for finding in findings:
        if finding.severity != "error":
            print(finding)
    refuse_errors(findings)
