"""Claim: refinement by light improves pixels that it was not fitted to.

    python -m benchmarks.r3f_light [--scene=FOLDER] [--steps=N]

A scene's object is reconstructed as `experiments.reconstruct --light_steps=N` does. A table
compares the mesh from masks, the mesh refined by light, and the scene's own: the mean error of the
validation views' pixels, the index of refraction, the distance to the scene's own mesh (share of
the diameter) and the angle between the normals, which must not increase. Finished reconstructions
are reused.
"""

import dataclasses
from pathlib import Path

from absl import app, flags

from experiments.r3f import chain, index_stage, light_stage, object_source
from experiments.r3f.records import ReconstructionConfig
from refref_jax.data import meshes
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.reconstruct.mesh_distance import Distance, compare_meshes

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Folder of a scene.")
_STEPS = flags.DEFINE_integer("steps", 60, "Steps of the descent.")
_RESOLUTION = flags.DEFINE_integer("resolution", 128, "Cells along the longest edge of the grid.")
_OUT = flags.DEFINE_string("out", "runs/r3f_light", "Output folder.")

_SEED = 0


def main(arguments: list[str]) -> None:
    del arguments
    scene, out = Path(_SCENE.value), Path(_OUT.value)
    (part,) = meshes.read_meshes(scene)
    truth = shaded_mesh(part)
    found = chain.reconstruct(scene, out, _config(), compare=False)
    masked = dataclasses.replace(found, light=None)
    model = index_stage.learn_background(scene, out / "index", seed=_SEED)
    judges = light_stage.find_judges(scene, model, seed=_SEED)
    print("\n| body | error, sRGB | index | Chamfer, % | normals, degrees: mean, 99 % |")
    print("|---|---|---|---|---|")
    rows = {
        "masks": (object_source.read_mesh(out, masked), masked.index.index),
        "light": (object_source.read_mesh(out, found), object_source.index_facts(found).index),
        "true": (truth, part.index),
    }
    measured = {}
    for name, (mesh, index) in rows.items():
        error = light_stage.judge(mesh, index, judges, model)
        measured[name] = error, compare_meshes(mesh, truth)
        print(_row(name, error, index, measured[name][1]), flush=True)
    (before, normals_before), (after, normals_after), _ = measured.values()
    assert after < before, "refinement by light does not improve held-out pixels"
    assert normals_after.normal_error <= normals_before.normal_error, (
        "refinement by light degrades the normals"
    )


def _config() -> ReconstructionConfig:
    return ReconstructionConfig(
        geometry="hull",
        resolution=_RESOLUTION.value,
        outliers=0,
        index=None,
        space=None,
        radius=None,
        light_steps=_STEPS.value,
        seed=_SEED,
    )


def _row(name: str, error: float, index: float, distance: Distance) -> str:
    return (
        f"| {name} | {error:.4f} | {index:.4f} | {100.0 * distance.chamfer:.3f} "
        f"| {distance.normal_error:.2f}, {distance.normal_error_99:.1f} |"
    )


if __name__ == "__main__":
    app.run(main)
