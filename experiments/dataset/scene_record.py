"""The record of a scene in `scene.json` (NumPy only).

For each part it contains the media inside and outside, as they were passed to Blender. Under the
rule `nested`, outside is the innermost part around it, or air if there is none; under `facing`,
outside is always air.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.dataset.cameras import CAMERA_RADIUS
from experiments.dataset.parts import ObjectPart
from experiments.dataset.render_settings import RenderSettings
from refref_jax.choices import NO_ABSORPTION, TwoSidedRule
from refref_jax.data.mesh_queries import find_containment
from refref_jax.data.meshes import INDEX_OF_REFRACTION, MeshPart
from refref_jax.data.scene_names import SceneName
from refref_jax.data.scene_properties import VERSION
from refref_jax.geometry.triangle_meshes import is_watertight
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
      ValueError: if parts intersect, or an absorbing one contains another.
    """
    outside = _materials_outside(scene, parts, settings.rule)
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


def _describe_part(scene: SceneName, part: ObjectPart, outside: str) -> dict[str, Any]:
    description = {
        "mesh": f"meshes/{mesh_name(scene, part)}",
        "inside": part.material,
        "outside": outside,
        "ior_inside": INDEX_OF_REFRACTION[part.material],
        "ior_outside": INDEX_OF_REFRACTION[outside],
        "smooth_normals": part.smooth,
        "colour_per_interface": list(part.tint),
        "watertight": is_watertight(part.faces.astype(np.int64)),
        "faces": len(part.faces),
    }
    if part.absorption != NO_ABSORPTION:
        description["absorption"] = list(part.absorption)
    return description


def _materials_outside(
    scene: SceneName, parts: Sequence[ObjectPart], rule: TwoSidedRule
) -> list[str]:
    tree = find_containment([mesh_part(part) for part in parts])
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
    for parent in tree.parents:
        if parent != NO_PARENT and parts[parent].absorption != NO_ABSORPTION:
            raise ValueError(
                f"The part {parts[parent].name} of {scene.object} absorbs light, but contains "
                "another part, in which Blender keeps absorbing. Give its surface a tint instead."
            )
    if rule == "facing":
        return [_AIR] * len(parts)
    return [_AIR if parent == NO_PARENT else parts[parent].material for parent in tree.parents]


def mesh_part(part: ObjectPart) -> MeshPart:
    """Returns a part as the library reads it again, without its colour."""
    index = INDEX_OF_REFRACTION[part.material]
    return MeshPart(
        part.name, part.vertices, part.faces, index, "smooth" if part.smooth else "flat"
    )
