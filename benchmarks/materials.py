"""Claim: each material looks as in Blender Cycles where the background is known.

    python -m benchmarks.materials --scenes='runs/materials/*'

Renders the test views of scenes, usually those of `dataset.make --scenes='cube_materials_*'`,
along the path tree, and compares them with Cycles' images inside the mask. Asserted is a masked
PSNR of 38 dB, with 256 rays per pixel; on scenes with a rough surface 32 dB, with 64 rays per
pixel, since both images have noise there.
"""

import statistics
from pathlib import Path

import numpy as np
from absl import app, flags

from experiments.runs import known_scene
from refref_jax.optics.path_settings import TREE

_SCENES = flags.DEFINE_list("scenes", ["runs/materials/*"], "Folders of scenes, or patterns.")

_SMOOTH_SIDE, _SMOOTH_DECIBELS = 16, 38.0
_ROUGH_SIDE, _ROUGH_DECIBELS = 8, 32.0


def measure(folder: Path) -> tuple[int, float, float]:
    """Returns the rays per pixel, the mean masked PSNR of the test views, and the bound on it."""
    scene = known_scene.read_scene(folder, split="test", views="all", rule=None, indices={})
    rough = bool(np.any(scene.objects.interfaces.alpha))
    side, bound = (_ROUGH_SIDE, _ROUGH_DECIBELS) if rough else (_SMOOTH_SIDE, _SMOOTH_DECIBELS)
    decibels = []
    for view in range(len(scene.indices)):
        seen = known_scene.render_view(scene, view, settings=TREE, side=side)
        decibels.append(known_scene.measure(scene, view, seen.rgb)["psnr_masked"])
    return side**2, statistics.mean(decibels), bound


def main(arguments: list[str]) -> None:
    del arguments
    folders = sorted(path for pattern in _SCENES.value for path in Path().glob(pattern))
    if not folders:
        raise SystemExit("--scenes names no folder. Render them: see docs/dataset.md.")
    rows = {folder.name: measure(folder) for folder in folders if (folder / "scene.json").is_file()}
    print("scene,rays_per_pixel,psnr_masked")
    for name, (rays, decibels, _) in rows.items():
        print(f"{name},{rays},{decibels:.1f}")
    for name, (_, decibels, bound) in rows.items():
        assert decibels >= bound, f"{name}: {decibels:.1f} dB, below {bound}"


if __name__ == "__main__":
    app.run(main)
