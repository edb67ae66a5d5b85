"""Writes an object's meshes under their published names, one file per material.

    mesh_files/{category}/{object}_{material}.ply

All parts with the same material are in one file. Our reader uses the separate parts, which the
scene keeps. Opaque parts and conductors are not published.
"""

from collections.abc import Sequence
from pathlib import Path

import trimesh

from experiments.dataset.parts import CONDUCTOR, OPAQUE
from refref_jax import atomic_files
from refref_jax.data import SceneError, meshes
from refref_jax.data.scene_names import CATEGORIES, SceneName


def write(parts: Sequence[Path], name: SceneName, out: Path) -> None:
    """Writes the meshes of a scene's object; they are the same for all backgrounds.

    Args:
      parts: mesh files of the scene; those of unknown material, of opaque parts and of conductors
        are omitted.
      name: name of the scene.
      out: folder of the complete layout.

    Raises:
      SceneError: if a different mesh of that name exists already.
    """
    by_material: dict[str, list[Path]] = {}
    for part in sorted(parts):
        if part.stem.rpartition("_")[2] in (OPAQUE, CONDUCTOR):
            continue  # another word of the name may be a material, as in perfume_red_cap_opaque
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
                f"{target} exists, but {name} has another mesh. Give another --out, or use "
                "the same mesh in all scenes of an object."
            )


def _merged(files: Sequence[Path]) -> bytes:
    """Returns one PLY file with the triangles of all files; a single file is returned verbatim."""
    if len(files) == 1:
        return files[0].read_bytes()
    surfaces = [trimesh.Trimesh(*meshes.read_mesh(path), process=False) for path in files]
    return trimesh.util.concatenate(surfaces).export(file_type="ply")
