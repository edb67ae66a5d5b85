"""Reads the meshes of a scene and resolves their materials (NumPy only).

One PLY file is one part. Its material is the last word of the file name that the table of indices
contains: `perfume_red_glass.ply` is glass. `scene_properties` reads the description of each mesh in
`scene.json`. The index of refraction is, in this order, that of the caller's `indices`, that of the
part in `scene.json`, that of its material there, and that of the table.

A reconstructed mesh has its own shading normals, from the gradient of a field or averaged within
patches; those of any other mesh follow from its faces. `write_mesh` stores them. PLY has one normal
per vertex, so a vertex with several normals is written several times, and the reader merges equal
positions again. Numbers are in double precision, and are read back exactly. Normals are only read
from files with exactly the header that `write_mesh` writes, because other programs may store any
normals.
"""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Int

from refref_jax.choices import CLEAR, NO_ABSORPTION, Colour, Material, ShadingOverride
from refref_jax.data import FARTHEST, SceneError, image_files, scene_names, scene_properties
from refref_jax.data.scene_properties import PartDescription, SceneProperties, Shading

_HEADER = """ply
format binary_little_endian 1.0
comment shading normals of refref_jax
element vertex {}
property double x
property double y
property double z
property double nx
property double ny
property double nz
element face {}
property list uchar int vertex_indices
end_header
"""

_VERTEX = np.dtype([("position", "<f8", 3), ("normal", "<f8", 3)])
_FACE = np.dtype([("corners", "u1"), ("vertices", "<i4", 3)])

_LONGEST_NORMALS_HEADER = len(_HEADER) + 40

INDEX_OF_REFRACTION: dict[str, float] = {
    "glass": 1.5,
    "water": 1.333,
    "diamond": 2.418,
    "air": 1.0,
    "alcohol": 1.36,
    "plastic": 1.45,
    "perfume": 1.46,
}
"""Indices of refraction of the data set's materials."""

_LONGEST_HEADER = 1 << 16

_OTHER_MESHES = (".glb", ".gltf", ".obj", ".off", ".stl")


def write_mesh(
    path: Path,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    normals: Float[np.ndarray, "faces 3 3"],
) -> None:
    """Writes a mesh as PLY.

    Args:
      path: path of the file.
      vertices: positions in world units.
      faces: vertex indices, counter-clockwise seen from outside.
      normals: outward unit shading normals at the corners of the faces.
    """
    corners = np.concatenate([vertices[faces], normals], axis=-1).reshape(-1, 6)
    split, index = np.unique(corners, axis=0, return_inverse=True)
    points = np.zeros(len(split), _VERTEX)
    points["position"], points["normal"] = split[:, :3], split[:, 3:]
    triangles = np.zeros(len(faces), _FACE)
    triangles["corners"], triangles["vertices"] = 3, index.reshape(-1, 3)
    header = _HEADER.format(len(points), len(triangles)).encode()
    path.write_bytes(header + points.tobytes() + triangles.tobytes())


def read_normals(path: Path) -> Float[np.ndarray, "faces 3 3"] | None:
    """Returns the corner normals of a file of `write_mesh`, or `None` for any other file."""
    content = path.read_bytes()
    end = content.find(b"end_header\n", 0, _LONGEST_NORMALS_HEADER) + len(b"end_header\n")
    words = content[:end].decode("ascii", "replace").split()
    counts = [int(word) for word in words if word.isdecimal()]
    if len(counts) != 2 or content[:end] != _HEADER.format(*counts).encode():
        return None
    middle = end + counts[0] * _VERTEX.itemsize
    if len(content) != middle + counts[1] * _FACE.itemsize:
        return None
    points = np.frombuffer(content[end:middle], _VERTEX)
    triangles = np.frombuffer(content[middle:], _FACE)
    return points["normal"][triangles["vertices"]]


class MeshPart(NamedTuple):
    """One closed surface and its material.

    Attributes:
      name: the file's stem.
      vertices: positions in world units; equal positions are merged.
      faces: vertex indices, counter-clockwise seen from outside.
      index: index of refraction inside.
      shading: `smooth`, `flat`, or `auto` for smooth up to the crease angle.
      tint: factor of linear RGB light at every reflection and every crossing of the surface.
      absorption: absorption of the medium inside, linear RGB, per world unit.
      priority: priority under the rule `priority`; the highest wins where parts overlap.
      colour_known: whether tint or absorption is given, not just the default.
      material: kind of the part, and what else its surface and its inside are made of.
      normals: outward unit shading normals at the corners of the faces, or `None` if `shading`
        decides them.
      radiance: linear RGB radiance at the corners of the faces, or `None` if it is unknown or the
        part is not opaque.
    """

    name: str
    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    index: float  # type: ignore[assignment]  # hides tuple.index
    shading: Shading
    tint: Colour = CLEAR
    absorption: Colour = NO_ABSORPTION
    priority: int = 0
    colour_known: bool = False
    material: Material = Material()
    normals: Float[np.ndarray, "faces 3 3"] | None = None
    radiance: Float[np.ndarray, "faces 3 3"] | None = None


def read_meshes(
    scene: Path,
    *,
    indices: Mapping[str, float] | None = None,
    properties: SceneProperties | None = None,
    folder: Path | None = None,
) -> list[MeshPart]:
    """Reads all parts of a scene, ordered by name.

    Args:
      scene: the scene folder, see `mesh_files`; without mesh files, there are no parts.
      indices: indices of refraction that replace or extend the table and `scene.json`, by
        material or, for one part alone, by file stem.
      properties: properties of the scene; by default those of its `scene.json`.
      folder: folder of other mesh files.

    Raises:
      SceneError: if a mesh is broken or empty, if its material is unknown, if an index is not
        positive or does not fit any mesh, or if `scene.json` is invalid or describes a missing
        mesh.
    """
    overrides = dict(indices or {})
    for name, index in overrides.items():
        check_index(name, index)
    paths = mesh_files(scene, folder=folder)
    found = properties or scene_properties.read(scene)
    table = INDEX_OF_REFRACTION | dict(found.indices) | overrides
    _check_overrides(overrides, paths, table)
    foreign = set(found.indices) - set(INDEX_OF_REFRACTION)
    if paths and (idle := sorted(foreign - {material_of(path, table=table) for path in paths})):
        raise SceneError(
            f"{found.origins['ior']}: ior.{idle[0]} fits no mesh. Remove it, or name a mesh "
            f"so, as in {paths[0].stem}_{idle[0]}.ply."
        )
    missing = sorted(set(found.parts) - {path.name for path in paths})
    if missing and paths:
        raise SceneError(
            f"{found.origins[missing[0]]} describes {missing[0]}, but {paths[0].parent} does not "
            "hold it. Restore the mesh, or remove its description."
        )
    unknown = PartDescription()
    return [
        _read_part(path, overrides, found.parts.get(path.name, unknown), table) for path in paths
    ]


def refuse_missing(parts: Sequence[MeshPart], origins: Mapping[str, Any]) -> None:
    """Refuses a scene without meshes whose properties describe some.

    Args:
      parts: parts of the scene.
      origins: names or paths of the files that define its properties, see `SceneProperties`.

    Raises:
      SceneError: if there is no part, but a file describes one.
    """
    if (lost := sorted(name for name in origins if name.lower().endswith(".ply"))) and not parts:
        raise SceneError(
            f"{origins[lost[0]]} describes {lost[0]}, but the scene's folder meshes holds no mesh. "
            "Restore it, remove the description, or use paths=straight."
        )


def check_index(name: str, index: float) -> None:
    """Refuses an invalid index of refraction.

    Raises:
      SceneError: if the index is not a positive number.
    """
    if not index > 0.0 or not np.isfinite(index):
        raise SceneError(
            f"The index of refraction of {name!r} is {index}. Give a positive number, such as 1.5 "
            "for glass."
        )


def read_part(path: Path, *, index: float, shading: Shading = "auto") -> MeshPart:
    """Reads one mesh outside a scene folder, with a given index of refraction.

    Raises:
      SceneError: if the file is broken, or has no triangle.
    """
    return _read_part(path, {path.stem: index}, PartDescription(shading=shading), {})


def mesh_files(scene: Path, *, folder: Path | None = None) -> list[Path]:
    """Returns the mesh files of a scene, ordered by name.

    They are `meshes/*.ply` in its folder. If a folder of the raw release has none, they are those
    of `published_meshes` in `mesh_files/{category}` next to `image_data`.

    Args:
      scene: the scene folder.
      folder: another folder of meshes.

    Raises:
      SceneError: if there are only meshes in another format.
    """
    given, name = folder is not None, None
    folder = folder or scene / "meshes"
    if not given and not folder.is_dir() and (name := scene_names.of_raw_folder(scene)) is not None:
        places = [above / "mesh_files" for above in scene.resolve().parents[2:4]]
        category = scene_names.CATEGORIES[name.category]
        folder = next((each for each in places if each.is_dir()), folder) / category
    if folder.exists() and not folder.is_dir():
        raise SceneError(f"{folder} is not a folder. Restore the folder of meshes, or remove it.")
    found = sorted(folder.iterdir()) if folder.is_dir() else []
    paths = [path for path in found if path.suffix.lower() == ".ply"]
    if not paths and (other := [each for each in found if each.suffix.lower() in _OTHER_MESHES]):
        raise SceneError(f"{other[0]} is not a PLY file. Export the mesh as PLY, or remove it.")
    return paths if name is None else published_meshes(name.object, paths)


def published_meshes(thing: str, paths: Sequence[Path]) -> list[Path]:
    """Returns the meshes of an object among the published files of its category.

    They are named `{object}_{material}.ply`, one per material. Names are matched completely:
    ball_coloured_glass.ply is not a mesh of the object ball. If there is none and the object is
    named after its material, its mesh may have this single word as its name: `diamond.ply`.

    Args:
      thing: name of the object.
      paths: paths of the category's mesh files.
    """
    stems = {f"{thing}_{material}" for material in INDEX_OF_REFRACTION}
    found = [path for path in paths if path.stem in stems]
    return found or [path for path in paths if path.stem == thing in INDEX_OF_REFRACTION]


def without_colour(parts: Sequence[MeshPart]) -> list[MeshPart]:
    """Returns the parts without their colours, with clear surfaces and media.

    This is for fields that learn the colour of glass from images, as the paper's oracle does: a
    tint that is already applied to the light paths would count twice.
    """
    return [
        part
        if part.material.kind == "conductor"
        else part._replace(tint=CLEAR, absorption=NO_ABSORPTION)
        for part in parts
    ]


def with_shading(parts: Sequence[MeshPart], shading: ShadingOverride) -> list[MeshPart]:
    """Returns the parts with other shading; `scene` keeps the shading and normals of each part."""
    if shading == "scene":
        return list(parts)
    return [part._replace(shading=shading, normals=None) for part in parts]


def read_mesh(path: Path) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Reads the vertices and triangles of one file, merging equal positions.

    Raises:
      SceneError: if the file is broken, or has no triangle.
    """
    try:
        mesh = _load(path)
        vertices = np.asarray(mesh.vertices, np.float64)
        faces = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
    except Exception as error:  # trimesh raises errors of many types for broken files
        raise SceneError(
            f"{path} cannot be read as a mesh ({error}). It may be truncated: export it again."
        ) from error
    if len(faces) < _declared_faces(path) and len(faces):
        raise SceneError(
            f"{path} has fewer faces than it declares. It may be truncated: export it again."
        )
    return merge_corners(str(path), vertices, faces)


def merge_corners(
    name: str, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "f 3"]]:
    """Validates the arrays of a mesh, and merges equal positions.

    Raises:
      SceneError: if there is no triangle, a missing vertex, or a position that is not finite.
    """
    if len(faces) == 0:
        raise SceneError(f"{name} has no triangles. Export the mesh again, or leave it out.")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise SceneError(
            f"{name} has faces without vertices. It may be truncated: export it again."
        )
    if not np.all(np.isfinite(vertices)):
        raise SceneError(f"{name} has a vertex that is not finite. Clean the mesh.")
    if np.max(np.abs(vertices)) > FARTHEST:
        raise SceneError(
            f"{name} has a vertex beyond {FARTHEST:g} world units. Move or scale the scene."
        )
    vertices, index = np.unique(vertices, axis=0, return_inverse=True)
    return vertices, index.reshape(-1)[faces]


def _load(path: Any) -> Any:
    """Returns the mesh of a file, without the textures that it may name."""
    return trimesh.load_mesh(path, process=False, skip_materials=True)


def _declared_faces(path: Path) -> int:
    """Returns the number of faces that a PLY header declares: there should be as many triangles."""
    found = re.search(rb"element face (\d+)", path.read_bytes()[:_LONGEST_HEADER])
    return int(found.group(1)) if found else 0


def _read_part(
    path: Path,
    overrides: Mapping[str, float],
    described: PartDescription,
    table: Mapping[str, float],
) -> MeshPart:
    index = _index(path, overrides, described, table)
    vertices, faces = read_mesh(path)
    normals = read_normals(path) if described.shading == "auto" else None
    part = MeshPart(path.stem, vertices, faces, index, *described[1:], normals)
    if {path.stem, material_of(path, table=table)} & set(overrides):  # one index for all colours
        part = part._replace(material=part.material._replace(dispersion=None))
    return part._replace(radiance=read_radiance(part.material, faces, path=path))


def read_radiance(
    material: Material, faces: Int[np.ndarray, "faces 3"], *, path: Any
) -> Float[np.ndarray, "faces 3 3"] | None:
    """Returns the linear RGB radiance of an opaque part at the corners of its faces, if known.

    Args:
      material: material of the part.
      faces: faces of its mesh.
      path: file of its mesh, if the radiance is that of its vertices.

    Raises:
      SceneError: if the file has no vertex colours, but the material names them.
    """
    if material.radiance is None:
        return None
    if material.radiance != "vertex_colours":
        return np.broadcast_to(np.asarray(material.radiance, np.float64), (len(faces), 3, 3))
    mesh = _load(path) if isinstance(path, str | os.PathLike) else path
    visual: Any = getattr(mesh, "visual", None)
    if getattr(visual, "kind", None) != "vertex":
        raise SceneError(
            f"{path if isinstance(path, str | os.PathLike) else 'The mesh'} has no vertex colours, "
            "which its material names as its radiance. Export them, or give three numbers."
        )
    encoded = np.asarray(visual.vertex_colors, np.float64)[:, :3] / 255.0
    return image_files.srgb_to_linear(encoded)[np.asarray(mesh.faces)]


def _index(
    path: Path,
    overrides: Mapping[str, float],
    described: PartDescription,
    table: Mapping[str, float],
) -> float:
    """Returns the index of refraction of a mesh file, by the order in the module docstring."""
    if path.stem in overrides:
        return overrides[path.stem]
    if described.material.kind in ("opaque", "conductor"):
        return INDEX_OF_REFRACTION["air"]  # light does not enter
    material = material_of(path, table=table)
    if described.index is not None and material not in overrides:
        return described.index
    if material is None:
        raise SceneError(
            f"The material of {path} is unknown: no word of its name is one of "
            f"{', '.join(sorted(table))}. Rename the file, as in {path.stem}_glass.ply, or give "
            f"its index in indices, as {{'{path.stem}': 1.5}}."
        )
    return table[material]


def material_of(path: Path, *, table: Mapping[str, float] = INDEX_OF_REFRACTION) -> str | None:
    """Returns the material of a mesh file: the last word of its name that is in the table."""
    known = [word for word in path.stem.split("_") if word in table]
    return known[-1] if known else None


def _check_overrides(
    overrides: Mapping[str, float], paths: Sequence[Path], table: Mapping[str, float]
) -> None:
    known = {path.stem for path in paths} | {material_of(path, table=table) for path in paths}
    for name in overrides:
        if name not in known:
            raise SceneError(
                f"The index of refraction given for {name!r} fits no mesh. The meshes are "
                f"{', '.join(path.name for path in paths) or 'none'}: use one of their names, "
                "without .ply, or a material in it."
            )
