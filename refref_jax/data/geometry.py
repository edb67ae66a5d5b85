"""Assembles the meshes of a scene into what light paths are traced through (NumPy only)."""

import warnings
from collections.abc import Sequence

import numpy as np

from refref_jax.choices import CLEAR, NO_ABSORPTION, Colour, RuleName
from refref_jax.data import lint, rule_advice
from refref_jax.data.containment import find_containment
from refref_jax.data.findings import refuse_errors
from refref_jax.data.meshes import MeshPart
from refref_jax.data.part_descriptions import Shading
from refref_jax.data.parts import MeshSource, make_part
from refref_jax.geometry.corner_normals import CREASE_ANGLE
from refref_jax.geometry.surface_build import pack_meshes
from refref_jax.geometry.triangle_meshes import Mesh, make_mesh
from refref_jax.optics.interface_rules import RULES
from refref_jax.optics.scene import Scene

_CREASE_ANGLES: dict[Shading, float] = {"auto": CREASE_ANGLE, "smooth": np.pi, "flat": 0.0}


def single_body(
    mesh: MeshSource,
    *,
    index: float,
    shading: Shading = "auto",
    tint: Colour = CLEAR,
    absorption: Colour = NO_ABSORPTION,
) -> Scene:
    """Returns a scene of one body in air; arguments as of `parts.make_part`.

    Its arrays are NumPy's, which every function of light takes; `jax.device_put` moves them to an
    accelerator once and for all.

    Raises:
      SceneError: as `make_part` and `assemble`.

    Example:
      >>> import trimesh
      >>> import refref_jax
      >>> glass = refref_jax.single_body(trimesh.creation.box(), index=1.5)
      >>> glass.interfaces.index_inside.tolist()
      [1.5]
    """
    part = make_part(mesh, index=index, shading=shading, tint=tint, absorption=absorption)
    return assemble([part])


def assemble(parts: Sequence[MeshPart], *, rule: RuleName = "nested") -> Scene:
    """Examines parts and builds the scene that they make; no part is an empty scene.

    Args:
      parts: of `make_part` or `meshes.read_meshes`.
      rule: what lies outside a part: what it lies in (`nested`), always air (`facing`), or, where
        parts overlap, the one of the highest priority (`priority`); see `optics.interface_rules`.

    Returns:
      NumPy arrays, as of `single_body`. Parts have the numbers of their places in `parts`.

    Raises:
      SceneError: if light paths would be wrong, as where faces point inwards. What may make them
        wrong, such as a hole, is a Python warning.

    Example:
      >>> import trimesh
      >>> import refref_jax
      >>> cup = refref_jax.make_part(trimesh.creation.box([2.0, 2.0, 2.0]), index=1.5)
      >>> water = refref_jax.make_part(trimesh.creation.icosphere(radius=0.5), index=1.333)
      >>> refref_jax.assemble([cup, water]).interfaces.index_outside.tolist()  # air, and the cup
      [1.0, 1.5]
    """
    tree = find_containment(parts)
    if rule == "priority":
        # Bodies that overlap are what this rule is for.
        findings = lint.lint(parts, tree._replace(overlaps=()))
        findings += rule_advice.examine_priorities(parts, tree)
    else:
        findings = lint.lint(parts, tree)
    refuse_errors(findings)
    for finding in findings:
        if finding.severity == "warning":
            warnings.warn(f"{finding.part} {finding.message}", stacklevel=2)
    return build_geometry(parts, tree.parents, rule=rule)


def build_geometry(
    parts: Sequence[MeshPart],
    parents: Sequence[int],
    *,
    rule: RuleName,
) -> Scene:
    """Builds surfaces and interfaces of all parts.

    Args:
      parts: the meshes; none is an empty scene.
      parents: the innermost part around each part, from `containment.find_containment`.
      rule: what lies outside a part, see `optics.interface_rules`.
    """
    surfaces = pack_meshes([shaded_mesh(part) for part in parts])
    interfaces = RULES[rule](
        [part.index for part in parts],
        parents,
        tints=[part.tint for part in parts],
        absorptions=[part.absorption for part in parts],
        priorities=[part.priority for part in parts],
    )
    return Scene(surfaces, interfaces)


def shaded_mesh(part: MeshPart) -> Mesh:
    """Returns the surface of a part, with the normals that bend light."""
    if part.normals is not None:
        return Mesh(part.vertices, part.faces, part.normals)
    return make_mesh(part.vertices, part.faces, crease_angle=_CREASE_ANGLES[part.shading])
