"""Claim: the estimated index of refraction is within 0.005 with the true mesh, 0.02 without.

    python -m benchmarks.r3f_index [--scenes=FOLDER,FOLDER] [--starts=1.2,2.0] [--bodies=true,masks]

For each scene with a single mesh a background is trained, and the index is estimated with the
scene's own mesh and with the one from masks, from every start. A table shows the estimate, one
standard deviation, and the true index in the scene's record. Finished trainings and reconstructions
are reused.
"""

import time
from pathlib import Path

from absl import app, flags, logging

from experiments.r3f import chain, index_stage, object_source
from experiments.r3f.records import ReconstructionConfig
from refref_jax.data import meshes
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.geometry.triangle_meshes import Mesh

_BODIES = {"true": 0.005, "masks": 0.02}

_SCENES = flags.DEFINE_list("scenes", ["experiments/data/cube_smcvx_ball"], "Folders of scenes.")
_STARTS = flags.DEFINE_list("starts", ["1.2", "2.0"], "Initial indices, in addition to others.")
_BODY = flags.DEFINE_list("bodies", list(_BODIES), "Meshes to estimate with: 'true', 'masks'.")
_OUT = flags.DEFINE_string("out", "runs/r3f_index", "Output folder.")

_CELLS = 128


def main(arguments: list[str]) -> None:
    del arguments
    logging.set_verbosity(logging.ERROR)  # Orbax logs every checkpoint
    starts = [float(start) for start in _STARTS.value]
    rows, wrong = [], []
    for scene in map(Path, _SCENES.value):
        name, out = scene.resolve().name, Path(_OUT.value) / scene.resolve().name
        (part,) = meshes.read_meshes(scene)
        for kind in _BODY.value:
            mesh = shaded_mesh(part) if kind == "true" else _mesh_of_masks(scene, out)
            for start in starts:
                begun = time.monotonic()
                found = index_stage.run(scene, mesh, out, seed=0, start=start)
                seconds = time.monotonic() - begun
                rows.append(
                    f"| {name} | {kind} | {start:g} | {found.index:.4f} ± {found.deviation:.4f} "
                    f"| {part.index:g} | {seconds:.0f} |"
                )
                print(rows[-1], flush=True)
                if abs(found.index - part.index) > _BODIES[kind]:
                    wrong.append(rows[-1])
    print("\n| scene | mesh | start | index | truth | seconds |\n|---|---|---|---|---|---|")
    print("\n".join(rows))
    assert not wrong, "\n".join(["the index is too far off:", *wrong])


def _mesh_of_masks(scene: Path, out: Path) -> Mesh:
    """Reconstructs an object as the command does, with an index that is never used."""
    folder = out / "reconstruction"
    config = ReconstructionConfig("hull", _CELLS, 0, 1.5, None, None, "none", 0)
    found = chain.reconstruct(scene, folder, config, compare=True)
    return object_source.read_mesh(folder, found)


if __name__ == "__main__":
    app.run(main)
