"""Claim: R3F needs no masks: the surface of a NeuS field leads light to the same shape and index.

    python -m benchmarks.r3f_without_masks --scenes=FOLDER,FOLDER [--out=FOLDER]
    python -m benchmarks.r3f_without_masks --surface_only --geometries=neus,nunerf --scenes=FOLDER

Each scene is copied without its masks and reconstructed with `--geometry=neus`, then, as it is,
with the hull of its masks. The table has the surface before and after the refinement by light:
Chamfer distance as a share of the diameter, angle between its normals and the true ones, index.
`overlap` is that of the true masks of the training views and the silhouettes of the first surface;
`holes` is the number of holes through that surface.

Asserted are an overlap of 0.97 and, after the refinement by light, normals within 0.3 degrees and
an index within 0.003 of the truth. With `--surface_only`, the true index is given, nothing is
refined by light, and the overlap alone is asserted. Finished reconstructions are reused.
"""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
from absl import app, flags

from experiments.r3f import field_surface, object_source, records
from experiments.runs import subprocesses
from refref_jax.data import meshes, scene_folder
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.reconstruct.masks import Views
from refref_jax.reconstruct.mesh_distance import compare_meshes, silhouette_overlap

_SCENES = flags.DEFINE_list("scenes", ["experiments/data/cube_smcvx_ball"], "Folders of scenes.")
_OUT = flags.DEFINE_string("out", "runs/r3f_without_masks", "Output folder.")
_GEOMETRIES = flags.DEFINE_list("geometries", ["neus", "hull"], "Methods to find the surface.")
_SURFACE_ONLY = flags.DEFINE_bool("surface_only", False, "Whether to end before light.")

_OVERLAP, _NORMALS, _INDEX = 0.97, 0.3, 0.003


def main(arguments: list[str]) -> None:
    del arguments
    wrong = []
    columns = ("scene", "geometry", "overlap", "holes", "surface", "Chamfer, %", "normals, degrees")
    print(f"| {' | '.join(columns)} | index |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for scene in map(Path, _SCENES.value):
        for geometry in _GEOMETRIES.value:
            wrong += _measure(scene, geometry)
    assert not wrong, "; ".join(wrong)


def _measure(scene: Path, geometry: str) -> list[str]:
    """Reconstructs a scene, prints its surfaces, and returns what is out of bounds."""
    name = scene.resolve().name
    folder = Path(_OUT.value) / name
    masked = geometry not in field_surface.NAMES
    read = scene if masked else _without_masks(scene, folder / "scene" / name)
    (part,) = meshes.read_meshes(scene)
    out = folder / (f"{geometry}_surface" if _SURFACE_ONLY.value else geometry)
    options = [f"--scene={read}", f"--out={out}", f"--geometry={geometry}"]
    if _SURFACE_ONLY.value:
        options += [f"--ior={part.index}", "--refinement=none"]
    subprocesses.run("reconstruct", *options, log=folder / f"{out.name}.log")
    found = records.read(out)
    truth = shaded_mesh(part)
    frames = scene_folder.read_frames(scene, "train")
    views = Views(scene_folder.read_masks(frames), frames.cameras)
    bare = dataclasses.replace(found, light=None)
    first = object_source.read_mesh(out, bare)
    overlap = float(np.mean(silhouette_overlap(first, *views)))
    surfaces = {"first": bare} if _SURFACE_ONLY.value else {"first": bare, "light": found}
    for surface, facts in surfaces.items():
        distance = compare_meshes(object_source.read_mesh(out, facts), truth)
        index = object_source.index_facts(facts).index
        print(
            f"| {name} | {geometry} | {overlap:.4f} | {_holes(first)} | {surface} | "
            f"{100.0 * distance.chamfer:.4f} | {distance.normal_error:.3f} | {index:.4f} |",
            flush=True,
        )
    within = {"the overlap": overlap >= _OVERLAP}
    if not _SURFACE_ONLY.value:
        within["normals"] = distance.normal_error <= _NORMALS
        within["the index"] = abs(index - part.index) <= _INDEX
    return [
        f"{name}, {geometry}: {what} out of bounds" for what, holds in within.items() if not holds
    ]


def _holes(mesh: Mesh) -> int:
    """Returns the number of holes through a closed surface of one piece: 1 of a torus."""
    corners = np.unique(mesh.vertices, axis=0)
    # Vertices - edges + faces is 2 - 2 holes; each edge has two faces, each face three edges.
    return (2 - len(corners) + len(mesh.faces) // 2) // 2


def _without_masks(scene: Path, copy: Path) -> Path:
    """Returns a copy of a scene without its masks."""
    if copy.is_dir():
        return copy
    shutil.copytree(scene, copy.with_suffix(".unfinished"), dirs_exist_ok=True)
    for path in copy.with_suffix(".unfinished").glob("transforms_*.json"):
        content = json.loads(path.read_text())
        for frame in content["frames"]:
            frame.pop("mask_file_path", None)
        path.write_text(json.dumps(content))
    copy.with_suffix(".unfinished").rename(copy)
    return copy


if __name__ == "__main__":
    app.run(main)
