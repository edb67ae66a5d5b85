"""Claim: R3F needs no masks: the surface of a NeuS field leads light to the same shape and index.

    python -m benchmarks.r3f_without_masks --scenes=FOLDER,FOLDER [--out=FOLDER]

Each scene is copied without its masks and reconstructed with `--geometry=neus`, then, as it is,
with the hull of its masks. The table has the surface before and after the refinement by light:
Chamfer distance as a share of the diameter, angle between its normals and the true ones, index.
`overlap` is that of the true masks of the training views and the silhouettes of the first surface.

Asserted are an overlap of 0.97 and, after the refinement by light, normals within 0.3 degrees and
an index within 0.003 of the truth. Finished reconstructions are reused.
"""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
from absl import app, flags

from experiments.r3f import object_source, records
from experiments.runs import subprocesses
from refref_jax.data import meshes, scene_folder
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.reconstruct.masks import Views
from refref_jax.reconstruct.mesh_distance import compare_meshes, silhouette_overlap

_SCENES = flags.DEFINE_list("scenes", ["experiments/data/cube_smcvx_ball"], "Folders of scenes.")
_OUT = flags.DEFINE_string("out", "runs/r3f_without_masks", "Output folder.")

_OVERLAP, _NORMALS, _INDEX = 0.97, 0.3, 0.003


def main(arguments: list[str]) -> None:
    del arguments
    wrong = []
    print("| scene | geometry | overlap | surface | Chamfer, % | normals, degrees | index |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for scene in map(Path, _SCENES.value):
        for geometry in ("neus", "hull"):
            wrong += _measure(scene, geometry)
    assert not wrong, "; ".join(wrong)


def _measure(scene: Path, geometry: str) -> list[str]:
    """Reconstructs a scene, prints its surfaces, and returns what is out of bounds."""
    name = scene.resolve().name
    folder = Path(_OUT.value) / name
    read = scene if geometry == "hull" else _without_masks(scene, folder / "scene" / name)
    out = folder / geometry
    options = [f"--scene={read}", f"--out={out}", f"--geometry={geometry}"]
    subprocesses.run("reconstruct", *options, log=folder / f"{geometry}.log")
    found = records.read(out)
    (part,) = meshes.read_meshes(scene)
    truth = shaded_mesh(part)
    frames = scene_folder.read_frames(scene, "train")
    views = Views(scene_folder.read_masks(frames), frames.cameras)
    first = object_source.read_mesh(out, dataclasses.replace(found, light=None))
    overlap = float(np.mean(silhouette_overlap(first, *views)))
    for surface, facts in (("first", dataclasses.replace(found, light=None)), ("light", found)):
        distance = compare_meshes(object_source.read_mesh(out, facts), truth)
        index = object_source.index_facts(facts).index
        print(
            f"| {name} | {geometry} | {overlap:.4f} | {surface} | {100.0 * distance.chamfer:.4f} | "
            f"{distance.normal_error:.3f} | {index:.4f} |",
            flush=True,
        )
    within = {
        "the overlap": overlap >= _OVERLAP,
        "normals": distance.normal_error <= _NORMALS,
        "the index": abs(index - part.index) <= _INDEX,
    }
    return [
        f"{name}, {geometry}: {what} out of bounds" for what, holds in within.items() if not holds
    ]


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
