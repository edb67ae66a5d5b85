"""Cameras of windows: conversions by hand, the rule of cropping, the nearest view."""

import math

import numpy as np
import pytest

from experiments.viewer import cameras
from experiments.viewer.cameras import Viewpoint
from refref_jax.geometry.cameras import image_rays, orbit

_ORBIT = orbit(8, distance=4.0, elevation=0.3, size=64, angle_x=1.1656)


def _view(aspect, fov=0.8):
    return Viewpoint(_ORBIT.poses[3], fov, aspect)


def test_a_browser_that_looks_along_z_sees_our_camera_turned_around():
    view = cameras.from_browser(np.array([1.0, 0, 0, 0]), np.array([1.0, 2, 3]), 0.8, 1.5)
    np.testing.assert_allclose(view.pose[:, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-12)
    np.testing.assert_array_equal(view.pose[:, 3], [1.0, 2.0, 3.0])
    middle = cameras.window(view, 36).rays.directions.reshape(-1, 3).mean(axis=0)
    assert middle[2] > 0.9 and np.all(np.abs(middle[:2]) < 1e-6)


def test_a_pose_survives_the_browser():
    for pose in _ORBIT.poses:
        again = cameras.from_browser(*cameras.to_browser(pose), 0.8, 1.0)
        np.testing.assert_allclose(again.pose, pose, atol=1e-12)


@pytest.mark.parametrize("aspect", [0.4, 1.0, 4 / 3, 16 / 9, 2.0, 3.7])
@pytest.mark.parametrize("height", [36, 90, 181])
def test_the_picture_covers_the_window_and_what_sticks_out_is_cropped(aspect, height):
    view = _view(aspect)
    rays = cameras.window(view, height).rays
    rows, columns = rays.radii.shape
    width = cameras.width_of(height)
    assert (rows == height) if aspect <= width / height else (columns == width)
    assert (
        rows <= height
        and columns <= width
        and abs(columns - rows * aspect) <= 2.0 * max(1.0, aspect)
    )
    # A corner of the window is where its field of view and aspect say.
    own = np.einsum("ij,...i->...j", view.pose[:, :3], rays.directions)
    across, along = -own[..., 0] / own[..., 2], -own[..., 1] / own[..., 2]
    half = math.tan(0.5 * view.fov)
    pixel = along[0, 0] - along[1, 0]
    assert abs(along[0, 0] + 0.5 * pixel - half) <= 1.01 * pixel
    assert abs(across[0, -1] + 0.5 * pixel - half * aspect) <= 1.01 * pixel
    np.testing.assert_allclose(across[:, 0], -across[:, -1], atol=1e-5)
    np.testing.assert_allclose(along[0], -along[-1], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=-1), 1.0, atol=1e-6)


def test_a_square_window_on_a_square_view_has_the_view_s_own_rays():
    fov = cameras.containing_fov(_ORBIT, 1.0)
    view = Viewpoint(_ORBIT.poses[2], fov, 1.0)
    ours, theirs = cameras.window(view, 64).rays, image_rays(_ORBIT, 2)
    np.testing.assert_allclose(ours.directions, theirs.directions, atol=1e-6)
    np.testing.assert_allclose(ours.radii, theirs.radii, rtol=1e-5)


def test_the_nearest_view_of_a_view_is_itself_and_a_small_step_does_not_matter():
    for i, pose in enumerate(_ORBIT.poses):
        assert cameras.nearest(pose, _ORBIT) == i
        moved = pose.copy()
        moved[:, 3] += [0.1, -0.1, 0.2]
        assert cameras.nearest(moved, _ORBIT) == i
    # Looking elsewhere counts: between two places, the one that looks the same way is taken.
    between = _ORBIT.poses[0].copy()
    between[:, 3] = 0.5 * (_ORBIT.poses[0] + _ORBIT.poses[1])[:, 3]
    assert cameras.nearest(between, _ORBIT) == 0


def test_only_what_a_hand_moves_is_a_change():
    view = _view(1.5)
    assert cameras.is_same(view, view._replace(pose=view.pose + 1e-5))
    assert not cameras.is_same(view, view._replace(pose=view.pose + 0.01))
    assert not cameras.is_same(view, view._replace(fov=0.9))
    assert not cameras.is_same(view, view._replace(aspect=1.6))


def test_the_nearest_view_does_not_depend_on_where_the_scene_is():
    away = np.array([100.0, 0.0, 0.0])
    moved = _ORBIT._replace(poses=_ORBIT.poses + np.pad(away[:, None], ((0, 0), (3, 0))))
    for pose in _ORBIT.poses:
        near = pose.copy()
        near[:, 3] += [0.5, -0.3, 0.2]
        expected = cameras.nearest(near, _ORBIT)
        near[:, 3] += away
        assert cameras.nearest(near, moved, centre=(100.0, 0.0, 0.0)) == expected
