"""Refines the poses of a scene by what its images show beside the object.

python -m experiments.refine_cameras --scene=SCENE --out=SCENE_refined

For poses that are a little wrong, by up to a degree and a few percent of the distance. Pixels in
masks, and five pixels around them, are left out, since their light is bent; views without a mask,
or with an empty one, are used as a whole. --out gets a copy of the scene with other poses, of all
splits, and `cameras.json` with the corrections. Lenses are not changed. `docs/captures.md` explains
the method.
"""

from __future__ import annotations

import math
from pathlib import Path

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes

with epy.lazy_imports():
    import numpy as np

    from experiments.cameras import bundle, refined_scene, refinement

_SCENE = cli_flags.scene("The scene whose poses are refined")
_OUT = cli_flags.out("Copy to write, which must not exist.")
_DEGREES = flags.DEFINE_float(
    "degrees", 0.5, "Expected error of given rotations, per axis, degrees.", 1e-3, 5.0
)
_PERCENT = flags.DEFINE_float(
    "percent",
    1.0,
    "Expected error of given positions, per axis, percent of the cameras' mean distance from their "
    "middle.",
    1e-3,
    10.0,
)
cli_flags.allow_outside()


def main() -> None:
    """Refines the poses of a scene."""
    cli_scenes.check(_SCENE.value)
    scene, out = cli_scenes.opened(_SCENE.value), Path(_OUT.value)
    refined_scene.check_place(scene, out)
    outputs.check_folder(out)
    before = refined_scene.read(scene)
    distance = refined_scene.mean_distance(before.views)
    prior = bundle.Prior(math.radians(_DEGREES.value), 0.01 * _PERCENT.value * distance)
    refined = refinement.refine(before.views, before.photos, prior=prior, report=print)
    refined_scene.write(scene, out, before, refined)
    turned = np.degrees(np.linalg.norm(refined.corrections[:, :3], axis=-1))
    moved = 100.0 * np.linalg.norm(refined.corrections[:, 3:], axis=-1) / distance
    print(f"Views:   {len(turned)}, with {refined.sightings.min()} points or more each")
    print(f"Turned:  {turned.mean():.3f} degrees on average, {turned.max():.3f} at most")
    print(f"Moved:   {moved.mean():.3f} % of the distance on average, {moved.max():.3f} at most")
    print(f"Error:   {refined.error:.3f} pixels per axis")
    print(f"Scene:   {out}")
    print(f"Next: {app.shell('train', f'--scene={out}', f'--out={out}_run')}")


if __name__ == "__main__":
    app.run(main, again="an existing copy is never replaced.")
