import sys

import numpy as np
import pytest
import trimesh

from refref_jax.geometry.triangle_meshes import is_closed, volume
from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.grids import Box, Grid, find_isosurface, sample
from refref_jax.reconstruct.mesh_distance import ClosestSearch, signed_distance
from tests.factories import bodies

_BOX = Box(np.full(3, -1.6), np.full(3, 1.6))


def _sampled(body, spacing=0.08):
    return sample(body, _BOX, spacing=spacing)


@pytest.mark.parametrize(
    ("body", "expected", "characteristic"),
    [
        (bodies.ball, 4.0 / 3.0 * np.pi, 2),
        (bodies.torus, 2.0 * np.pi**2 * 1.1 * 0.4**2, 0),
        (bodies.box, 1.6**3, 2),
    ],
    ids=["ball", "torus", "box"],
)
def test_surfaces_are_closed_outward_and_of_the_right_volume(body, expected, characteristic):
    mesh = find_isosurface(_sampled(body))
    reference = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert is_closed(mesh.faces) and reference.is_watertight
    assert reference.euler_number == characteristic
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(expected, rel=0.02)
    assert np.allclose(np.linalg.norm(mesh.normals, axis=-1), 1.0)


def test_normals_are_the_gradient():
    mesh = find_isosurface(_sampled(bodies.ball))
    outward = mesh.vertices / np.linalg.norm(mesh.vertices, axis=-1, keepdims=True)
    cosine = np.sum(mesh.normals * outward[mesh.faces], axis=-1)
    assert np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max() < 1.0


def test_a_level_is_a_signed_distance():
    mesh = find_isosurface(sample(bodies.ball, _BOX, spacing=0.08, level=-0.2), level=-0.2)
    assert np.linalg.norm(mesh.vertices, axis=-1) == pytest.approx(0.8, abs=2e-3)


def test_a_body_that_reaches_the_border_is_closed_there():
    mesh = find_isosurface(Grid(np.full((4, 5, 6), -1.0), np.zeros(3), 0.5))
    assert is_closed(mesh.faces) and volume(mesh.vertices, mesh.faces) > 1.5 * 2.0 * 2.5


def test_a_grid_without_a_body_is_an_error():
    with pytest.raises(ReconstructionError, match="contains no surface"):
        find_isosurface(Grid(np.ones((4, 4, 4)), np.zeros(3), 0.5))


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    with pytest.raises(ReconstructionError, match=r"\[r3f\]"):
        find_isosurface(_sampled(bodies.ball, spacing=0.2))


def test_closest_points_are_those_of_all_triangles():
    generator = np.random.default_rng(3)
    mesh = bodies.as_mesh(trimesh.creation.cone(radius=0.7, height=1.9, sections=7))
    points = generator.uniform(-2.0, 2.0, (200, 3))
    found = ClosestSearch(mesh.vertices, mesh.faces)(points)
    corners = mesh.vertices[mesh.faces]
    every = np.stack(
        [
            trimesh.triangles.closest_point(np.broadcast_to(one, (200, 3, 3)), points)
            for one in corners
        ]
    )
    assert np.allclose(
        found.distances, np.linalg.norm(every - points, axis=-1).min(axis=0), atol=1e-12
    )
    by_weights = np.einsum("nk,nkc->nc", found.weights, corners[found.faces])
    assert np.allclose(by_weights, found.points, atol=1e-9)


def test_signed_distances_are_those_of_the_box():
    mesh = bodies.as_mesh(trimesh.creation.box((1.6, 1.6, 1.6)))
    points = np.random.default_rng(4).uniform(-1.5, 1.5, (2000, 3))
    assert np.allclose(signed_distance(mesh)(points), bodies.box(points), atol=1e-9)


def test_a_mesh_without_area_has_no_closest_point():
    with pytest.raises(ReconstructionError, match="All triangles of the mesh are degenerate"):
        ClosestSearch(np.zeros((3, 3)), np.array([[0, 1, 2]]))
