import itertools
import math

import numpy as np
import pytest

from refref_jax.geometry.cameras import (
    Cameras,
    box_filter,
    distance_to_planar_depth,
    focal_length,
    image_rays,
    orbit,
    pixel_rays,
    planar_depth_to_distance,
    supersample,
)

# Rays are stored in single precision, whose rounding is 6e-8.
_SINGLE = 2e-7

# Poses and depths are computed in double precision.
_DOUBLE = 1e-12


_UNPOSED = np.eye(4)[:3]

# Two rotations with a shift: x -> y -> z -> x, and half a turn around x.
_TURNED = np.array([[0.0, 0.0, 1.0, 5.0], [1.0, 0.0, 0.0, 6.0], [0.0, 1.0, 0.0, 7.0]])
_UPSIDE_DOWN = np.array([[1.0, 0.0, 0.0, 0.5], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, -2.0]])


def _cameras(width, height, focal, poses=(_UNPOSED,)):
    return Cameras(np.stack(poses), width, height, focal)


def _index(*values):
    return np.array(values, np.int64)


def _slow_direction(cameras, camera, x, y):
    """The unit direction through image point (x, y) in pixels, number by number."""
    in_camera = ((x - cameras.width / 2) / cameras.focal, (cameras.height / 2 - y) / cameras.focal)
    vector = (*in_camera, -1.0)
    pose = cameras.poses[camera]
    world = [sum(pose[i, j] * vector[j] for j in range(3)) for i in range(3)]
    norm = math.sqrt(sum(v * v for v in vector))
    return np.array([v / norm for v in world])


@pytest.mark.parametrize(
    ("width", "angle", "focal"),
    [
        (100, math.pi / 2, 50.0),
        (128, 2.0 * math.atan(0.5), 128.0),
        (3, 2.0 * math.atan(1.5), 1.0),
    ],
)
def test_focal_length_of_known_triangles(width, angle, focal):
    assert focal_length(width, angle) == pytest.approx(focal, rel=_DOUBLE)


def test_camera_above_the_origin_sees_x_to_the_right_and_y_up():
    pose = np.concatenate([np.eye(3), [[0.0], [0.0], [4.0]]], axis=1)
    cameras = _cameras(9, 9, 9.0, [pose])
    rays = image_rays(cameras, 0)
    on_ground = rays.origins + rays.directions * (4.0 / -rays.directions[..., 2:])
    np.testing.assert_allclose(on_ground[..., 2], 0.0, atol=1e-6)
    assert np.all(np.diff(on_ground[..., 0], axis=1) > 0.0)
    assert np.all(np.diff(on_ground[..., 1], axis=0) < 0.0)
    np.testing.assert_allclose(on_ground[4, 4], 0.0, atol=1e-6)
    np.testing.assert_allclose(on_ground[0, 8], [16.0 / 9.0, 16.0 / 9.0, 0.0], atol=1e-6)


@pytest.mark.parametrize("pose", [_UNPOSED, _TURNED, _UPSIDE_DOWN])
def test_rays_agree_with_a_scalar_reference(pose):
    cameras = _cameras(7, 4, 3.3, [_UPSIDE_DOWN, pose])
    rays = image_rays(cameras, 1)
    assert rays.origins.shape == rays.directions.shape == (4, 7, 3)
    assert rays.radii.shape == (4, 7)
    for row, column in itertools.product(range(4), range(7)):
        expected = _slow_direction(cameras, 1, column + 0.5, row + 0.5)
        np.testing.assert_allclose(rays.directions[row, column], expected, atol=_SINGLE)
        np.testing.assert_array_equal(rays.origins[row, column], pose[:, 3])


@pytest.mark.parametrize("shape", [(5,), (2, 3), (0,), ()])
def test_pixels_may_have_any_shape(shape):
    cameras = _cameras(4, 4, 4.0)
    zero = np.zeros(shape, np.int64)
    rays = pixel_rays(cameras, zero, np.full(shape, 1), np.full(shape, 2))
    assert rays.origins.shape == rays.directions.shape == (*shape, 3)
    assert rays.radii.shape == shape
    assert {rays.origins.dtype, rays.directions.dtype, rays.radii.dtype} == {np.dtype(np.float32)}


@pytest.mark.parametrize("focal", [3.0, 12.0, 500.0])
def test_radius_is_the_pixel_s_solid_angle_by_finite_differences(focal):
    cameras = _cameras(12, 8, focal, [_TURNED])
    rays = image_rays(cameras, 0)
    step = 1e-4
    for row, column in [(0, 0), (3, 7), (7, 11), (4, 5)]:
        x, y = column + 0.5, row + 0.5
        along_x = _slow_direction(cameras, 0, x + step, y) - _slow_direction(
            cameras, 0, x - step, y
        )
        along_y = _slow_direction(cameras, 0, x, y + step) - _slow_direction(
            cameras, 0, x, y - step
        )
        solid_angle = np.linalg.norm(np.cross(along_x, along_y)) / (2.0 * step) ** 2
        expected = math.sqrt(solid_angle) * 2.0 / math.sqrt(12.0)
        # Differences over 2e-4 pixels are good to about the square of that.
        assert rays.radii[row, column] == pytest.approx(expected, rel=1e-6)


def test_planar_depth_is_scaled_by_the_length_of_the_direction_with_unit_z():
    cameras = _cameras(7, 5, 3.0)
    depth = np.random.default_rng(0).uniform(0.1, 20.0, (2, 3, 5, 7))
    row, column = np.indices((5, 7))
    x, y = (column + 0.5 - 3.5) / 3.0, (row + 0.5 - 2.5) / 3.0
    expected = depth * np.linalg.norm(np.stack([x, y, np.ones((5, 7))]), axis=0)
    np.testing.assert_allclose(planar_depth_to_distance(cameras, depth), expected, rtol=_SINGLE)


def test_planar_depth_and_distance_are_each_others_inverse():
    cameras = _cameras(7, 5, 3.0)
    depth = np.random.default_rng(1).uniform(0.1, 20.0, (5, 7))
    depth[0, 0] = np.inf
    distance = planar_depth_to_distance(cameras, depth)
    np.testing.assert_allclose(distance_to_planar_depth(cameras, distance), depth, rtol=_SINGLE)


@pytest.mark.parametrize("elevation", [-1.5, -0.4, 0.0, 0.7, 1.5])
def test_orbit_cameras_look_at_the_origin_with_z_up(elevation):
    cameras = orbit(7, distance=4.0, elevation=elevation, size=5, angle_x=1.0)
    rotations, positions = cameras.poses[..., :3], cameras.poses[..., 3]
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 4.0, rtol=_DOUBLE)
    np.testing.assert_allclose(positions[:, 2], 4.0 * math.sin(elevation), atol=_DOUBLE)
    np.testing.assert_allclose(
        rotations @ np.swapaxes(rotations, 1, 2), np.tile(np.eye(3), (7, 1, 1)), atol=_DOUBLE
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, rtol=_DOUBLE)
    np.testing.assert_allclose(rotations[:, 2, 0], 0.0, atol=_DOUBLE)
    assert np.all(rotations[:, 2, 1] > 0.0)
    for camera in range(7):
        centre = pixel_rays(cameras, _index(camera), _index(2), _index(2))
        np.testing.assert_allclose(centre.origins + 4.0 * centre.directions, 0.0, atol=2e-6)


def test_orbit_starts_on_the_x_axis_and_goes_round_evenly():
    cameras = orbit(4, distance=2.0, elevation=0.0, size=8, angle_x=math.pi / 2)
    expected = [[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [-2.0, 0.0, 0.0], [0.0, -2.0, 0.0]]
    np.testing.assert_allclose(cameras.poses[..., 3], expected, atol=_DOUBLE)
    assert (cameras.width, cameras.height) == (8, 8)
    assert cameras.focal == pytest.approx(4.0, rel=_DOUBLE)


def test_small_pixels_surround_the_pixel_that_they_make():
    cameras = _cameras(8, 6, 5.0, (_TURNED,))
    fine = supersample(cameras, 3)
    assert (fine.width, fine.height, fine.focal) == (24, 18, 15.0)
    coarse, small = image_rays(cameras, 0), image_rays(fine, 0)
    # The middle one of 3 x 3 is the pixel's own ray, and its cone a third as wide.
    np.testing.assert_allclose(small.directions[1::3, 1::3], coarse.directions, atol=_SINGLE)
    np.testing.assert_allclose(small.radii[1::3, 1::3], coarse.radii / 3.0, rtol=1e-6)
    np.testing.assert_array_equal(small.origins[1::3, 1::3], coarse.origins)


def test_the_box_filter_averages_each_pixel_s_own_block():
    pixels = np.arange(6 * 4 * 3, dtype=float).reshape(6, 4, 3)
    found = box_filter(pixels, 2)
    assert found.shape == (3, 2, 3)
    for row in range(3):
        for column in range(2):
            block = pixels[2 * row : 2 * row + 2, 2 * column : 2 * column + 2]
            np.testing.assert_allclose(found[row, column], block.reshape(-1, 3).mean(axis=0))
    np.testing.assert_array_equal(box_filter(pixels, 1), pixels)
    assert box_filter(pixels[..., 0], 2).shape == (3, 2)
