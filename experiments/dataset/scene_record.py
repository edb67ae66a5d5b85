"""The record of a scene in `scene.json` (NumPy only).

For each part it contains the media inside and outside, as they were passed to Blender. Under the
rule `nested`, outside is the innermost part around it, or air if there is none; under `facing`,
outside is always air. An opaque part has no medium inside.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.dataset.cameras import CAMERA_RADIUS
from experiments.dataset.parts import ObjectPart
from experiments.dataset.render_settings import RenderSettings
from refref_jax.choices import NO_ABSORPTION, Colour, TwoSidedRule
from refref_jax.data.mesh_queries import Containment, find_containment, winding_number
from refref_jax.data.meshes import INDEX_OF_REFRACTION, MeshPart
from refref_jax.data.scene_names import SceneName
from refref_jax.data.scene_properties import VERSION
from refref_jax.geometry.triangle_meshes import is_watertight, volume
from refref_jax.optics.interface_rules import NO_PARENT

_AIR = "air"


def describe(
    scene: SceneName,
    parts: Sequence[ObjectPart],
    background: dict[str, Any],
    settings: RenderSettings,
) -> dict[str, Any]:
    """Returns the content of `scene.json`.

    Args:
      scene: scene to describe.
      parts: parts of its object.
      background: record of its background, as `refref_jax.data.scene_properties` reads it.
      settings: settings of the rendering.

    Raises:
      ValueError: if parts intersect, if an absorbing one contains a dielectric, or if one is inside
        an opaque part.
    """
    outside = _parts_outside(scene, parts, settings.rule)
    return {
        "version": VERSION,
        **identify(scene, settings),
        "parts": [
            _describe_part(scene, part, around) for part, around in zip(parts, outside, strict=True)
        ],
        "ior": INDEX_OF_REFRACTION,
        "camera_radius": CAMERA_RADIUS,
        "background": background,
    }


def identify(scene: SceneName, settings: RenderSettings) -> dict[str, Any]:
    """Returns the part of `scene.json` that is known in advance."""
    return {"scene": str(scene), "category": scene.category, **settings.record()}


def mesh_name(scene: SceneName, part: ObjectPart) -> str:
    """Returns the file name of a part's mesh."""
    return f"{scene.object}_{part.name}_{part.material}.ply"


def mesh_part(part: ObjectPart) -> MeshPart:
    """Returns a part as the library reads it again, without its colour.

    A part without an index of refraction has that of air, and one with an index per channel the
    middle one.
    """
    index = _index_of(part)
    if isinstance(index, tuple):
        index = index[1]
    return MeshPart(
        part.name, part.vertices, part.faces, index or 1.0, "smooth" if part.smooth else "flat"
    )


def _describe_part(
    scene: SceneName, part: ObjectPart, outside: ObjectPart | None
) -> dict[str, Any]:
    index = _index_of(part)
    description: dict[str, Any] = {
        "mesh": f"meshes/{mesh_name(scene, part)}",
        "inside": part.material,
        "outside": _AIR if outside is None else outside.material,
        "ior_outside": _as_json(1.0 if outside is None else _index_of(outside)),
        "smooth_normals": part.smooth,
        "watertight": is_watertight(part.faces.astype(np.int64)),
        "faces": len(part.faces),
    }
    if part.kind != "dielectric":
        description["kind"] = part.kind
    if index is not None:
        # An index per colour channel has no earlier name.
        description["index" if isinstance(index, tuple) else "ior_inside"] = _as_json(index)
        description["colour_per_interface"] = list(part.tint)
    if part.absorption != NO_ABSORPTION:
        description["absorption"] = list(part.absorption)
    if part.roughness:
        description["roughness"] = part.roughness
    if part.colours is not None:
        description["radiance"] = "vertex_colours"
    for key in ("radiance", "albedo", "eta", "k"):
        if (value := getattr(part, key)) is not None:
            description[key] = _as_json(value)
    return description


def _index_of(part: ObjectPart) -> float | Colour | None:
    """Returns the index of refraction of a part, or `None` if its kind has none."""
    if part.kind in ("opaque", "conductor"):
        return None
    return INDEX_OF_REFRACTION[part.material] if part.index is None else part.index


def _as_json(value: float | Colour | None) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _parts_outside(
    scene: SceneName, parts: Sequence[ObjectPart], rule: TwoSidedRule
) -> list[ObjectPart | None]:
    """Returns the part around each part, or `None` for air."""
    tree = _nest(parts)
    absorbing = {i for i, part in enumerate(parts) if part.absorption != NO_ABSORPTION}
    if rule == "facing" and not absorbing & set(itertools.chain(*tree.overlaps)):
        tree = tree._replace(
            overlaps=()
        )  # every face has its part on one side and air on the other
    if tree.overlaps:
        first, second = (parts[number].name for number in tree.overlaps[0])
        raise ValueError(
            f"The parts {first} and {second} of {scene.object} intersect. Separate them by a gap."
        )
    for inner, parent in enumerate(tree.parents):
        if parent == NO_PARENT:
            continue
        around = parts[parent]
        if _index_of(around) is None:
            raise ValueError(
                f"The part {parts[inner].name} of {scene.object} is inside {around.name}, which "
                "no light enters. Remove it, or make the outer part a dielectric."
            )
        if around.absorption != NO_ABSORPTION and parts[inner].kind == "dielectric":
            raise ValueError(
                f"The part {around.name} of {scene.object} absorbs light, but contains another "
                "part, in which Blender keeps absorbing. Give its surface a tint instead."
            )
    if rule == "facing":
        return [None] * len(parts)
    return [None if parent == NO_PARENT else parts[parent] for parent in tree.parents]


def _nest(parts: Sequence[ObjectPart]) -> Containment:
    """Returns the nesting of parts; a thin sheet is open, so that nothing is inside it."""
    closed = [number for number, part in enumerate(parts) if part.kind != "thin_sheet"]
    bodies = {number: mesh_part(parts[number]) for number in closed}
    tree = find_containment(list(bodies.values()))
    parents = [NO_PARENT] * len(parts)
    for number, parent in zip(closed, tree.parents, strict=True):
        parents[number] = NO_PARENT if parent == NO_PARENT else closed[parent]
    overlaps = [(closed[one], closed[other]) for one, other in tree.overlaps]
    for number, part in enumerate(parts):
        around = []
        places = np.concatenate([part.vertices, part.vertices[part.faces].mean(axis=1)])
        for other in closed if part.kind == "thin_sheet" else ():
            inside = np.abs(winding_number(bodies[other], places)) > 0.5
            if inside.all():
                around.append(other)
            elif inside.any():
                overlaps.append((min(number, other), max(number, other)))
        if around:
            volumes = {n: abs(volume(bodies[n].vertices, bodies[n].faces)) for n in around}
            parents[number] = min(around, key=volumes.__getitem__)
    return Containment(tuple(parents), tuple(sorted(overlaps)))
