"""Examines how the parts of a scene lie to each other (NumPy only).

A liquid in its glass has one surface in common with it. Modelled as two surfaces, they coincide
(light meets them in either order), leave a gap (light is reflected totally at a layer of air that
is not there) or overlap (right under the rule `priority` alone).
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from refref_jax.data.containment import Containment
from refref_jax.data.facing_walls import (
    SampledSurface,
    Walls,
    diagonal,
    sample_surface,
    walls_between,
)
from refref_jax.data.findings import Finding
from refref_jax.data.meshes import MeshPart
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.media import INDEX_OF_AIR

# As shares of the smaller part's diagonal: walls closer than the first coincide, for the tracer may
# not tell them apart; walls farther apart than the second are meant to be.
_COINCIDENT = 1e-4
_THIN = 0.02

# Smallest shares of a surface that are told. Two round bodies come close at a point, too.
_COINCIDENT_SHARE = 0.01
_THIN_SHARE = 0.1

# Least cosine between walls, and between a wall and the way to the next, that run side by side.
_PARALLEL = 0.7

_REMEDY = (
    "let them overlap a little and use the rule 'priority', or model the wall between them as one "
    "interface."
)


class _Patch(NamedTuple):
    """Where two surfaces run side by side.

    Attributes:
      part: the part that has more of its area there.
      share: how much of its area.
      distance: median distance of the surfaces, in world units.
    """

    part: int
    share: float
    distance: float


def lint_pairs(parts: Sequence[MeshPart], containment: Containment) -> list[Finding]:
    """Reports parts that lie inside, cut, coincide with or nearly touch others."""
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
            (a, b, walls_between(surfaces[a], surfaces[b]))
            for a, b in (pair, pair[::-1])
            if len(surfaces[a].points) and len(surfaces[b].points)
        ]
    coincident = [_patch(a, walls, _coincide(walls, size)) for a, b, walls in sides]
    layers = [
        _patch(a, walls, _thin_layer(parts, containment.parents, (a, b), walls, size))
        for a, b, walls in sides
    ]
    findings = []
    if found := _largest(coincident, _COINCIDENT_SHARE):
        findings.append(_coincidence(parts, pair, found, size))
    elif pair in containment.overlaps:
        findings.append(_cut(parts, pair))
    if found := _largest(layers, _THIN_SHARE):
        findings.append(_gap(parts, pair, found))
    return findings


def _coincide(walls: Walls, size: float) -> Bool[np.ndarray, " samples"]:
    return (walls.distances <= _COINCIDENT * size) & (np.abs(walls.alignment) > _PARALLEL)


def _thin_layer(
    parts: Sequence[MeshPart],
    parents: Sequence[int],
    pair: tuple[int, int],
    walls: Walls,
    size: float,
) -> Bool[np.ndarray, " samples"]:
    """Returns where a thin layer of lower index than both of its sides lies before a part.

    Light that would go on if the sides touched is reflected totally there. A layer of higher
    index is a wall, as of glass around a liquid, and bends light as it should.
    """
    part, other = pair
    thin = (walls.distances > _COINCIDENT * size) & (walls.distances <= _THIN * size)
    ahead = thin & (walls.ahead > _PARALLEL)
    near = parts[part].index
    # Between two bodies that face each other is what surrounds both; between a body and the one
    # around it is the latter's medium, with what surrounds that on the other side.
    apart = np.zeros_like(ahead)
    if parents[part] == parents[other] and _index(parts, parents[part]) < min(
        near, parts[other].index
    ):
        apart = ahead & (walls.alignment < -_PARALLEL)
    beyond = _index(parts, parents[other])
    if parents[part] == other and parts[other].index < min(near, beyond):
        return apart | (ahead & (walls.alignment > _PARALLEL))
    return apart


def _index(parts: Sequence[MeshPart], part: int) -> float:
    return INDEX_OF_AIR if part == NO_PARENT else parts[part].index


def _box_distance(parts: Sequence[MeshPart], pair: tuple[int, int]) -> float:
    """Returns how far the bounding boxes of two parts are from each other."""
    lows = [parts[part].vertices.min(axis=0) for part in pair]
    highs = [parts[part].vertices.max(axis=0) for part in pair]
    return float(np.linalg.norm(np.maximum(np.max(lows, axis=0) - np.min(highs, axis=0), 0.0)))


def _patch(part: int, walls: Walls, there: Bool[np.ndarray, " samples"]) -> _Patch:
    # Samples stand for equal areas.
    distance = float(np.median(walls.distances[there])) if there.any() else 0.0
    return _Patch(part, float(np.mean(there)), distance)


def _largest(patches: Sequence[_Patch], share: float) -> _Patch | None:
    """Returns the patch of the largest share, if it reaches the given one."""
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
        f"{_COINCIDENT * size:.1g}: light would meet the two walls in either order. If they "
        f"belong together, {_REMEDY}",
    )


def _cut(parts: Sequence[MeshPart], pair: tuple[int, int]) -> Finding:
    return Finding(
        "warning",
        parts[pair[0]].name,
        f"cuts or touches {parts[pair[1]].name}. The rules 'nested' and 'facing' ask for bodies "
        "that are apart or strictly inside one another: use the rule 'priority', or model the "
        "surface between them as one interface.",
    )


def _gap(parts: Sequence[MeshPart], pair: tuple[int, int], patch: _Patch) -> Finding:
    [other] = set(pair) - {patch.part}
    return Finding(
        "warning",
        parts[patch.part].name,
        f"is separated from {parts[other].name} by a gap of {patch.distance:.2g} over "
        f"{patch.share:.0%} of its surface, where light is reflected totally. If they should "
        f"touch, {_REMEDY}",
    )
