"""Assembles what light paths meet: the meshes of a scene, and its background (NumPy only).

Parts are read from a scene folder (`meshes`), or made from mesh files, trimeshes or arrays by
`make_part`.

`read_background` reads the images of the background that `scene_properties` describes. An image is
a PNG of 8-bit sRGB, or an EXR of linear RGB; `render.backgrounds` defines how it is mapped onto the
background.
"""

import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from refref_jax.choices import CLEAR, NO_ABSORPTION, ORIGIN, Colour, Material, RuleName
from refref_jax.data import SceneError, image_files, mesh_checks, meshes, scene_properties
from refref_jax.data.mesh_checks import refuse_errors
from refref_jax.data.mesh_queries import find_containment
from refref_jax.data.meshes import MeshPart
from refref_jax.data.scene_properties import Face, SceneProperties, Shading
from refref_jax.geometry.surfaces import pack_meshes
from refref_jax.geometry.triangle_meshes import CREASE_ANGLE, Mesh, make_mesh
from refref_jax.numerics import host_array
from refref_jax.optics.interface_rules import RULES
from refref_jax.optics.media import INDEX_OF_AIR, Scene
from refref_jax.render.backgrounds import (
    Background,
    CubeBackground,
    Environment,
    LinearTexture,
    SphereBackground,
    SrgbTexture,
    Texture,
)

Arrays = tuple[np.ndarray, np.ndarray]
"""Vertices `[vertices, 3]` in world units; faces `[faces, 3]`, counter-clockwise from outside."""

MeshSource = str | os.PathLike[str] | trimesh.Trimesh | Arrays
"""Mesh of a part: a path, a trimesh, or arrays."""

_WALLS = 6

# Axes are stored with at least six digits.
_AXES_TOLERANCE = 1e-3

_DIELECTRIC = Material()

_CREASE_ANGLES: dict[Shading, float] = {"auto": CREASE_ANGLE, "smooth": np.pi, "flat": 0.0}


def make_part(
    mesh: MeshSource,
    *,
    index: float,
    name: str | None = None,
    shading: Shading = "auto",
    tint: Colour = CLEAR,
    absorption: Colour = NO_ABSORPTION,
    priority: int = 0,
    material: Material = _DIELECTRIC,
) -> MeshPart:
    """Makes one part of a scene from a mesh; `assemble` combines parts.

    Args:
      mesh: a file that trimesh reads (normals in a PLY file of `meshes.write_mesh` are used), a
        `trimesh.Trimesh`, or vertices and faces.
      index: index of refraction inside.
      name: name in messages; by default the file's stem, or `body`.
      shading: `smooth`, `flat`, or `auto` for smooth up to the crease angle.
      tint: factor of linear RGB light at every reflection and every crossing, 0 to 1.
      absorption: absorption of the medium inside, linear RGB, per world unit.
      priority: priority under the rule `priority`; the highest wins where parts overlap.
      material: kind of the part, roughness and dispersion; a smooth dielectric by default. The
        index has no effect on opaque parts and conductors.

    Raises:
      SceneError: if the mesh is broken or empty, or a number has no physical meaning.

    Example:
      >>> import trimesh
      >>> import refref_jax
      >>> ball = refref_jax.make_part(trimesh.creation.icosphere(), index=1.5, name="ball")
      >>> ball.name, ball.faces.shape
      ('ball', (1280, 3))
    """
    if isinstance(mesh, str | os.PathLike):
        part = meshes.read_part(Path(mesh), index=index, shading=shading)
        part = part._replace(name=name or part.name)
    else:
        part = _of_arrays(mesh, index, name or "body", shading)
    meshes.check_index(part.name, index)
    if not all(0.0 <= channel <= 1.0 for channel in tint):
        raise SceneError(
            f"The tint of {part.name!r} is {tint}. Give three numbers from 0 to 1, since no "
            "surface adds light."
        )
    if not all(0.0 <= channel < np.inf for channel in absorption):
        raise SceneError(
            f"The absorption of {part.name!r} is {absorption}. Give three numbers that are 0 or "
            "positive, per world unit."
        )
    coloured = tuple(tint) != CLEAR or tuple(absorption) != NO_ABSORPTION
    material = _checked_material(part.name, material)
    radiance = meshes.read_radiance(material, part.faces, path=mesh)
    return part._replace(
        tint=tint,
        absorption=absorption,
        priority=priority,
        colour_known=coloured,
        material=material,
        radiance=radiance,
    )


def _checked_material(name: str, material: Material) -> Material:
    """Returns a material as `scene.json` would describe it, or refuses it with the same message."""
    if not isinstance(material, Material):
        raise SceneError(f"The material of {name!r} is {material!r}. Give a refref_jax.Material.")
    pair = material.complex_index
    eta, k = pair if isinstance(pair, tuple | list) and len(pair) == 2 else (pair, None)
    values = {
        "index": material.dispersion,
        "eta": eta,
        "k": k,
        "radiance": material.radiance,
        "roughness": material.roughness or None,
        "interior": material.interior,
    }
    described = {
        key: value if isinstance(value, str) else np.asarray(value).tolist()
        for key, value in values.items()
        if value is not None
    }
    return scene_properties.read_part(name, {"kind": material.kind, **described}).material


def _of_arrays(
    mesh: trimesh.Trimesh | Arrays, index: float, name: str, shading: Shading
) -> MeshPart:
    vertices, faces = (mesh.vertices, mesh.faces) if isinstance(mesh, trimesh.Trimesh) else mesh
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,) or faces.dtype.kind not in "iu":
        raise SceneError(
            f"{name} has vertices of shape {vertices.shape} and faces of shape {faces.shape} and "
            f"type {faces.dtype}. Give positions [vertices, 3] and whole numbers [faces, 3]."
        )
    vertices, faces = meshes.merge_corners(name, vertices, faces.astype(np.int64))
    return MeshPart(name, vertices, faces, index, shading)


def single_object(
    mesh: MeshSource,
    *,
    index: float,
    shading: Shading = "auto",
    tint: Colour = CLEAR,
    absorption: Colour = NO_ABSORPTION,
) -> Scene:
    """Returns a scene of one object in air; the arguments are those of `make_part`.

    Its arrays are NumPy arrays, which all functions that trace light accept; `jax.device_put` moves
    them to an accelerator.

    Raises:
      SceneError: under the conditions of `make_part` and `assemble`.

    Example:
      >>> import trimesh
      >>> import refref_jax
      >>> glass = refref_jax.single_object(trimesh.creation.box(), index=1.5)
      >>> glass.interfaces.index_inside.tolist()
      [1.5]
    """
    part = make_part(mesh, index=index, shading=shading, tint=tint, absorption=absorption)
    return assemble([part])


def assemble(
    parts: Sequence[MeshPart], *, rule: RuleName = "nested", ambient: float = INDEX_OF_AIR
) -> Scene:
    """Checks parts and builds a scene from them; without parts it is empty.

    Args:
      parts: parts from `make_part` or `meshes.read_meshes`.
      rule: medium outside a part: that of the part around it (`nested`), always the ambient medium
        (`facing`), or that of the overlapping part with the highest priority (`priority`); see
        `optics.interface_rules`.
      ambient: index of refraction of the ambient medium, outside all parts.

    Returns:
      The scene, as NumPy arrays. Parts are numbered by their indices in `parts`.

    Raises:
      SceneError: if light paths would be wrong, for example where faces point inwards. Defects that
        may make them wrong, such as a hole, are Python warnings.

    Example:
      >>> import trimesh
      >>> import refref_jax
      >>> cup = refref_jax.make_part(trimesh.creation.box([2.0, 2.0, 2.0]), index=1.5)
      >>> water = refref_jax.make_part(trimesh.creation.icosphere(radius=0.5), index=1.333)
      >>> refref_jax.assemble([cup, water]).interfaces.index_outside.tolist()  # air, and the cup
      [1.0, 1.5]
    """
    tree = find_containment(parts)
    findings = mesh_checks.lint(parts, tree, rule=rule)
    refuse_errors(findings)
    for finding in findings:
        if finding.severity == "warning":
            warnings.warn(f"{finding.part} {finding.message}", stacklevel=2)
    meshes.check_index("ambient", ambient)
    return assemble_scene(parts, tree.parents, rule=rule, overlaps=tree.overlaps, ambient=ambient)


def assemble_scene(
    parts: Sequence[MeshPart],
    parents: Sequence[int],
    *,
    rule: RuleName,
    overlaps: Sequence[tuple[int, int]] = (),
    ambient: float = INDEX_OF_AIR,
) -> Scene:
    """Builds surfaces and interfaces of all parts.

    Args:
      parts: meshes of the scene, possibly none.
      parents: innermost part around each part, from `mesh_queries.find_containment`.
      rule: interface rule, see `optics.interface_rules`.
      overlaps: pairs of parts that overlap, from `mesh_queries.find_containment`.
      ambient: index of refraction of the ambient medium.
    """
    surfaces = pack_meshes([shaded_mesh(part) for part in parts], radiance=_radiance(parts))
    interfaces = RULES[rule](
        [part.index for part in parts],
        parents,
        tints=[part.tint for part in parts],
        absorptions=[part.absorption for part in parts],
        priorities=[part.priority for part in parts],
        overlaps=overlaps,
        ambient=ambient,
        materials=[part.material for part in parts],
    )
    return Scene(surfaces, interfaces)


def _radiance(parts: Sequence[MeshPart]) -> list[Float[np.ndarray, "_ 3 3"]]:
    """Returns the radiance of all parts, 0 where they are not opaque; nothing if one is unknown."""
    opaque = [part for part in parts if part.material.kind == "opaque"]
    if not opaque or any(part.radiance is None for part in opaque):
        return []
    return [
        np.zeros((len(part.faces), 3, 3)) if part.radiance is None else part.radiance
        for part in parts
    ]


def shaded_mesh(part: MeshPart) -> Mesh:
    """Returns the surface of a part, with its shading normals."""
    if part.normals is not None:
        return Mesh(part.vertices, part.faces, part.normals)
    return make_mesh(part.vertices, part.faces, crease_angle=_CREASE_ANGLES[part.shading])


def read_background(scene: Path, *, properties: SceneProperties | None = None) -> Background:
    """Reads the background that the properties of a scene describe, with its images.

    Args:
      scene: folder of the scene.
      properties: properties of the scene; by default those of its `scene.json`.

    Returns:
      The background, as NumPy arrays.

    Raises:
      SceneError: if the properties lack the background, or an image is missing or broken.
    """
    found = scene_properties.read(scene) if properties is None else properties
    path = found.origins.get("background", scene / scene_properties.FILE)
    if found.background.kind is None:
        raise SceneError(
            f"The background is unknown: {path} does not describe it with one of the types "
            f"{', '.join(_READERS)}. Describe it there, or use a scene with a background."
        )
    return _READERS[found.background.kind](found, path)


def _read_cube(found: SceneProperties, path: Path) -> CubeBackground:
    half, faces = np.float32(_extent(found, "half_extent", path)), found.background.faces
    if len(faces) != _WALLS:
        raise SceneError(f"The background in {path} does not have six faces. Describe all six.")
    axes = np.stack([_axes(face, path) for face in faces])
    towards = axes[:, 0] @ axes[:, 0].T
    if np.max(np.abs(np.sort(towards, axis=1) - [-1.0, 0.0, 0.0, 0.0, 0.0, 1.0])) > _AXES_TOLERANCE:
        raise SceneError(
            f"The normals of the faces in {path} do not form a cube. Give six, two along each of "
            "three perpendicular axes."
        )
    axes = axes.astype(np.float32)
    texture = _stack([_read_texture(face.image, path) for face in faces], path)
    normals, across, along = (host_array(axes[:, i]) for i in range(3))
    return CubeBackground(texture, normals, across, along, host_array(half), _centre(found))


def _read_sphere(found: SceneProperties, path: Path) -> SphereBackground:
    radius = np.float32(_extent(found, "radius", path))
    texture = _read_texture(found.background.image, path)
    return SphereBackground(texture, host_array(radius), _centre(found))


def _read_environment(found: SceneProperties, path: Path) -> Environment:
    return Environment(_read_texture(found.background.image, path))


_READERS: dict[str, Callable[[SceneProperties, Path], Background]] = {
    "cube": _read_cube,
    "sphere": _read_sphere,
    "env": _read_environment,
}


def _extent(found: SceneProperties, key: str, path: Path) -> float:
    if found.background.extent is None:
        raise SceneError(f"The background in {path} lacks the key {key!r}. Add it.")
    return found.background.extent


def _centre(found: SceneProperties) -> Any:
    """Returns the centre of the background (see `host_array`), or `None` for the origin."""
    centre = found.background.centre or ORIGIN
    return host_array(np.asarray(centre, np.float32)) if any(centre) else None


def _read_texture(image: str | None, described: Path) -> Texture:
    """Reads an image: EXR as linear RGB, other formats as 8-bit sRGB."""
    if image is None:
        raise SceneError(f"The background in {described} lacks the key 'image'. Add it.")
    path = Path(image)
    if path.suffix.lower() != ".exr":
        texels = (image_files.read_rgb(path) / 255.0).astype(np.float32)
        return SrgbTexture(host_array(texels))
    texels = image_files.read_exr(path)
    if texels.ndim != 3:
        raise SceneError(f"{path} has one channel, but a background has three. Export R, G and B.")
    if not np.all(np.isfinite(texels)):
        raise SceneError(f"{path} has a colour that is not finite. Export it again.")
    return LinearTexture(host_array(texels))


def _stack(textures: list[Texture], path: Path) -> Texture:
    kinds = {type(texture) for texture in textures}
    if len(kinds) > 1 or len({texture.texels.shape for texture in textures}) > 1:
        raise SceneError(
            f"The images of the faces in {path} differ in size or format. Use images "
            "of one size, all PNG or all EXR."
        )
    return kinds.pop()(host_array(np.stack([texture.texels for texture in textures])))


def _axes(face: Face, path: Path) -> Float[np.ndarray, "3 3"]:
    """Returns the normal, u axis and v axis of a face as rows: unit vectors, perpendicular."""
    missing = [key for key in ("normal", "u_axis", "v_axis") if getattr(face, key) is None]
    if missing:
        raise SceneError(f"The face {face.name!r} in {path} lacks the key {missing[0]!r}. Add it.")
    axes = np.asarray([face.normal, face.u_axis, face.v_axis], np.float64)
    if not np.max(np.abs(axes @ axes.T - np.eye(3))) < _AXES_TOLERANCE:
        raise SceneError(
            f"The normal, u_axis and v_axis of face {face.name!r} are not perpendicular unit "
            f"vectors in {path}. Correct them."
        )
    return axes
