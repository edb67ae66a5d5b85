"""Refines the poses of a scene by what its images show beside the object, and through it.

python -m experiments.refine_cameras --scene=SCENE --out=SCENE_refined

For poses that are a little wrong, by up to a degree and a few percent of the distance. Pixels in
masks, and five pixels around them, are left out, since their light is bent; views without a mask,
or with an empty one, are used as a whole. --out gets a copy of the scene with other poses, of all
splits, and `cameras.json` with the corrections. Lenses are not changed. `docs/captures.md` explains
the method.

python -m experiments.refine_cameras --scene=SCENE_refined --reconstruction=runs/aligned --out=COPY

refines poses that are nearly right by all pixels, also those that see an object that was aligned or
reconstructed, where the background is the surface that `scene.json` states and images have one
exposure.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import NamedTuple

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar

with epy.lazy_imports():
    import numpy as np

    from experiments.cameras import bundle, refined_scene, refinement, through_object
    from experiments.r3f import alignment, chain, index_stage, records
    from refref_jax.reconstruct import gauss_newton

_SCENE = cli_flags.scene("The scene whose poses are refined")
_OUT = cli_flags.out("Copy to write, which must not exist.")
_DEGREES = flags.DEFINE_float(
    "degrees",
    None,
    "Expected error of given rotations, per axis, degrees: by default 0.5, or 0.05 with "
    "--reconstruction.",
    1e-3,
    5.0,
)
_PERCENT = flags.DEFINE_float(
    "percent",
    None,
    "Expected error of given positions, per axis, percent of the cameras' mean distance from their "
    "middle: by default 1, or 0.1 with --reconstruction.",
    1e-3,
    10.0,
)
_RECONSTRUCTION = flags.DEFINE_string(
    "reconstruction",
    None,
    "Folder of a reconstruction or alignment of the object, through which poses are refined.",
)
_SEED = cli_flags.seed("With --reconstruction: seed of the backdrop and of the draw of pixels.")
cli_flags.allow_outside()


def main() -> None:
    """Refines the poses of a scene."""
    cli_scenes.check(_SCENE.value)
    scene, out = cli_scenes.opened(_SCENE.value), Path(_OUT.value)
    refined_scene.check_place(scene, out)
    outputs.check_folder(out)
    given = _RECONSTRUCTION.value
    through = None if given is None else _object(Path(given))
    before = refined_scene.read(scene)
    distance = bundle.mean_distance(before.views)
    usual = (0.5, 1.0) if through is None else (0.05, 0.1)
    said = (_DEGREES.value, _PERCENT.value)
    degrees, percent = (usual[i] if said[i] is None else said[i] for i in range(2))
    prior = bundle.Prior(math.radians(degrees), 0.01 * percent * distance)
    if through is None:
        refined = refinement.refine(before.views, before.photos, prior=prior, report=print)
    else:
        refined = _through_object(scene, through, before, prior)
    refined_scene.write(scene, out, before, refined)
    turned = np.degrees(np.linalg.norm(refined.corrections[:, :3], axis=-1))
    moved = 100.0 * np.linalg.norm(refined.corrections[:, 3:], axis=-1) / distance
    print(refined.describe())
    print(f"Turned:  {turned.mean():.4f} degrees on average, {turned.max():.4f} at most")
    print(f"Moved:   {moved.mean():.4f} % of the distance on average, {moved.max():.4f} at most")
    print(f"Scene:   {out}")
    follow = [f"--scene={out}", f"--out={out}_run"]
    follow += [] if given is None else [f"--reconstruction={given}"]
    print(f"Next: {app.shell('train', *follow)}")


class _Object(NamedTuple):
    """An object of known place: its model, and the options with which it was found."""

    model: alignment.PlacedObject
    config: records.ReconstructionConfig


def _object(folder: Path) -> _Object:
    """Reads the object of a reconstruction or an alignment.

    Raises:
      ValueError: if the folder has none, or it was found with a gain for each image.
    """
    model, _ = alignment.placed_object(chain.read_parts(folder))
    config = records.read(folder).config
    if config.exposure != "fixed":
        raise ValueError(
            f"{folder} was reconstructed with --exposure={config.exposure}, but cameras are "
            "refined through an object with images of one exposure only. Leave out "
            "--reconstruction."
        )
    return _Object(model, config)


def _through_object(
    scene: Path, through: _Object, before: refined_scene.SceneViews, prior: bundle.Prior
) -> through_object.RefinedThrough:
    """Returns poses refined through an object.

    Raises:
      ValueError: if the background is not a known surface.
    """
    model, config = through
    bounds = {"space": config.space, "radius": config.radius, "centre": config.centre}
    with tempfile.TemporaryDirectory() as draft:
        surface = index_stage.learn_backdrop(scene, Path(draft), seed=_SEED.value, **bounds)
    if surface is None:
        raise ValueError(
            f"{scene}: the background is not a surface that scene.json states and the images show, "
            "so that light behind the object is not known. Leave out --reconstruction."
        )
    with ProgressBar("cameras", through_object.STEPS) as bar:
        return through_object.refine(
            before.views,
            before.photos,
            gauss_newton.traced_object(model.pose(model.start())),
            surface,
            prior=prior,
            seed=_SEED.value,
            progress=lambda done, _: bar.show(done, "steps"),
        )


if __name__ == "__main__":
    app.run(main, again="an existing copy is never replaced.")
