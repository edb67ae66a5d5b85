"""Corrections of poses, their derivatives, points, and the gauge."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.cameras import bundle
from experiments.cameras.bundle import Prior, Sightings, Views
from refref_jax.geometry import cameras as pinholes

_RNG = np.random.default_rng(0)


def _views(count=6):
    angle = np.linspace(0.0, 2.0, count)
    place = np.stack([4 * np.cos(angle), 4 * np.sin(angle), np.linspace(0.5, 2.0, count)], -1)
    back = place / np.linalg.norm(place, axis=1, keepdims=True)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.stack([right, np.cross(back, right), back, place], -1)
    return Views(poses, np.linspace(90.0, 110.0, count), np.tile([64.0, 48.0], (count, 1)))


def _sightings(views, points):
    count, total = len(views.poses), len(points)
    view, point = (each.ravel() for each in np.indices((count, total)))
    return Sightings(view, point, bundle.project(views, points[point], view)[0])


_POINTS = _RNG.uniform(-1.5, 1.5, (40, 3))


def test_points_are_projected_as_the_library_does():
    views = _views()
    camera = pinholes.Cameras(views.poses[:1], 128, 96, float(views.focals[0]))
    expected = pinholes.project(_POINTS, views.poses[0], camera)
    images, depths = bundle.project(views, _POINTS, np.zeros(40, int))
    np.testing.assert_allclose(images, expected.pixels, atol=1e-10)
    np.testing.assert_allclose(depths, expected.depths, atol=1e-12)


def test_derivatives_are_those_of_differences():
    views, view = _views(), np.arange(40) % 6
    by_view, by_point = bundle.derivatives(views, _POINTS, view)
    step = 1e-6
    for number in range(6):
        change = np.zeros((6, 6))
        change[:, number] = step
        ends = [
            bundle.project(
                views._replace(poses=bundle.corrected(views.poses, sign * change)), _POINTS, view
            )[0]
            for sign in (1, -1)
        ]
        numeric = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(by_view[..., number], numeric, rtol=1e-6, atol=1e-6)
    for axis in range(3):
        moved = step * np.eye(3)[axis]
        ends = [bundle.project(views, _POINTS + sign * moved, view)[0] for sign in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(by_point[..., axis], numeric, rtol=1e-6, atol=1e-6)


def test_corrections_turn_and_shift_in_the_world():
    pose = np.concatenate([np.eye(3), [[1.0], [2.0], [3.0]]], -1)[None]
    quarter = np.array([[0.0, 0.0, np.pi / 2, 0.1, 0.0, -0.2]])
    moved = bundle.corrected(pose, quarter)[0]
    np.testing.assert_allclose(moved[:, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(moved[:, 3], [1.1, 2.0, 2.8])


def test_corrections_between_poses_undo_themselves():
    poses, change = _views().poses, _RNG.normal(0.0, 0.1, (6, 6))
    found = bundle.correction_between(poses, bundle.corrected(poses, change))
    np.testing.assert_allclose(found, change, atol=1e-12)


def test_rays_that_meet_give_their_point():
    views = _views()
    found = bundle.triangulate(views, _sightings(views, _POINTS), 40)
    np.testing.assert_allclose(found, _POINTS, atol=1e-10)


def test_a_similarity_is_found_and_undone():
    poses = _views().poses
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    change = bundle.Similarity(1.7, turn, np.array([0.5, -2.0, 1.0]))
    moved = bundle.moved(poses, change)
    found = bundle.similarity(poses, moved)
    assert found.scale == pytest.approx(1.7, abs=1e-12)
    np.testing.assert_allclose(found.rotation, turn, atol=1e-12)
    np.testing.assert_allclose(bundle.moved(poses, found), moved, atol=1e-12)
    # Light and shadow are as before: points move along, and their images stay.
    views = _views()
    points = 1.7 * _POINTS @ turn.T + change.shift
    view = np.arange(40) % 6
    np.testing.assert_allclose(
        bundle.project(views._replace(poses=moved), points, view)[0],
        bundle.project(views, _POINTS, view)[0],
        atol=1e-9,
    )


def test_cameras_on_a_line_have_a_gauge_but_those_at_a_point_have_none():
    poses = _views().poses.copy()
    poses[..., 3] = [[1.0, 2.0, 0.5]] * np.arange(6.0)[:, None]
    turn = Rotation.from_rotvec([0.1, 0.2, -0.4]).as_matrix()
    change = bundle.Similarity(0.5, turn, np.array([1.0, 0.0, 2.0]))
    found = bundle.similarity(poses, bundle.moved(poses, change))
    np.testing.assert_allclose(found.rotation, turn, atol=1e-12)
    assert found.scale == pytest.approx(0.5)
    poses[..., 3] = 1.0
    with pytest.raises(ValueError, match="same place"):
        bundle.similarity(poses, poses)


def _wrong(views, seed):
    errors = np.random.default_rng(seed).normal(0.0, 1.0, (len(views.poses), 6))
    return bundle.corrected(views.poses, errors * np.repeat([0.005, 0.02], 3))


def _left(poses, true):
    aligned = bundle.moved(poses, bundle.similarity(poses, true))
    return np.abs(bundle.correction_between(true, aligned)).max()


@pytest.mark.parametrize("seed", [0, 1])
def test_exact_sightings_give_exact_poses(seed):
    views = _views()
    seen = _sightings(views, _POINTS)
    given = views._replace(poses=_wrong(views, seed))
    start = bundle.triangulate(given, seen, 40)
    found = bundle.solve(given, start, seen, Prior(0.005, 0.02))
    # The prior, which holds the gauge, bends the result a little, as it knows of no exactness.
    assert _left(given.poses, views.poses) > 0.005
    assert _left(found.views.poses, views.poses) < 1e-4
    assert found.errors.max() < 0.01


def test_a_tenth_of_wrong_sightings_does_not_matter():
    views = _views()
    seen = _sightings(views, _POINTS)
    rng = np.random.default_rng(3)
    places = seen.places + rng.normal(0.0, 0.05, seen.places.shape)
    wrong = rng.random(len(places)) < 0.1
    places[wrong] += rng.normal(0.0, 15.0, (np.count_nonzero(wrong), 2))
    given = views._replace(poses=_wrong(views, 2))
    start = bundle.triangulate(given, seen, 40)
    found = bundle.solve(given, start, seen._replace(places=places), Prior(0.005, 0.02))
    assert _left(found.views.poses, views.poses) < 5e-3
    assert np.median(found.errors[~wrong]) < 0.1


@pytest.mark.slow
def test_deviations_are_those_of_repeated_noise():
    views = _views()
    seen, prior = _sightings(views, _POINTS), Prior(2e-4, 8e-4)
    corrections, told = [], []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        errors = rng.normal(0.0, 1.0, (6, 6)) * np.repeat([2e-4, 8e-4], 3)
        given = views._replace(poses=bundle.corrected(views.poses, errors))
        places = seen.places + rng.normal(0.0, 0.3, seen.places.shape)
        found = bundle.solve(given, _POINTS, seen._replace(places=places), prior)
        corrections.append(bundle.correction_between(views.poses, found.views.poses))
        told.append(found.deviations)
    ratio = np.std(corrections, axis=0) / np.mean(told, axis=0)
    assert 0.8 < np.median(ratio) < 1.25


def test_a_view_without_sightings_keeps_its_pose():
    views = _views()
    seen = _sightings(views, _POINTS)
    kept = seen.view != 3
    few = Sightings(seen.view[kept], seen.point[kept], seen.places[kept])
    found = bundle.solve(views, _POINTS, few, Prior(0.005, 0.02))
    np.testing.assert_allclose(found.views.poses[3], views.poses[3], atol=1e-9)
    np.testing.assert_allclose(found.deviations[3], np.repeat([0.005, 0.02], 3), rtol=1e-6)
