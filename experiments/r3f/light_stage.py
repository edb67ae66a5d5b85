"""Refines the object with the light refracted through it, an optional stage of R3F.

    {out}/light/{object}_{material}.ply    the refined surface

The result is kept only if it explains the pixels of the validation views better, which it was not
fitted to, and if the shape has not changed fundamentally. Scenes without validation masks are
rejected.
"""

import dataclasses
from pathlib import Path

import numpy as np

from experiments.cli.progress import ProgressBar
from experiments.r3f import index_stage
from experiments.r3f.index_stage import ObjectPixels
from experiments.r3f.records import IndexFacts, LightFacts
from refref_jax import atomic_files
from refref_jax.data import meshes
from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.reconstruct import refractive_index
from refref_jax.reconstruct.light_refinement import LightRefinement, refine_by_light
from refref_jax.reconstruct.refinement import objection
from refref_jax.render.model import Model

FOLDER = "light"

# Number of pixels used in the descent, and of pixels for validation.
_SEEN = 60_000
_JUDGES = 8192

# Share of the volume that the refinement may change: it corrects normals, not outlines.
_VOLUME_CHANGE = 0.02


def run(
    scene: Path, mesh: Mesh, known: IndexFacts, model: Model, target: Path, *, steps: int, seed: int
) -> LightFacts:
    """Refines an object, and writes it if it is better.

    Args:
      scene: folder of the scene; training and validation images and masks are read.
      mesh: mesh of the object.
      known: index of refraction, which is fixed if the user set it.
      model: model of the background.
      target: path of the mesh to write, in a folder of its own.
      steps: number of steps of the descent.
      seed: random seed.

    Raises:
      ValueError: if there is no validation split with masks.
    """
    index, settings = known.index, LightRefinement(steps=steps, seed=seed)
    if known.source == "given":
        settings = dataclasses.replace(settings, index_stride=0.0)
    judges = find_judges(scene, model, seed=seed)
    seen = index_stage.look(scene, "train", model, seed=seed, rays=_SEEN)
    with ProgressBar("light", steps) as bar:
        found = refine_by_light(
            mesh,
            index,
            index_stage.object_scene(mesh, index).interfaces,
            seen.evidence,
            config=model.config,
            settings=settings,
            progress=lambda step, error: bar.show(step, f"error {error:.4f}"),
        )
    before = judge(mesh, index, judges, model)
    after = judge(found.mesh, found.index, judges, model)
    kept = after < before and not objection(mesh, found.mesh, _VOLUME_CHANGE)
    if kept:
        with atomic_files.written_folder(target.parent) as folder:
            meshes.write_mesh(folder / target.name, *found.mesh)
    return LightFacts(steps, kept, before, after, found.index, found.furthest)


def find_judges(scene: Path, model: Model, *, seed: int) -> ObjectPixels:
    """Returns the pixels of the validation views by which a refinement is judged.

    Raises:
      ValueError: if there is no validation split with masks.
    """
    return index_stage.look(scene, "val", model, seed=seed + 1, rays=_JUDGES)


def judge(mesh: Mesh, index: float, judges: ObjectPixels, model: Model) -> float:
    """Returns the mean error of the validation pixels in sRGB, with the mesh's own BVH."""
    errors = refractive_index.errors_at_index(
        np.float32(index),
        judges.evidence,
        index_stage.object_scene(mesh, index),
        part=0,
        config=model.config,
    )
    return float(np.asarray(errors, np.float64).mean())
