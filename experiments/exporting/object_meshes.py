"""Writes the refractive objects as PLY, with their shading normals.

A run stores its meshes in single precision; a reconstruction stores its surface as a file.
"""

from pathlib import Path

import numpy as np

from experiments.cli import outputs
from experiments.exporting.field_mesh import split_parts
from experiments.r3f import object_source, records
from refref_jax.data import meshes
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.optics.media import Scene
from refref_jax.render.checkpoint_io import load_scene


def write(run: Path, out: Path, *, overwrite: bool) -> list[Path]:
    """Writes all objects of a run or a reconstruction, one file each.

    Args:
      run: folder of the run or reconstruction.
      out: file of the mesh; several meshes are numbered: `out_0.ply`, `out_1.ply`.
      overwrite: whether existing files may be replaced.

    Returns:
      The files.

    Raises:
      ValueError: if it is not the folder of a run, if there is no object, or if a file may not be
      replaced.
    """
    if records.exists(run):
        found = [shaded_mesh(part) for part in object_source.read_parts(run, _finished(run))]
    else:
        found = read_meshes(load_scene(run))
    if not found:
        raise ValueError(
            f"{run} has no object: it was trained along straight rays, or without meshes. Export "
            "--what=mesh, or another run."
        )
    paths = [out]
    if len(found) > 1:
        paths = [out.with_stem(f"{out.stem}_{number}") for number in range(len(found))]
    for path in paths:
        outputs.check_file(path, overwrite=overwrite)
    for path, mesh in zip(paths, found, strict=True):
        with outputs.fresh_file(path, overwrite=overwrite) as draft:
            meshes.write_mesh(draft, *mesh)
    return paths


def read_meshes(scene: Scene) -> list[Mesh]:
    """Returns the parts of a run's scene in their order; coincident vertices are merged."""
    found = []
    for surfaces, triangles in split_parts(scene):
        normals = surfaces.normals[: len(triangles)].astype(np.float64)
        corners = surfaces.bvh.triangles[: len(triangles)].astype(np.float64)
        vertices, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
        found.append(Mesh(vertices, index.reshape(-1, 3), normals))
    return found


def _finished(run: Path) -> records.Reconstruction:
    found = records.read(run)
    if found.geometry is None or found.index is None:
        raise ValueError(
            f"The reconstruction in {run} is not finished. Run `python -m experiments.reconstruct` "
            "with the same options again: it resumes where it was stopped."
        )
    return found
