import functools
import itertools

import numpy as np
import pytest

from refref_jax.geometry.triangle_meshes import volume
from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.grids import Box, Grid, find_isosurface, gradient, interpolate, sample
from refref_jax.reconstruct.masks import (
    LEAST_RESOLUTION,
    carve,
    check_masks,
    hull_field,
    signed_distances,
)
from tests.factories import bodies

_BOX = Box(np.full(3, -1.5), np.full(3, 1.5))


@functools.cache
def _ball_views(views=30):
    cameras = bodies.cameras_around(views)
    return bodies.masks_of(bodies.ball, cameras), cameras


def _volume(grid):
    mesh = find_isosurface(grid)
    return volume(mesh.vertices, mesh.faces)


_BALL = 4.0 / 3.0 * np.pi


def test_distances_to_a_straight_outline_are_known_by_hand():
    mask = np.zeros((20, 20), bool)
    mask[:, :10] = True
    expected = np.broadcast_to(np.arange(20) - 9.5, (20, 20))
    assert np.allclose(signed_distances(mask, blur=0.0), expected)
    # The average keeps what is linear, away from the image's border.
    middle = slice(8, 12)
    assert np.allclose(signed_distances(mask)[:, middle], expected[:, middle], atol=1e-3)


@pytest.mark.parametrize("radius", [8.0, 25.0])
def test_discs_keep_their_size_to_a_fraction_of_a_pixel(radius):
    errors = []
    for shift in itertools.product((0.0, 0.3, 0.45), repeat=2):
        centre = np.array([32.0, 32.0]) + shift
        row, column = np.indices((64, 64)) + 0.5
        away = np.hypot(row - centre[0], column - centre[1]) - radius
        near = np.abs(away) < 1.0
        errors.append((signed_distances(away < 0.0) - away)[near])
    errors = np.concatenate(errors)
    assert abs(errors.mean()) < 0.04 and errors.std() < 0.2


def test_a_mask_of_all_or_no_pixels_has_no_outline():
    full = np.ones((4, 5), bool)
    assert np.all(np.isneginf(signed_distances(full)))
    assert np.all(np.isposinf(signed_distances(~full)))


def test_what_the_border_cuts_is_not_carved_there():
    mask = np.zeros((30, 30), bool)
    mask[10:20, :] = True
    found = signed_distances(mask, blur=0.0)
    assert np.allclose(found[15], found[15, 0]) and found[15, 0] < -4.0


def test_samples_agree_with_the_field_near_its_surface():
    grid = sample(bodies.torus, Box(np.full(3, -1.6), np.full(3, 1.6)), spacing=0.05)
    points = grid.low + grid.spacing * np.moveaxis(np.indices(grid.values.shape), 0, -1)
    truth = bodies.torus(points)
    assert np.array_equal(grid.values < 0.0, truth < 0.0)
    near = np.abs(truth) < 3.0 * grid.spacing
    assert np.allclose(grid.values[near], truth[near])


def test_interpolation_and_gradient_are_exact_for_a_linear_field():
    slope = np.array([0.5, -1.0, 2.0])
    points = np.moveaxis(np.indices((9, 9, 9)), 0, -1) * 0.25 - 1.0
    grid = Grid(points @ slope, np.full(3, -1.0), 0.25)
    at = np.random.default_rng(0).uniform(-0.7, 0.7, (50, 3))
    assert np.allclose(interpolate(grid, at), at @ slope)
    assert np.allclose(gradient(grid, at), slope)


def test_one_view_carves_its_cone_and_nothing_else():
    cameras = bodies.cameras_around(1, distance=4.0)
    masks = bodies.masks_of(bodies.ball, cameras)
    field = hull_field(masks, cameras, tolerance=0.0)
    back = cameras.poses[0, :, 2]
    side = cameras.poses[0, :, 0]
    # The cone that touches the ball has sine 1 / 4 at the camera.
    for depth in (2.0, 4.0, 7.0):
        on_cone = (4.0 - depth) * back + depth * np.tan(np.arcsin(0.25)) * side
        assert abs(field(on_cone[None])[0]) < 0.3 * depth / cameras.focal
        assert field((on_cone + 0.2 * side)[None])[0] > 0.0
        assert field((on_cone - 0.2 * side)[None])[0] < 0.0
    # Neither behind the camera nor outside of its image is anything known.
    assert field((5.0 * back)[None])[0] > 0.0
    assert field((10.0 * side)[None])[0] > 0.0


def test_a_point_that_a_view_does_not_see_is_carved_by_the_others_alone():
    two = bodies.cameras_around(2)
    masks = bodies.masks_of(bodies.ball, two)
    first = two._replace(poses=two.poses[:1])
    # A third camera stands next to the ball and looks away from it.
    away = first.poses[0].copy()
    away[:, [0, 2]] *= -1.0
    cameras = two._replace(poses=np.concatenate([two.poses, away[None]]))
    points = np.random.default_rng(1).uniform(-1.5, 1.5, (200, 3))
    mask = np.zeros_like(masks[:1])
    mask[0, 3, 4] = True
    expected = hull_field(masks, two)(points)
    assert np.allclose(hull_field(np.concatenate([masks, mask]), cameras)(points), expected)


def test_the_hull_of_a_ball_is_little_more_than_the_ball():
    masks, cameras = _ball_views()
    grid = carve(masks, cameras, resolution=48)
    assert _volume(grid) == pytest.approx(_BALL, rel=0.03)
    reach = np.array(grid.values.shape) * grid.spacing
    assert np.all(reach < 2.8), "the box is not tight"
    assert _volume(carve(masks, cameras, resolution=48, box=_BOX)) == pytest.approx(_BALL, rel=0.03)


def test_the_hole_of_a_torus_stays_open():
    cameras = bodies.cameras_around(40)
    grid = carve(bodies.masks_of(bodies.torus, cameras), cameras, resolution=48)
    assert interpolate(grid, np.zeros((1, 3)))[0] > 0.2
    assert _volume(grid) == pytest.approx(2.0 * np.pi**2 * 1.1 * 0.4**2, rel=0.08)


def test_one_bad_mask_is_passed_over():
    masks, cameras = _ball_views()
    bad = masks.copy()
    bad[7] = np.roll(bad[7], 12, axis=1)
    ruined = _volume(carve(bad, cameras, resolution=48))
    kept = _volume(carve(bad, cameras, resolution=48, outliers=1))
    assert ruined < 0.8 * _BALL
    assert kept == pytest.approx(_BALL, rel=0.06)
    # What it costs where no mask is bad.
    assert _BALL * 1.1 > _volume(carve(masks, cameras, resolution=48, outliers=1)) > _BALL


def test_errors_say_what_to_do():
    masks, cameras = _ball_views()
    with pytest.raises(ReconstructionError, match="There are no masks"):
        carve(masks[:0], cameras._replace(poses=cameras.poses[:0]))
    with pytest.raises(ReconstructionError, match="30 masks and 29 cameras"):
        carve(masks, cameras._replace(poses=cameras.poses[1:]))
    with pytest.raises(ReconstructionError, match="are 32 x 64 pixels"):
        carve(masks[:, :, ::2], cameras)
    with pytest.raises(ReconstructionError, match="Views 0, 2: 2 of 30 masks are empty"):
        carve(masks & (~np.isin(np.arange(30), (0, 2)))[:, None, None], cameras)
    with pytest.raises(ReconstructionError, match="Pass a smaller number"):
        carve(masks, cameras, outliers=30)
    with pytest.raises(ReconstructionError, match="resolution=9 is too coarse"):
        carve(masks, cameras, resolution=9)
    with pytest.raises(ReconstructionError, match="masks have the type uint8"):
        check_masks(masks.astype(np.uint8), cameras)
    broken = cameras.poses.copy()
    broken[3, 0, 3] = np.nan
    with pytest.raises(ReconstructionError, match=r"1 poses are not finite, of cameras \[3\]"):
        carve(masks, cameras._replace(poses=broken))


def test_the_coarsest_grid_still_makes_a_body():
    assert _volume(carve(*_ball_views(), resolution=LEAST_RESOLUTION)) > 0.5 * _BALL


@pytest.mark.parametrize("views", [1, 2])
def test_a_body_that_too_few_views_bound_is_refused(views):
    masks, cameras = _ball_views()
    few = cameras._replace(poses=cameras.poses[:views])
    with pytest.raises(ReconstructionError, match="masks from other directions"):
        carve(masks[:views], few)


def test_a_body_larger_than_where_it_is_looked_for_is_refused_and_not_cut_off():
    masks, cameras = _ball_views()
    poses = cameras.poses.copy()
    poses[:, :, 3] *= 3.0
    with pytest.raises(ReconstructionError, match=r"extends outside the cube from -2\.1 to 2\.1"):
        carve(masks, cameras._replace(poses=poses))


def test_where_nothing_is_left_the_view_that_took_most_is_named():
    masks, cameras = _ball_views()
    wrong = masks.copy()
    wrong[11] = False
    wrong[11, :3, :3] = True
    with pytest.raises(ReconstructionError, match="View 11 removed the most"):
        carve(wrong, cameras, resolution=48)
    names = [f"mask/r_{view}.png" for view in range(30)]
    with pytest.raises(ReconstructionError, match=r"mask/r_11\.png removed the most"):
        carve(wrong, cameras, resolution=48, names=names)
