"""Claim: an occupancy field trained on masks is about as accurate as their visual hull.

    python -m benchmarks.r3f_occupancy [--scene=FOLDER] [--masks=given,uneven,shifted]

The training masks of a scene are carved (`masks.carve`), and an occupancy field is trained on them
(`occupancy`); both surfaces are then refined. The table shows the mean distance from the true mesh
(share of the diameter), the mean angle between the normals, the overlap of silhouettes in test
views, and the volume.

The claim is about correct masks (`given`). Results with wrong masks are shown, without a claim:
`uneven`, where every second one is eroded and the others dilated by a pixel; `shifted`, where one
is moved by a tenth of its width. The last case has two hulls: `hull`, and `hull, 1 out`, which
ignores one view at every point.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from absl import app, flags
from jaxtyping import Bool
from scipy.ndimage import binary_dilation, binary_erosion

from refref_jax.data import scene_folder
from refref_jax.geometry.cameras import Cameras
from refref_jax.geometry.triangle_meshes import Mesh, make_mesh, volume
from refref_jax.reconstruct import occupancy
from refref_jax.reconstruct.grids import Grid, find_isosurface
from refref_jax.reconstruct.masks import Views, carve
from refref_jax.reconstruct.mesh_distance import (
    Distance,
    compare_meshes,
    silhouette_overlap,
    without_outliers,
)
from refref_jax.reconstruct.occupancy import OccupancyTrainingConfig
from refref_jax.reconstruct.refinement import Refinement, refine

Masks = Bool[np.ndarray, "views h w"]

_KINDS = ("given", "uneven", "shifted")

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Scene of one mesh.")
_MASKS = flags.DEFINE_list("masks", list(_KINDS), f"Which masks: {', '.join(_KINDS)}.")
_RESOLUTION = flags.DEFINE_integer("resolution", 96, "Cells along the longest edge of the grid.")
_STEPS = flags.DEFINE_integer("steps", OccupancyTrainingConfig().steps, "Steps of training.")

_TEST_VIEWS = 10

_ONE_OUT = "hull, 1 out"
_OUTLIERS = {_ONE_OUT: 1}

# Largest ratio of the field's distance to the hull's.
_AS_NEAR = 1.25


def main(arguments: list[str]) -> None:
    del arguments
    scene = Path(_SCENE.value)
    truth = _true_mesh(scene)
    frames, others = (scene_folder.read_frames(scene, split) for split in ("train", "test"))
    masks = scene_folder.read_masks(frames)
    print("| masks | body | stage | Chamfer, % | normals, degrees: mean, 99 % | IoU | volume |")
    print("|---|---|---|---|---|---|---|")
    for kind in _MASKS.value:
        refined = {}
        for body, make in _objects(kind).items():
            views = Views(_altered(kind, masks), frames.cameras)
            mesh = find_isosurface(make(*views))
            trusted = without_outliers(mesh, views, _OUTLIERS.get(body, 0))
            better = refine(mesh, Refinement(), views=trusted)[-1].mesh
            for stage, shown in (("raw", mesh), ("refined", better)):
                refined[body] = _row((kind, body, stage), shown, truth, others)
        if kind == "given":
            _check(refined)


def _objects(kind: str) -> dict[str, Callable[[Masks, Cameras], Grid]]:
    resolution = _RESOLUTION.value
    config = OccupancyTrainingConfig(steps=_STEPS.value)
    bodies: dict[str, Callable[[Masks, Cameras], Grid]] = {
        "hull": lambda *views: carve(*views, resolution=resolution),
        _ONE_OUT: lambda *views: carve(*views, resolution=resolution, outliers=1),
        "occupancy": lambda *views: occupancy.fit(*views, config=config, resolution=resolution),
    }
    if kind != "shifted":
        del bodies[_ONE_OUT]
    return bodies


def _altered(kind: str, masks: Masks) -> Masks:
    """Returns masks with the errors of a kind."""
    if kind == "uneven":
        changes = (binary_erosion, binary_dilation)
        return np.stack([changes[i % 2](mask) for i, mask in enumerate(masks)])
    if kind == "shifted":
        masks = masks.copy()
        view = len(masks) // 2
        masks[view] = np.roll(masks[view], masks.shape[2] // 10, axis=1)
    return masks


def _row(
    names: tuple[str, ...], mesh: Mesh, truth: Mesh, others: scene_folder.Frames
) -> tuple[Distance, float]:
    """Prints a row, and returns its distance and IoU."""
    cameras = others.cameras._replace(poses=others.cameras.poses[:_TEST_VIEWS])
    expected = scene_folder.read_masks(others)[:_TEST_VIEWS]
    found = compare_meshes(mesh, truth)
    overlap = float(silhouette_overlap(mesh, expected, cameras).mean())
    share = volume(*mesh[:2]) / volume(*truth[:2])
    print(
        f"| {' | '.join(names)} | {100.0 * found.chamfer:.3f} "
        f"| {found.normal_error:.2f}, {found.normal_error_99:.1f} | {overlap:.4f} "
        f"| {share:.3f} |",
        flush=True,
    )
    return found, overlap


def _check(refined: dict[str, tuple[Distance, float]]) -> None:
    """Asserts the claim."""
    (field, _), (hull, _) = refined["occupancy"], refined["hull"]
    most = _AS_NEAR * hull.chamfer
    assert field.chamfer <= most, "the field's surface is much further off than the hull's"
    assert field.chamfer <= 0.005, "the field's surface is further than 0.5 % of the diameter off"


def _true_mesh(scene: Path) -> Mesh:
    (path,) = (scene / "meshes").glob("*.ply")
    mesh = trimesh.load(path, process=True)
    return make_mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


if __name__ == "__main__":
    app.run(main)
