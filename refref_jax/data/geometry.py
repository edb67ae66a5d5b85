"""Assembles the meshes of a scene into what light paths are traced through (NumPy only)."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from refref_jax.data.meshes import MeshPart
from refref_jax.data.part_descriptions import Shading
from refref_jax.geometry.corner_normals import CREASE_ANGLE, corner_normals
from refref_jax.geometry.surface_build import build_surfaces
from refref_jax.optics.interface_rules import RULES
from refref_jax.optics.wavefront import Geometry

_CREASE_ANGLES: dict[Shading, float] = {"auto": CREASE_ANGLE, "smooth": np.pi, "flat": 0.0}


def build_geometry(
    parts: Sequence[MeshPart],
    parents: Sequence[int],
    *,
    rule: Literal["nested", "facing", "priority"],
) -> Geometry:
    """Builds surfaces and interfaces of all parts.

    Args:
      parts: the meshes; none is an empty scene.
      parents: the innermost part around each part, from `containment.find_containment`.
      rule: what lies outside a part, see `optics.interface_rules`.
    """
    triangles = [part.vertices[part.faces] for part in parts]
    normals = [shading_normals(part) for part in parts]
    owners = [np.full(len(part.faces), i) for i, part in enumerate(parts)]
    surfaces = build_surfaces(
        np.concatenate([np.zeros((0, 3, 3)), *triangles]),
        np.concatenate([np.zeros((0, 3, 3)), *normals]),
        np.concatenate([np.zeros(0, np.int64), *owners]),
    )
    interfaces = RULES[rule](
        [part.index for part in parts],
        parents,
        tints=[part.tint for part in parts],
        absorptions=[part.absorption for part in parts],
        priorities=[part.priority for part in parts],
    )
    return Geometry(surfaces, interfaces)


def shading_normals(part: MeshPart) -> Float[np.ndarray, "faces 3 3"]:
    """Returns the outward unit normals at the corners of a part's faces that bend light."""
    if part.normals is not None:
        return part.normals
    return corner_normals(part.vertices, part.faces, crease_angle=_CREASE_ANGLES[part.shading])
