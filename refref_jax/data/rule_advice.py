"""Says which interface rule the parts of a scene ask for (NumPy only).

The rules are those of `optics.interface_rules`.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from refref_jax.choices import RuleName
from refref_jax.data import lint
from refref_jax.data.containment import Containment
from refref_jax.data.findings import Finding, refuse_errors
from refref_jax.data.meshes import MeshPart
from refref_jax.optics.interface_rules import NO_PARENT

# Parts that an explanation names before it only counts.
_NAMED = 3


class Advice(NamedTuple):
    """Which rule is right for a scene.

    Attributes:
      rule: the interface rule.
      reason: why, and what to heed.
    """

    rule: RuleName
    reason: str

    def __str__(self) -> str:
        return f"advice: rule {self.rule}: {self.reason}"


def advise(parts: Sequence[MeshPart], containment: Containment) -> Advice:
    """Returns the rule that is physical for parts that lie as they do."""
    nested = [
        f"{parts[inner].name} in {parts[outer].name}"
        for inner, outer in enumerate(containment.parents)
        if outer != NO_PARENT
    ]
    overlaps = [f"{parts[a].name} and {parts[b].name}" for a, b in containment.overlaps]
    if overlaps:
        return Advice(
            "priority",
            f"{_listed(overlaps)} overlap or touch. Give the parts a 'priority' in scene.json: the "
            "highest wins, so a container is above the liquid that overlaps its wall, and a body "
            "above the one that it is inside of.",
        )
    if nested:
        return Advice(
            "nested",
            f"parts lie strictly inside one another ({_listed(nested)}). Use 'facing' for images "
            "of a renderer that takes every index relative to air alone.",
        )
    lone = "there is one part" if len(parts) == 1 else f"all {len(parts)} parts lie apart"
    return Advice("nested", f"{lone}, so 'nested', 'facing' and 'priority' are the same.")


def check_meshes(parts: Sequence[MeshPart], tree: Containment, *, rule: str) -> tuple[str, ...]:
    """Returns which rule the meshes need, and what a lint finds in them.

    Raises:
      SceneError: if some of it must be mended first.
    """
    findings = lint.lint(parts, tree)
    if rule == "priority":
        findings += examine_priorities(parts, tree)
    advice = "note: there are no meshes, so all light goes straight."
    if parts:
        advice = advise(parts, tree)
    refuse_errors(findings)
    return str(advice), *map(str, findings)


def examine_priorities(parts: Sequence[MeshPart], containment: Containment) -> list[Finding]:
    """Reports priorities that make a part vanish, or leave an overlap to chance.

    For scenes that are to be traced under the rule `priority`.
    """
    findings = []
    for inner in range(len(parts)):
        for outer in _around(containment.parents, inner):
            if parts[inner].priority <= parts[outer].priority:
                findings.append(_hidden(parts[inner], parts[outer]))
    for one, other in containment.overlaps:
        if parts[one].priority == parts[other].priority:
            findings.append(_tie(parts[one], parts[other]))
    return findings


def _around(parents: Sequence[int], part: int) -> Iterator[int]:
    """Yields all parts that contain one, from the inside outwards."""
    while (part := parents[part]) != NO_PARENT:
        yield part


def _hidden(inner: MeshPart, outer: MeshPart) -> Finding:
    return Finding(
        "warning",
        inner.name,
        f"lies inside {outer.name} without a higher priority ({inner.priority} and "
        f"{outer.priority}), so under the rule 'priority' it may not be seen. Give it the higher "
        "number, or use the rule 'nested'.",
    )


def _tie(first: MeshPart, second: MeshPart) -> Finding:
    return Finding(
        "warning",
        first.name,
        f"has the same priority as {second.name} ({first.priority}), which it overlaps: it wins "
        "because its name comes first. Give the two different numbers in scene.json.",
    )


def _listed(things: Sequence[str]) -> str:
    more = len(things) - _NAMED
    return "; ".join(things[:_NAMED]) + (f"; and {more} more" if more > 0 else "")
