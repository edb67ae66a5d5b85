"""What a scene requires of a model, so that it pays for nothing else (NumPy only).

Found on the host, from the meshes, what `scene.json` says of them, and the cameras. Choices that
are compiled follow from it. The background is opaque in every scene, so it is not listed.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from refref_jax.choices import CLEAR, NO_ABSORPTION, RuleName, Space, Tints
from refref_jax.data.mesh_queries import Containment, encloses, is_convex, winding_number
from refref_jax.data.meshes import MeshPart, PartDescription
from refref_jax.geometry.cameras import Cameras
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.path_settings import Reentry

NeededInterior = Literal["none", "clear", "absorbing"]
"""What is in the objects; `none` where there are none."""


class Needs(NamedTuple):
    """What a scene requires.

    Attributes:
      parts: number of meshes; without any, light goes straight.
      bodies: number of outermost parts, which no other part contains.
      convex: whether there is one body, it is convex and all other parts lie in it.
      reentry: `impossible` if a ray that has left the objects can not meet any again.
      interior: what takes light inside the objects: `none` if there are none, `clear` if their
        colours are known and take no light, else `absorbing`.
      tints: colours of interfaces and media: `none` to heed, `given` by `scene.json` for every
        part, or to be `learned` since it does not tell them.
      space: `unbounded` if the background is infinitely far away, `spherical` if it is a sphere.
    """

    parts: int
    bodies: int
    convex: bool
    reentry: Reentry
    interior: NeededInterior
    tints: Tints
    space: Space


def find_needs(
    parts: Sequence[MeshPart],
    tree: Containment,
    cameras: Cameras,
    *,
    rule: RuleName,
    space: Space,
) -> Needs:
    """Finds what a scene requires.

    What nested parts do to light inside one convex body does not matter to `reentry`: once out, a
    ray meets nothing. Where bodies may overlap (`priority`) nothing is promised of several parts,
    nor where a camera stands inside.

    Args:
      parts: the meshes.
      tree: how they lie in one another, from `mesh_queries.find_containment`.
      cameras: from which rays start.
      rule: what lies outside a part, see `optics.interface_rules`.
      space: of the background.
    """
    outermost = [parts[i] for i, parent in enumerate(tree.parents) if parent == NO_PARENT]
    convex = len(outermost) == 1 and _is_one_convex_body(outermost[0], parts)
    # Other rules may say of a ray between two parts that it is outside of all.
    told_apart = rule == "nested" or len(parts) == 1
    leaves_for_good = convex and told_apart and not _any_inside(cameras, outermost[0])
    return Needs(
        parts=len(parts),
        bodies=len(outermost),
        convex=convex,
        reentry="impossible" if leaves_for_good or not parts else "possible",
        interior=_interior(parts),
        tints=find_tints(parts),
        space=space,
    )


def describe(needs: Needs) -> str:
    """Says in one line what a scene requires."""
    background = f"{needs.space} background"
    if needs.parts == 0:
        return f"this scene has no meshes: no tracer, {background}"
    tints = {
        "none": "no tint",
        "given": "tints and absorption (given)",
        "learned": "tints and absorption (to be learned)",
    }
    reentry = "re-entry" if needs.reentry == "possible" else "no re-entry"
    return f"this scene needs: {_bodies(needs)}, {reentry}, {background}, {tints[needs.tints]}"


def _bodies(needs: Needs) -> str:
    before = ["clear"] if needs.interior == "clear" else []
    if needs.convex:
        before.append("convex")
    noun = "body" if needs.bodies == 1 else "bodies"
    text = " ".join([str(needs.bodies), *before, noun])
    if needs.parts > needs.bodies:
        text = f"{needs.parts} parts in {text}"
    return text if needs.convex or needs.bodies > 1 else f"{text} that is not convex"


def _is_one_convex_body(body: MeshPart, parts: Sequence[MeshPart]) -> bool:
    """Returns whether a part is convex and all others lie in it, to the last vertex."""
    return is_convex(body) and all(encloses(body, part) for part in parts if part is not body)


def _any_inside(cameras: Cameras, body: MeshPart) -> bool:
    winding = winding_number(body, np.asarray(cameras.poses[:, :, 3], np.float64))
    return bool(np.any(np.abs(winding) > 0.5))


def _takes_light(part: MeshPart | PartDescription) -> bool:
    return tuple(part.tint) != CLEAR or tuple(part.absorption) != NO_ABSORPTION


def _interior(parts: Sequence[MeshPart]) -> NeededInterior:
    if not parts:
        return "none"
    return "clear" if find_tints(parts) == "none" else "absorbing"


def find_tints(
    parts: Sequence[MeshPart | PartDescription],
) -> Tints:
    """Returns where the colours of parts, or of what is known of them, come from; see `Needs`."""
    if not all(part.colour_known for part in parts):
        return "learned"
    return "given" if any(map(_takes_light, parts)) else "none"
