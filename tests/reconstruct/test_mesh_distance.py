import functools

import numpy as np
import pytest
import trimesh

from refref_jax.data import meshes, scene_folder
from refref_jax.geometry.triangle_meshes import make_mesh
from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.grids import find_isosurface
from refref_jax.reconstruct.masks import Views, carve
from refref_jax.reconstruct.mesh_distance import (
    carved_alone,
    compare_meshes,
    distance_grid,
    signed_distance,
    silhouette_overlap,
    silhouettes,
    without_outliers,
)
from refref_jax.reconstruct.refinement import Refinement, refine
from tests.factories import bodies


def test_a_mesh_is_no_distance_from_itself():
    mesh = bodies.fine_box()
    found = compare_meshes(mesh, mesh, samples=2000)
    assert found.chamfer < 1e-12 and found.furthest < 1e-12 and found.normal_error < 1e-4


def test_concentric_balls_are_as_far_as_their_radii():
    found = compare_meshes(bodies.icosphere(4, radius=1.1), bodies.icosphere(4), samples=2000)
    diameter = 2.0 * np.sqrt(3.0)
    assert found.chamfer == pytest.approx(0.1 / diameter, rel=0.02)
    assert found.normal_error < 0.3


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_distances_scale_with_the_mesh(scale):
    ball, points = bodies.icosphere(2), np.random.default_rng(0).normal(size=(200, 3))
    small = make_mesh(scale * ball.vertices, ball.faces)
    expected = scale * signed_distance(ball)(points)
    np.testing.assert_allclose(signed_distance(small)(scale * points), expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("unit", "shift"),
    [
        (1.0, 0.0),
        (1e-4, 0.0),
        pytest.param(1e4, 0.0, marks=pytest.mark.slow),
        pytest.param(1.0, 1000.0, marks=pytest.mark.slow),
    ],
)
def test_a_grid_has_the_distances_of_a_ring_with_a_ball_in_its_hole(unit, shift):
    """The hole is outside, the ball a second body, and all of it may be far from the origin."""
    ring = trimesh.creation.torus(1.1, 0.35, major_sections=64, minor_sections=32)
    both = bodies.joined(bodies.as_mesh(ring), bodies.icosphere(3, radius=0.5))
    centre = np.array([shift, -shift, 0.0])
    moved = make_mesh(unit * both.vertices + centre, both.faces)
    grid = distance_grid(moved, spacing=0.07 * unit, margin=0.3 * unit)
    places = grid.low + grid.spacing * np.moveaxis(np.indices(grid.values.shape), 0, -1)
    points = (places - centre) / unit
    to_ring = np.hypot(np.hypot(points[..., 0], points[..., 1]) - 1.1, points[..., 2]) - 0.35
    expected = np.minimum(to_ring, np.linalg.norm(points, axis=-1) - 0.5)
    # Facets are up to 0.0027 below the surfaces; a twentieth of a spacing is 0.0035.
    np.testing.assert_allclose(grid.values / unit, expected, atol=0.006)
    ends = places.min(axis=(0, 1, 2)), places.max(axis=(0, 1, 2))
    assert np.all(ends[0] <= moved.vertices.min(axis=0) - 0.299 * unit)
    assert np.all(ends[1] >= moved.vertices.max(axis=0) + 0.299 * unit)


def test_turned_normals_are_off_by_the_angle():
    box = bodies.fine_box()
    turn = trimesh.transformations.rotation_matrix(0.05, [0, 0, 1])[:3, :3]
    found = compare_meshes(box._replace(normals=box.normals @ turn), box, samples=4000)
    # Four of six faces turn.
    assert found.normal_error == pytest.approx(np.degrees(0.05) * 4.0 / 6.0, rel=0.02)
    assert found.normal_error_99 == pytest.approx(np.degrees(0.05))
    assert found.chamfer < 1e-12


@pytest.mark.slow
def test_silhouettes_are_those_of_marched_rays():
    cameras = bodies.cameras_around(3)
    masks = bodies.masks_of(bodies.ball, cameras)
    overlap = silhouette_overlap(bodies.icosphere(4), masks, cameras)
    assert np.all(overlap > 0.985) and np.all(overlap <= 1.0)
    assert np.all(silhouette_overlap(bodies.icosphere(4), ~masks, cameras) < 0.02)
    nothing = bodies.icosphere(1, radius=0.1, centre=(50.0, 0.0, 0.0))
    assert np.all(silhouette_overlap(nothing, np.zeros_like(masks), cameras) == 1.0)
    assert silhouettes(bodies.icosphere(2), cameras).shape == masks.shape


@pytest.mark.slow
def test_the_bundled_ball_is_found_from_its_masks(ball_scene):
    train, test = (scene_folder.read_frames(ball_scene, split) for split in ("train", "test"))
    grid = carve(scene_folder.read_masks(train), train.cameras, resolution=64)
    stages = refine(find_isosurface(grid), Refinement())
    assert not any(stage.refused for stage in stages)
    part = meshes.read_meshes(ball_scene)[0]
    truth = make_mesh(part.vertices, part.faces)
    found = compare_meshes(stages[-1].mesh, truth, samples=5000)
    assert found.normal_error < 1.0 and found.chamfer < 1e-3
    assert found.normal_error < 0.5 * compare_meshes(stages[0].mesh, truth).normal_error
    overlap = silhouette_overlap(
        stages[-1].mesh,
        scene_folder.read_masks(test)[:6],
        test.cameras._replace(poses=test.cameras.poses[:6]),
    )
    assert overlap.mean() > 0.99


_SPOILT = 7


@functools.cache
def _views():
    cameras = bodies.cameras_around(30)
    return Views(bodies.masks_of(bodies.ball, cameras), cameras)


def _halved():
    """One mask shows half of the ball."""
    masks = _views().masks.copy()
    masks[_SPOILT, :, :32] = False
    return Views(masks, _views().cameras)


def test_right_masks_carve_little_that_others_do_not():
    assert carved_alone(_views()).max() < 0.03


def test_a_mask_of_half_the_body_carves_half_of_it_alone():
    shares = carved_alone(_halved())
    assert shares[_SPOILT] == pytest.approx(0.5, abs=0.05)
    assert np.delete(shares, _SPOILT).max() < 0.05


def test_points_that_no_view_sees_count_for_nothing():
    few = _views()._replace(cameras=_views().cameras._replace(focal=4.0 * _views().cameras.focal))
    shares = carved_alone(few)
    assert np.all(np.isfinite(shares)) and shares.max() <= 1.0


@pytest.mark.parametrize("count", [-1, 30])
def test_no_more_views_can_be_left_out_than_there_are(count):
    with pytest.raises(ReconstructionError, match="cannot be left out"):
        without_outliers(bodies.icosphere(1), _views(), count)


def test_no_views_carve_nothing():
    cameras = _views().cameras
    with pytest.raises(ReconstructionError, match="There are no masks"):
        carved_alone(Views(_views().masks[:0], cameras._replace(poses=cameras.poses[:0])))


@pytest.mark.slow
def test_the_view_that_overlaps_least_is_left_out():
    mesh = bodies.icosphere(3)
    kept = without_outliers(mesh, _halved(), 1)
    assert len(kept.masks) == len(kept.cameras.poses) == 29
    np.testing.assert_array_equal(kept.masks, np.delete(_views().masks, _SPOILT, axis=0))
    expected = np.delete(_views().cameras.poses, _SPOILT, axis=0)
    np.testing.assert_array_equal(kept.cameras.poses, expected)
    assert without_outliers(mesh, _halved(), 0).masks.shape == _views().masks.shape
