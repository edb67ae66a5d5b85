"""Claim: no part of the fit by light keeps the free surface away from the truth.

    python -m benchmarks.r3f_ablations --reconstruction=OUT --scene=FOLDER

OUT is a finished reconstruction of the scene. Its surface from masks is fitted again as a free
surface, with all parts of the method and without one at a time: the blur of the backdrop, the rows
of the outlines, the robust weights that are wide in the third group of steps, all robust weights
from this group on, the index as an unknown, and the smoothing before each group. The table has the
angle between normals and the true ones, and the error of pixels that were not fitted. Asserted is
that no variant has normals that are better by more than a tenth.
"""

import dataclasses
from pathlib import Path
from typing import NamedTuple

from absl import app, flags, logging

from experiments.r3f import index_stage, light_stage, object_source, records
from refref_jax.data import meshes
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.reconstruct.mesh_distance import compare_meshes
from refref_jax.reconstruct.model_selection import Trial
from refref_jax.reconstruct.outlines import Outlines
from refref_jax.reconstruct.photometry import Backdrop
from refref_jax.reconstruct.shape_from_refraction import (
    FreeSurfaceSettings,
    SingleObject,
    first_blur,
    fit_free_surface,
)
from refref_jax.reconstruct.shapes import FixedShape

_SCENE = flags.DEFINE_string("scene", None, "Folder of the scene.", required=True)
_RECONSTRUCTION = flags.DEFINE_string("reconstruction", None, "Its reconstruction.", required=True)

_EVEN = 1e3
"""Scale of the robust weights at which all pixels have the same, sRGB."""


class Variant(NamedTuple):
    """What a fit has.

    Attributes:
      settings: settings of the steps.
      outlines: whether the masks' outlines are fitted.
      deviation: standard deviation of the index's prior; 0 keeps it.
      blur: whether the backdrop is blurred at first.
    """

    settings: FreeSurfaceSettings = FreeSurfaceSettings()
    outlines: bool = True
    deviation: float = 0.02
    blur: bool = True


_VARIANTS = {
    "all parts": Variant(),
    "no blur": Variant(blur=False),
    "no outlines": Variant(outlines=False),
    "no wide robust weights": Variant(FreeSurfaceSettings(widest=(0.0,) * 4)),
    "no robust weights at last": Variant(FreeSurfaceSettings(widest=(0.0, 0.0, _EVEN, _EVEN))),
    "index fixed": Variant(deviation=0.0),
    "no smoothing": Variant(FreeSurfaceSettings(smoothings=(0.0,) * 4)),
}


def main(arguments: list[str]) -> None:
    del arguments
    logging.set_verbosity(logging.ERROR)
    scene, out = Path(_SCENE.value), Path(_RECONSTRUCTION.value)
    found = dataclasses.replace(records.read(out), light=None)
    assert found.index is not None, "the reconstruction is finished"
    surface = index_stage.learn_backdrop(scene, out / "index", seed=0)
    assert surface is not None, "the scene has a backdrop"
    mesh, seen = object_source.read_mesh(out, found), light_stage.read(scene, seed=0)
    truth = shaded_mesh(meshes.read_meshes(scene)[0])
    print("| fit | error, sRGB | index | normals, degrees: mean, 99 % |\n|---|---|---|---|")
    errors = {}
    for name, variant in _VARIANTS.items():
        trial = _fitted(scene, mesh, found.index.index, surface, seen, variant)
        distance = compare_meshes(trial.mesh, truth)
        angles = f"{distance.normal_error:.3f}, {distance.normal_error_99:.2f}"
        print(f"| {name} | {trial.error:.4f} | {trial.outer_index:.4f} | {angles} |", flush=True)
        errors[name] = distance.normal_error
    worse = [name for name, error in errors.items() if error < 0.9 * errors["all parts"]]
    assert not worse, f"better by more than a tenth: {', '.join(worse)}"


def _fitted(
    scene: Path,
    mesh: Mesh,
    index: float,
    surface: Backdrop,
    seen: light_stage.Seen,
    variant: Variant,
) -> Trial:
    """Fits a free surface."""
    outlines = Outlines(light_stage.read_views(scene), common=light_stage.WIDER, seed=0)
    fixed = SingleObject(FixedShape(mesh), index)
    blur = first_blur(fixed.pose(fixed.start()), surface, seen.judges) if variant.blur else 0
    return fit_free_surface(
        mesh,
        index,
        surface,
        seen.fitted,
        seen.judges,
        settings=variant.settings,
        blur=blur,
        deviation=variant.deviation,
        outlines=outlines if variant.outlines else None,
    )


if __name__ == "__main__":
    app.run(main)
