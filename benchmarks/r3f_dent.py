"""Claim: light finds 80 % of the depth of a dent that no silhouette shows.

    python -m benchmarks.r3f_dent [--slope=4.7] [--width=0.44]

A ball of glass has a smooth dent, too shallow for the outline of any view. Its photographs are
rendered here, in front of the backdrop that is solved for from the bundled scene, with noise of one
hundredth; so the world is known better than in photographs of a real one. The ball without the dent
is what masks give. The table has the depth of the dent and the error of the normals within it.
"""

from pathlib import Path

import numpy as np
import trimesh
from absl import app, flags, logging
from jaxtyping import Float

from experiments.r3f import index_stage
from refref_jax.data import image_files, scene_folder
from refref_jax.geometry.cameras import pixel_rays
from refref_jax.geometry.triangle_meshes import Mesh, make_mesh
from refref_jax.reconstruct import (
    gauss_newton,
    model_selection,
    photometry,
    shape_from_refraction,
)
from refref_jax.reconstruct.mesh_distance import silhouettes
from refref_jax.reconstruct.photometry import Backdrop, Photographs
from refref_jax.reconstruct.shapes import FixedShape

_SLOPE = flags.DEFINE_float("slope", 4.7, "Steepest slope of the dent, degrees.", 0.0)
_WIDTH = flags.DEFINE_float("width", 0.44, "Standard deviation of the dent, world units.", 0.01)
_NOISE = flags.DEFINE_float("noise", 0.01, "Standard deviation of the pixels' noise, sRGB.", 0.0)
_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "World and cameras.")
_OUT = flags.DEFINE_string("out", "runs/r3f_dent", "Folder of the backdrop.")

_RADIUS, _INDEX = 1.4, 1.5
_PLACE = np.array([0.6, 0.64, 0.48])

_DEPTH = 0.8
"""Share of the depth that must be found."""


def main(arguments: list[str]) -> None:
    del arguments
    logging.set_verbosity(logging.ERROR)  # Orbax logs every checkpoint
    scene, out = Path(_SCENE.value), Path(_OUT.value)
    out.mkdir(parents=True, exist_ok=True)
    surface = index_stage.learn_backdrop(scene, out, seed=0)
    assert surface is not None, "the bundled scene has a backdrop"
    ball = trimesh.creation.icosphere(subdivisions=6, radius=_RADIUS)
    plain = make_mesh(np.asarray(ball.vertices), np.asarray(ball.faces, np.int64))
    dented = _dented(plain)
    fitted = _photograph(dented, surface, scene, "train", 0)
    judges = _photograph(dented, surface, scene, "val", 1)
    trials = shape_from_refraction.fit_shapes(plain, _INDEX, surface, fitted, judges)
    chosen = model_selection.choose(trials)
    print("| surface | depth, share of the true one | normals in the dent, degrees | index |")
    print("|---|---|---|---|")
    for name, mesh, index in (
        ("from masks", plain, _INDEX),
        (chosen.name, chosen.mesh, chosen.outer_index),
    ):
        depth = _depth(mesh) / _depth(dented)
        print(f"| {name} | {depth:.3f} | {_angle(mesh, dented):.2f} | {index:.4f} |")
    assert _depth(chosen.mesh) >= _DEPTH * _depth(dented), "the dent is not found"


def _dented(plain: Mesh) -> Mesh:
    """Returns the ball with a dent of Gaussian section, whose steepest slope is given."""
    depth = np.radians(_SLOPE.value) * _WIDTH.value * np.exp(0.5)
    outward = plain.vertices / _RADIUS
    away = _RADIUS * np.arccos(np.clip(outward @ _PLACE, -1.0, 1.0))
    dent = depth * np.exp(-0.5 * (away / _WIDTH.value) ** 2)
    return make_mesh(plain.vertices - dent[:, None] * outward, plain.faces)


def _photograph(mesh: Mesh, surface: Backdrop, scene: Path, split: str, seed: int) -> Photographs:
    """Renders all pixels well inside the outlines of a mesh."""
    cameras = scene_folder.read_frames(scene, split).cameras
    inside = image_files.well_inside(silhouettes(mesh, cameras))
    view, row, column = np.nonzero(inside)
    rays = pixel_rays(cameras, view, row, column)
    model = shape_from_refraction.SingleObject(FixedShape(mesh), _INDEX)
    body = gauss_newton.traced_object(model.pose(model.start()))
    rgb = photometry.encode(photometry.predict(body, surface, rays).linear)
    noise = np.random.default_rng(seed).normal(0.0, _NOISE.value, rgb.shape)
    levels = np.round(255.0 * np.clip(rgb + noise, 0.0, 1.0))
    return Photographs(rays, (levels / 255.0).astype(np.float32), view)


def _depth(mesh: Mesh) -> float:
    """Returns the mean depth at the middle of the dent, below the rest of the surface."""
    radii = np.linalg.norm(mesh.vertices, axis=-1)
    cosine = (mesh.vertices / radii[:, None]) @ _PLACE
    away = _RADIUS * np.arccos(np.clip(cosine, -1.0, 1.0))
    rest = float(np.median(radii[away > 5.0 * _WIDTH.value]))
    return rest - float(radii[away < 0.3 * _WIDTH.value].mean())


def _angle(mesh: Mesh, dented: Mesh) -> float:
    """Returns the mean angle to the true normals within the dent, degrees."""
    search = trimesh.Trimesh(dented.vertices, dented.faces, process=False).kdtree
    true = _vertex_normals(dented)
    found = _vertex_normals(mesh)
    outward = mesh.vertices / np.linalg.norm(mesh.vertices, axis=-1, keepdims=True)
    near = _RADIUS * np.arccos(np.clip(outward @ _PLACE, -1.0, 1.0)) < 2.0 * _WIDTH.value
    closest = search.query(mesh.vertices[near])[1]
    cosine = np.sum(found[near] * true[closest], axis=-1)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).mean())


def _vertex_normals(mesh: Mesh) -> Float[np.ndarray, "vertices 3"]:
    """Returns the normal of one corner at each vertex: these meshes are smooth."""
    normals = np.zeros_like(mesh.vertices)
    normals[mesh.faces.ravel()] = mesh.normals.reshape(-1, 3)
    return normals


if __name__ == "__main__":
    app.run(main)
