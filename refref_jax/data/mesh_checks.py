"""Checks the meshes of a scene, and advises an interface rule for them (NumPy only).

Each part is checked by itself: it should be closed and oriented outwards, without degenerate or
duplicate faces. Pairs of parts are checked for their position relative to each other. A liquid in a
glass shares one surface with it. If this is modelled as two surfaces, they coincide (light meets
them in either order), leave a gap (light is totally reflected at a layer of air that does not
exist) or overlap (correct under the rule `priority`, and, as in Cycles, under `facing`).

The advised rule is one of `optics.interface_rules`.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from refref_jax.choices import RuleName
from refref_jax.data import SceneError
from refref_jax.data.mesh_queries import (
    Containment,
    SampledSurface,
    SurfaceGaps,
    beside_faces,
    diagonal,
    parts_around,
    sample_surface,
    spread_points,
    surface_gaps,
    winding_number,
)
from refref_jax.data.meshes import MeshPart
from refref_jax.geometry.cameras import Cameras
from refref_jax.geometry.triangle_meshes import is_degenerate, pieces
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.media import EMPTY_SLOT, INDEX_OF_AIR

# As shares of the smaller part's diagonal: surfaces closer than the first coincide, because the
# tracer may not distinguish them; surfaces farther apart than the second are separate on purpose.
_COINCIDENT = 1e-4
_THIN = 0.02

# Smallest shares of a surface that are reported. Two round objects are also close at a point.
_COINCIDENT_SHARE = 0.01
_THIN_SHARE = 0.1

# Minimum cosine between the normals of parallel surfaces, and between a normal and the direction
# to the other surface.
_PARALLEL = 0.7

_REMEDY = (
    "let them overlap a little and use the rule 'priority', or model the surface between them as "
    "one interface."
)

# Winding number: -1 in front of an inverted closed piece, -1/2 in front of a single open sheet.
_WOUND_BACKWARDS = -0.75

# Numbers of sampled faces that decide whether a piece points inwards: least and largest, both odd;
# and the number for all pieces of a part, unless there are too many of them.
_LEAST_PLACES, _PLACES, _OF_A_PART = 3, 31, 1000

# Number of parts that a message names; it counts the others.
_NAMED = 3


class Finding(NamedTuple):
    """Result of a check of a mesh, for the user.

    Attributes:
      severity: an `error` makes light paths wrong; a `warning` may; a `note` does not.
      part: name of the part.
      message: description and remedy.
    """

    severity: Literal["error", "warning", "note"]
    part: str
    message: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.part}: {self.message}"


def refuse_errors(findings: Sequence[Finding]) -> None:
    """Refuses meshes whose light paths would be wrong.

    Raises:
      SceneError: if there is an error among the findings; the message lists all errors.
    """
    errors = [finding for finding in findings if finding.severity == "error"]
    if errors:
        text = "\n".join(f"  {finding.part}: {finding.message}" for finding in errors)
        raise SceneError(f"The meshes have errors. Fix them first:\n{text}")


class _Patch(NamedTuple):
    """Area over which two surfaces are parallel and close.

    Attributes:
      part: number of the part that has the larger share of its area there.
      share: share of its area.
      distance: median distance of the surfaces, in world units.
    """

    part: int
    share: float
    distance: float


def _lint_pairs(
    parts: Sequence[MeshPart], containment: Containment, rule: RuleName
) -> list[Finding]:
    """Reports parts that lie inside, intersect, coincide with or nearly touch others."""
    if rule != "nested":
        containment = containment._replace(overlaps=())  # which are correct under this rule
    findings = [
        Finding("note", parts[inner].name, f"lies inside {parts[outer].name}.")
        for inner, outer in enumerate(containment.parents)
        if outer != NO_PARENT
    ]
    surfaces = [sample_surface(part) for part in parts]
    for one, other in itertools.combinations(range(len(parts)), 2):
        findings += _lint_pair(parts, containment, surfaces, (one, other))
    return findings


def _lint_pair(
    parts: Sequence[MeshPart],
    containment: Containment,
    surfaces: Sequence[SampledSurface],
    pair: tuple[int, int],
) -> list[Finding]:
    size = diagonal([parts[part] for part in pair])
    sides = []
    if _box_distance(parts, pair) <= _THIN * size:
        sides = [
            (a, b, surface_gaps(surfaces[a], surfaces[b]))
            for a, b in (pair, pair[::-1])
            if len(surfaces[a].points) and len(surfaces[b].points)
        ]
    coincident = [_patch(a, gaps, _coincide(gaps, size)) for a, b, gaps in sides]
    bodies = all(parts[part].material.kind == "dielectric" for part in pair)
    layers = [
        _patch(a, gaps, _thin_layer(parts, containment.parents, (a, b), gaps, size))
        for a, b, gaps in sides
        if bodies
    ]
    findings = []
    if found := _largest(coincident, _COINCIDENT_SHARE):
        findings.append(_coincidence(parts, pair, found, size))
    elif pair in containment.overlaps:
        findings.append(_cut(parts, pair))
    if found := _largest(layers, _THIN_SHARE):
        findings.append(_gap(parts, pair, found))
    return findings


def _coincide(gaps: SurfaceGaps, size: float) -> Bool[np.ndarray, " samples"]:
    return (gaps.distances <= _COINCIDENT * size) & (np.abs(gaps.alignment) > _PARALLEL)


def _thin_layer(
    parts: Sequence[MeshPart],
    parents: Sequence[int],
    pair: tuple[int, int],
    gaps: SurfaceGaps,
    size: float,
) -> Bool[np.ndarray, " samples"]:
    """Returns where a thin layer lies in front of a part, with a lower index than both sides.

    Some light is totally reflected there that would pass if the two sides touched each other. A
    layer of higher index is a real wall, as of glass around a liquid, and refracts light correctly.
    """
    part, other = pair
    thin = (gaps.distances > _COINCIDENT * size) & (gaps.distances <= _THIN * size)
    ahead = thin & (gaps.ahead > _PARALLEL)
    near = parts[part].index
    # Between two objects that face each other is the medium around both; between an object and its
    # container is the medium of the container, whose surroundings are on the other side.
    apart = np.zeros_like(ahead)
    if parents[part] == parents[other] and _index(parts, parents[part]) < min(
        near, parts[other].index
    ):
        apart = ahead & (gaps.alignment < -_PARALLEL)
    beyond = _index(parts, parents[other])
    if parents[part] == other and parts[other].index < min(near, beyond):
        return apart | (ahead & (gaps.alignment > _PARALLEL))
    return apart


def _index(parts: Sequence[MeshPart], part: int) -> float:
    return INDEX_OF_AIR if part == NO_PARENT else parts[part].index


def _box_distance(parts: Sequence[MeshPart], pair: tuple[int, int]) -> float:
    """Returns the distance of the bounding boxes of two parts."""
    lows = [parts[part].vertices.min(axis=0) for part in pair]
    highs = [parts[part].vertices.max(axis=0) for part in pair]
    return float(np.linalg.norm(np.maximum(np.max(lows, axis=0) - np.min(highs, axis=0), 0.0)))


def _patch(part: int, gaps: SurfaceGaps, there: Bool[np.ndarray, " samples"]) -> _Patch:
    # Samples represent equal areas.
    distance = float(np.median(gaps.distances[there])) if there.any() else 0.0
    return _Patch(part, float(np.mean(there)), distance)


def _largest(patches: Sequence[_Patch], share: float) -> _Patch | None:
    """Returns the patch of the largest share, or `None` if it is below `share`."""
    found = max(patches, key=lambda patch: patch.share, default=None)
    return found if found is not None and found.share >= share else None


def _coincidence(
    parts: Sequence[MeshPart], pair: tuple[int, int], patch: _Patch, size: float
) -> Finding:
    [other] = set(pair) - {patch.part}
    return Finding(
        "warning",
        parts[patch.part].name,
        f"coincides with {parts[other].name} over {patch.share:.0%} of its surface, to within "
        f"{_COINCIDENT * size:.1g}: light would meet the two surfaces in either order. If they "
        f"belong together, {_REMEDY}",
    )


def _cut(parts: Sequence[MeshPart], pair: tuple[int, int]) -> Finding:
    return Finding(
        "warning",
        parts[pair[0]].name,
        f"intersects or touches {parts[pair[1]].name}. The rule 'nested' requires objects that are "
        "apart or strictly inside one another: use the rule 'priority', or 'facing' for images of "
        "a renderer that takes every index relative to air, or model the surface between them as "
        "one interface.",
    )


def _gap(parts: Sequence[MeshPart], pair: tuple[int, int], patch: _Patch) -> Finding:
    [other] = set(pair) - {patch.part}
    return Finding(
        "warning",
        parts[patch.part].name,
        f"is separated from {parts[other].name} by a gap of {patch.distance:.2g} over "
        f"{patch.share:.0%} of its surface, where light is totally reflected. If they should "
        f"touch, {_REMEDY}",
    )


def lint(
    parts: Sequence[MeshPart], containment: Containment, *, rule: RuleName = "nested"
) -> list[Finding]:
    """Checks all parts (closed, oriented outwards, clean faces), and all pairs under a rule."""
    findings = []
    for part in parts:
        findings += _faces(part)
        if part.material.kind == "dielectric":  # other parts may be open, and have no inside
            findings += _edges(part)
            findings += _objects(part)
    findings += _lint_pairs(parts, containment, rule)
    return findings + (_priorities(parts, containment) if rule == "priority" else [])


def _objects(part: MeshPart) -> list[Finding]:
    """Reports pieces most of whose area points inwards, except cavities, where that is correct."""
    connected = _pieces(part)
    if not connected:
        return []
    count = int(np.clip(_OF_A_PART // len(connected), _LEAST_PLACES, _PLACES)) | 1
    some = [faces[spread_points(part.vertices[part.faces[faces]], count)[0]] for faces in connected]
    beside = beside_faces(part, np.concatenate(some), 1.0)
    # The winding number is negative in front of an inverted piece, and 0 in a cavity. In front of a
    # fold, where a closed surface reaches through itself, it may be anything.
    winding = winding_number(part, beside).reshape(len(connected), count)
    inverted = int(np.sum(np.median(winding, axis=1) < _WOUND_BACKWARDS))
    if not inverted:
        return []
    return [
        Finding(
            "error",
            part.name,
            f"the faces of {inverted} of its {len(connected)} pieces point inwards, so inside and "
            "outside are swapped. Flip those faces and export it again.",
        )
    ]


def _pieces(part: MeshPart) -> list[Int[np.ndarray, " faces"]]:
    """Returns the faces of each connected piece."""
    numbers = pieces(part.faces, len(part.vertices))[part.faces[:, 0]]
    order = np.argsort(numbers, kind="stable")
    found = np.split(order, np.flatnonzero(np.diff(numbers[order])) + 1)
    return [faces for faces in found if len(faces)]


def _edges(part: MeshPart) -> list[Finding]:
    """Reports edges that a closed, consistently oriented surface does not have."""
    directed = part.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    directed = directed[directed[:, 0] != directed[:, 1]]
    _, inverse, uses = np.unique(
        np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    findings = []
    if open_edges := int(np.sum(uses % 2)):
        findings.append(
            Finding(
                "warning",
                part.name,
                f"is not watertight: {open_edges} edges are open. Light that passes through them "
                "has the wrong medium; close the holes.",
            )
        )
    forward = np.where(directed[:, 0] < directed[:, 1], 1, -1)
    balance = np.bincount(inverse.reshape(-1), forward)
    if unbalanced := int(np.sum((balance != 0) & (uses % 2 == 0))):
        findings.append(
            Finding(
                "error",
                part.name,
                f"is not oriented consistently: faces disagree across {unbalanced} edges. "
                "Recalculate its normals to the outside.",
            )
        )
    return findings


def _faces(part: MeshPart) -> list[Finding]:
    """Reports degenerate and duplicate faces."""
    findings = []
    if degenerate := int(np.sum(is_degenerate(part.vertices[part.faces]))):
        findings.append(
            Finding("note", part.name, f"has {degenerate} degenerate faces, which are ignored.")
        )
    duplicates = len(part.faces) - len(np.unique(np.sort(part.faces, axis=1), axis=0))
    if duplicates:
        findings.append(
            Finding(
                "error",
                part.name,
                f"has {duplicates} duplicate faces: light would cross the surface twice at one "
                "point. Remove them.",
            )
        )
    return findings


class Advice(NamedTuple):
    """The interface rule that is correct for a scene.

    Attributes:
      rule: name of the interface rule.
      reason: reason for it, and restrictions.
    """

    rule: RuleName
    reason: str

    def __str__(self) -> str:
        return f"advice: rule {self.rule}: {self.reason}"


def advise(parts: Sequence[MeshPart], containment: Containment) -> Advice:
    """Returns the rule that is physically correct for parts in their positions."""
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
            "highest wins, so a container is above the liquid that overlaps its wall, and an inner "
            "object above an outer one.",
        )
    if nested:
        return Advice(
            "nested",
            f"parts lie strictly inside one another ({_listed(nested)}). Use 'facing' for images "
            "of a renderer that takes every index relative to air.",
        )
    lone = "there is one part" if len(parts) == 1 else f"all {len(parts)} parts are apart"
    return Advice("nested", f"{lone}, so 'nested', 'facing' and 'priority' are equivalent.")


def refuse_cameras_inside(parts: Sequence[MeshPart], cameras: Cameras) -> None:
    """Refuses cameras inside a mesh, whose rays would start with an interior list.

    Raises:
      ValueError: if there is one.
    """
    if np.any(parts_around(parts, cameras.poses[:, :, 3]) != EMPTY_SLOT):
        raise ValueError(
            "A camera is inside a mesh, which training only supports under rule=nested, and under "
            "rule=facing without overlaps, if all parts are dielectrics. Move the camera."
        )


def check_meshes(
    parts: Sequence[MeshPart], tree: Containment, *, rule: RuleName
) -> tuple[str, ...]:
    """Returns the advised rule for the meshes, and the findings of all checks, as text.

    Raises:
      SceneError: if there is an error among the findings.
    """
    findings = lint(parts, tree, rule=rule)
    advice = "note: there are no meshes that bend light."
    if parts:
        advice = str(advise(parts, tree))
    refuse_errors(findings)
    return advice, *map(str, findings)


def _priorities(parts: Sequence[MeshPart], containment: Containment) -> list[Finding]:
    """Reports priorities that hide a part, or leave an overlap undecided."""
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
    """Yields all parts that contain a part, from the inside outwards."""
    while (part := parents[part]) != NO_PARENT:
        yield part


def _hidden(inner: MeshPart, outer: MeshPart) -> Finding:
    return Finding(
        "warning",
        inner.name,
        f"lies inside {outer.name} without a higher priority ({inner.priority} and "
        f"{outer.priority}), so it may be invisible under the rule 'priority'. Give it the higher "
        "number, or use the rule 'nested'.",
    )


def _tie(first: MeshPart, second: MeshPart) -> Finding:
    return Finding(
        "warning",
        first.name,
        f"has the same priority as {second.name} ({first.priority}), which it overlaps: it wins "
        "because its name comes first. Give them different priorities in scene.json.",
    )


def _listed(things: Sequence[str]) -> str:
    more = len(things) - _NAMED
    return "; ".join(things[:_NAMED]) + (f"; and {more} more" if more > 0 else "")
