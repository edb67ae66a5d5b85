"""Writes an object's meshes under their published names, one file per material.

    mesh_files/{category}/{object}_{material}.ply

All parts of a material are in one file. Ours reads the parts themselves, which a scene keeps.
"""

from collections.abc import Sequence
from pathlib import Path

import trimesh

from refref_jax import atomic_files
from refref_jax.data import meshes
from refref_jax.data.errors import SceneError
from refref_jax.data.scene_names import CATEGORIES, SceneName


def write(parts: Sequence[Path], name: SceneName, out: Path) -> None:
    """Writes the meshes of a scene's object; those of another background's scene are the same.

    Args:
      parts: mesh files of the scene; those of unknown material are omitted.
      name: name of the scene.
      out: folder of the complete layout.

    Raises:
      SceneError: if a mesh is there already, and is another.
    """
    by_material: dict[str, list[Path]] = {}
    for part in sorted(parts):
        if (material := meshes.material_of(part)) is not None:
            by_material.setdefault(material, []).append(part)
    folder = out / "mesh_files" / CATEGORIES[name.category]
    for material, files in by_material.items():
        target, content = folder / f"{name.object}_{material}.ply", _merged(files)
        if not target.exists():
            folder.mkdir(parents=True, exist_ok=True)
            with atomic_files.written_file(target) as draft:
                draft.write_bytes(content)
        elif target.read_bytes() != content:
            raise SceneError(
                f"{target} is there already, but {name} has another mesh. Give another --out, or "
                "the same mesh to all scenes of an object."
            )


def _merged(files: Sequence[Path]) -> bytes:
    """Returns one PLY file of all the files' triangles; of one file, itself."""
    if len(files) == 1:
        return files[0].read_bytes()
    surfaces = [trimesh.Trimesh(*meshes.read_mesh(path), process=False) for path in files]
    return trimesh.util.concatenate(surfaces).export(file_type="ply")
