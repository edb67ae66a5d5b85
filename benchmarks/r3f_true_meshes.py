"""Claim: where light leaves a large error, the shape is wrong, not the index or the tint.

    python -m benchmarks.r3f_true_meshes --scenes=FOLDER,FOLDER --reconstructions=FOLDER,FOLDER

For scenes of one clear glass, prints the error of the pixels that judge a refinement by light (root
mean square of the channels of a pixel, at most 0.15, sRGB; its mean over the pixels): of the object
as it was found, of the same surfaces with the true index and no tint, and of the scene's own
meshes. Asserted is that the true media explain less than a tenth of what the true meshes explain.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from absl import app, flags, logging

from experiments.r3f import index_stage, light_stage, object_source, records
from refref_jax.choices import CLEAR
from refref_jax.data import mesh_queries, meshes
from refref_jax.data.meshes import MeshPart
from refref_jax.data.scene_assembly import assemble_scene, shaded_mesh
from refref_jax.optics.media import INDEX_OF_AIR
from refref_jax.reconstruct import gauss_newton, photometry
from refref_jax.reconstruct.photometry import Backdrop, Photographs

_SCENES = flags.DEFINE_list("scenes", None, "Folders of scenes of one clear glass.", required=True)
_FOUND = flags.DEFINE_list(
    "reconstructions", None, "Folders of their reconstructions, in the same order.", required=True
)

_SHARE = 0.1
"""Largest error that true media explain, as a share of what true meshes explain."""


def error_of(parts: Sequence[MeshPart], surface: Backdrop, judges: Photographs) -> float:
    """Returns the mean error of an object of several parts under the rule `nested`."""
    tree = mesh_queries.find_containment(parts)
    built = assemble_scene(parts, tree.parents, rule="nested", overlaps=tree.overlaps)
    shaded = [shaded_mesh(part) for part in parts]
    traced = photometry.assemble(
        np.concatenate([mesh.vertices[mesh.faces] for mesh in shaded]),
        np.concatenate([mesh.normals for mesh in shaded]),
        np.repeat(np.arange(len(shaded)), [len(mesh.faces) for mesh in shaded]),
        built.interfaces,
    )
    return float(gauss_newton.errors_of(traced, surface, judges).mean())


def measure(scene: Path, reconstruction: Path) -> tuple[float, float, float]:
    """Returns the errors as found, with the true media, and of the true meshes."""
    record = records.read(reconstruction)
    config = record.config
    surface = index_stage.learn_backdrop(
        scene,
        reconstruction / "index",
        space=config.space,
        radius=config.radius,
        centre=config.centre,
        exposure=config.exposure,
        seed=config.seed,
    )
    if surface is None:
        raise ValueError(f"{reconstruction} has no backdrop to measure errors in front of.")
    true = meshes.read_meshes(scene)
    indices = {part.index for part in true if part.index != INDEX_OF_AIR}
    if len(indices) != 1:
        raise ValueError(f"{scene} has {len(indices)} indices of refraction; give scenes of one.")
    (index,) = indices
    judges = light_stage.read(scene, seed=config.seed).judges
    found = object_source.read_parts(reconstruction, record)
    clear = [
        part if part.index == INDEX_OF_AIR else part._replace(index=index, tint=CLEAR)
        for part in found
    ]
    as_found, with_media, of_truth = (
        error_of(parts, surface, judges) for parts in (found, clear, true)
    )
    return as_found, with_media, of_truth


def main(arguments: list[str]) -> None:
    del arguments
    logging.set_verbosity(logging.ERROR)  # Orbax logs every checkpoint
    pairs = zip(map(Path, _SCENES.value), map(Path, _FOUND.value), strict=True)
    rows = {scene.resolve().name: measure(scene, found) for scene, found in pairs}
    print("scene,found,true_media,true_meshes")
    for name, errors in rows.items():
        print(",".join([name, *(f"{error:.4f}" for error in errors)]))
    for name, (found, media, truth) in rows.items():
        assert found - media < _SHARE * (found - truth), name


if __name__ == "__main__":
    app.run(main)
