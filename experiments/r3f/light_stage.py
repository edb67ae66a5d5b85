"""The stage of R3F that refines the body by the light that went through it, if that is asked for.

    {out}/light/{object}_{material}.ply    the refined surface

It is kept only if it explains pixels better that it was not fitted to: those of the validation
views, and only if it is still the same body. Scenes without such views are refused.
"""

import dataclasses
from pathlib import Path

import numpy as np

from experiments.cli.progress import ProgressBar
from experiments.r3f import index_stage
from experiments.r3f.index_stage import BodyPixels
from experiments.r3f.records import IndexFacts, LightFacts
from refref_jax import atomic_files
from refref_jax.data import meshes
from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.reconstruct import refractive_index
from refref_jax.reconstruct.light_refinement import LightRefinement, refine_by_light
from refref_jax.reconstruct.refinement import objection
from refref_jax.render.model import Model

FOLDER = "light"

# Pixels that are descended on, and those that judge.
_SEEN = 60_000
_JUDGES = 8192

# Share of the volume that light may change: it mends normals, not outlines.
_VOLUME_CHANGE = 0.02


def run(
    scene: Path, mesh: Mesh, known: IndexFacts, model: Model, target: Path, *, steps: int, seed: int
) -> LightFacts:
    """Refines a body, and writes it if it is better.

    Args:
      scene: its folder; training and validation images and masks are read.
      mesh: the body.
      known: its index of refraction, which stays as it is if it was given.
      model: of the background.
      target: the file, in a folder of its own.
      steps: of the descent.
      seed: of everything random.

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
            index_stage.body_geometry(mesh, index).interfaces,
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


def find_judges(scene: Path, model: Model, *, seed: int) -> BodyPixels:
    """Returns the pixels of the validation views that a refinement is judged by.

    Raises:
      ValueError: if there is no validation split with masks.
    """
    return index_stage.look(scene, "val", model, seed=seed + 1, rays=_JUDGES)


def judge(mesh: Mesh, index: float, judges: BodyPixels, model: Model) -> float:
    """Returns the mean error of the judging pixels in sRGB, with the body's own tree."""
    errors = refractive_index.errors_at_index(
        np.float32(index),
        judges.evidence,
        index_stage.body_geometry(mesh, index),
        part=0,
        config=model.config,
    )
    return float(np.asarray(errors, np.float64).mean())
