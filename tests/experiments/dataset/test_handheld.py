"""A hand-held camera and its faults: closed forms, bounds, the same result for the same seed."""

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.dataset import captures, handheld, room
from experiments.dataset.frame_files import Rendering, to_srgb
from refref_jax.data import image_files

_LENS = handheld.usual_lens(64, 48.5)
_PINHOLE = handheld.Lens(48.5, 32.0, 32.0)
_SETTINGS = captures.CaptureSettings(views=40, size=32)


def test_radial_and_tangential_distortion_have_their_closed_form():
    lens = handheld.Lens(1.0, 0.0, 0.0, k1=-0.2, k2=0.05)
    # Along an axis: r (1 + k1 r^2 + k2 r^4).
    assert handheld.bent(lens, np.array([0.5, 0.0])) == pytest.approx(
        [0.5 * (1 - 0.05 + 0.05 / 16), 0.0]
    )
    lens = handheld.Lens(1.0, 0.0, 0.0, p1=0.01, p2=-0.02)
    # x + 2 p1 x y + p2 (r^2 + 2 x^2), y + p1 (r^2 + 2 y^2) + 2 p2 x y.
    expected = [0.3 + 0.0024 - 0.02 * 0.43, 0.4 + 0.01 * 0.57 - 0.0048]
    assert handheld.bent(lens, np.array([0.3, 0.4])) == pytest.approx(expected, abs=1e-12)


def test_the_inverse_of_a_lens_is_one():
    points = np.stack(np.meshgrid(*[np.linspace(-0.7, 0.7, 15)] * 2), -1)
    back = handheld.straightened(_LENS, handheld.bent(_LENS, points))
    assert np.abs(back - points).max() < 1e-9


def test_a_lens_without_an_inverse_is_refused():
    with pytest.raises(ValueError, match="no inverse"):
        handheld.straightened(_PINHOLE._replace(k1=-3.0), np.array([[0.6, 0.6]]))


def _scene(size):
    """Returns linear light that a coarse image resolves."""
    x, y = np.meshgrid(np.linspace(0.0, 1.0, size), np.linspace(0.0, 1.0, size))
    return 0.4 + 0.2 * np.stack([np.sin(5 * x), np.cos(4 * y), np.sin(3 * (x + y))], -1)


def _shot(lens, **other):
    options = {"fine_focal": 3 * 48.5, "size": 64, "gain": np.ones(3), "seed": 1} | other
    return handheld.photograph(_scene(240), lens, **options)


def test_a_pinhole_without_faults_takes_the_picture_itself():
    inner = _scene(240)[24:-24, 24:-24].reshape(64, 3, 64, 3, 3).mean((1, 3))
    difference = _shot(_PINHOLE).astype(float) - to_srgb(inner)
    # What is left is noise, of at most sqrt(2e-4 * 0.6) in linear light.
    assert abs(difference.mean()) < 0.1 and 0.5 < difference.std() < 4.0


def test_a_lens_moves_what_it_sees():
    straight, curved = _shot(_PINHOLE).astype(float), _shot(_LENS).astype(float)
    assert np.abs(straight[:4, :4] - curved[:4, :4]).mean() > 3.0


def test_a_margin_that_does_not_suffice_is_refused():
    with pytest.raises(ValueError, match="wider margin"):
        _shot(_LENS._replace(focal=38.0))


def test_faults_depend_on_their_seed_alone():
    np.testing.assert_array_equal(_shot(_LENS), _shot(_LENS))
    assert (_shot(_LENS) != _shot(_LENS, seed=2)).any()
    mask = np.hypot(*(np.indices((64, 64)) - 30.0)) < 20.0
    one, same, other = (handheld.wobble(mask, pixels=2.0, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()
    poses = handheld.orbit(12, distance=4.0, seed=5)
    np.testing.assert_array_equal(poses, handheld.orbit(12, distance=4.0, seed=5))
    wrong = handheld.disturb(poses, degrees=0.3, share=0.005, seed=6)
    np.testing.assert_array_equal(wrong, handheld.disturb(poses, degrees=0.3, share=0.005, seed=6))
    np.testing.assert_array_equal(handheld.gains(9, seed=7), handheld.gains(9, seed=7))


def test_edges_of_masks_move_by_two_pixels_at_most():
    radius = np.hypot(*(np.indices((96, 96)) - 47.5))
    wrong = handheld.wobble(radius < 30.0, pixels=2.0, seed=0)
    assert not wrong[radius > 33.0].any() and wrong[radius < 27.0].all()
    # It does move them: about 190 pixels of edge, by more than half a pixel on average.
    assert np.count_nonzero(wrong != (radius < 30.0)) > 90
    empty = np.zeros((8, 8), bool)
    assert not handheld.wobble(empty, pixels=2.0, seed=0).any()


def test_gains_drift_slowly_within_a_third_of_a_stop():
    gains = handheld.gains(60, seed=3)
    stops = np.log2(gains)
    assert np.abs(stops[:, 1]).max() == pytest.approx(1 / 3)
    assert np.abs(stops - stops[:, 1:2]).max() < math.log2(1.05) + 1e-9
    assert np.abs(np.diff(stops[:, 1])).max() < 0.25
    assert np.all(handheld.gains(1, seed=0) == 1.0)


def test_errors_of_poses_have_their_stated_size():
    poses = handheld.orbit(4000, distance=4.0, seed=0)
    wrong = handheld.disturb(poses, degrees=0.3, share=0.005, seed=1)
    turns = Rotation.from_matrix(wrong[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1))
    assert np.sqrt(np.mean(turns.magnitude() ** 2)) == pytest.approx(np.radians(0.3), rel=0.03)
    moved = np.linalg.norm(wrong[:, :3, 3] - poses[:, :3, 3], axis=-1)
    share = moved / np.linalg.norm(poses[:, :3, 3], axis=-1)
    assert np.sqrt(np.mean(share**2)) == pytest.approx(0.005, rel=0.03)


def test_the_walk_goes_around_the_object_and_looks_at_it():
    poses = handheld.orbit(60, distance=4.2, seed=0)
    turning = poses[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, :3]
    np.testing.assert_allclose(turning, np.broadcast_to(np.eye(3), (60, 3, 3)), atol=1e-12)
    distance = np.linalg.norm(poses[:, :3, 3], axis=-1)
    assert distance.min() > 3.8 and distance.max() < 4.6
    towards = -(poses[:, :3, 2] * poses[:, :3, 3]).sum(-1) / distance
    assert np.all(towards < -math.cos(math.radians(8.0)))
    elevation = np.degrees(np.arcsin(poses[:, 2, 3] / distance))
    assert elevation.min() > 10.0 and elevation.max() < 50.0
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=-1)
    assert steps.max() < 2.5 * np.median(steps)


def test_splits_share_the_walk_and_three_training_masks_are_missing():
    views = [_SETTINGS.numbers(split) for split in ("train", "val", "test")]
    assert sorted(itertools.chain(*views)) == list(range(40))
    assert [len(each) for each in views] == [32, 3, 5]
    lacking = captures.without_mask(_SETTINGS)
    assert len(lacking) == 3 and lacking <= set(_SETTINGS.numbers("train"))
    with pytest.raises(ValueError, match="no mask"):
        captures.CaptureSettings(views=4)
    with pytest.raises(ValueError, match="nearest is torus"):
        captures.CaptureSettings(object="tours")


def test_the_perfect_image_is_the_middle_of_a_rendering():
    edge = 3 * (32 + 2 * 4)
    rows, columns = np.indices((edge, edge)).astype(np.float32)
    light = np.stack([rows, columns, np.ones_like(rows)], -1)
    fine = Rendering(light, rows, light, columns > 60)
    middle = captures.perfect_rendering(fine, _SETTINGS)
    # Pixel 0 is that of fine pixels 12, 13, 14; its middle is that of 13.
    assert middle.linear.shape == (32, 32, 3)
    np.testing.assert_allclose(middle.linear[0, 5], [13.0, 28.0, 1.0], rtol=1e-6)
    assert middle.depth[0, 0] == 13.0 and middle.depth[31, 0] == 106.0
    np.testing.assert_array_equal(middle.mask[0], 3 * np.arange(32) + 13 > 60)


def test_surfaces_of_the_room_surround_the_cameras_and_nothing_is_in_their_way():
    surfaces = room.furnish(-1.4)
    names = [surface.name for surface in surfaces]
    assert len(set(names)) == len(names)
    sides = [(u, v) for u in (0.0, 0.5, 1.0) for v in (0.0, 0.5, 1.0)]
    for surface in surfaces:
        assert abs(surface.along @ surface.up) < 1e-12
        points = surface.corner + [u * surface.along + v * surface.up for u, v in sides]
        # Cameras are 3.4 to 4.8 from the origin, above the table and below the roof.
        high = points[(points[:, 2] > -0.6) & (points[:, 2] < 3.9)]
        away = np.hypot(high[:, 0], high[:, 1])
        assert np.all((away < 3.3) | (away > 4.9)), surface.name


def test_wider_textures_repeat_less_often_on_the_same_surfaces():
    fine, wide = room.furnish(-1.4), room.furnish(-1.4, texture_scale=2.0)
    for one, other in zip(fine, wide, strict=True):
        assert one.name == other.name and other.look.width == 2.0 * one.look.width
        np.testing.assert_array_equal(one.corner, other.corner)
    light = np.ones((2, 2, 3))
    one, other = (
        room.paint(next(s for s in surfaces if s.name == "wall_right"), light)
        for surfaces in (fine, wide)
    )
    assert np.abs(np.diff(other, axis=1)).mean() < 0.7 * np.abs(np.diff(one, axis=1)).mean()


def test_a_surface_has_the_light_of_its_picture_times_what_arrives():
    look = room.Look(None, colour=(0.5, 0.25, 1.0))
    surface = room.Surface("a", np.zeros(3), 2.0 * np.eye(3)[0], np.eye(3)[2], look)
    light = np.array([[[1.0] * 3, [3.0] * 3], [[1.0] * 3, [3.0] * 3]])
    painted = room.paint(surface, light)
    assert painted.shape == (72, 144, 3)
    np.testing.assert_allclose(painted[0, 0], [0.5, 0.25, 1.0])
    np.testing.assert_allclose(painted[-1, -1], [1.5, 0.75, 3.0])
    # Halfway between the texels' middles, u = 1/2, lies the mean.
    np.testing.assert_allclose(painted[0, 71:73, 0].mean(), 1.0)
    shining = surface._replace(radiance=(2.0, 2.0, 2.0))
    np.testing.assert_allclose(room.paint(shining, None)[3, 3], [1.0, 0.5, 2.0])


def test_pictures_on_surfaces_are_upright():
    picture = room._picture("bookshelf")
    look = room.Look("bookshelf")
    surface = room.Surface("a", np.zeros(3), 2.0 * np.eye(3)[0], 2.0 * np.eye(3)[2], look)
    painted = room.paint(surface, np.ones((2, 2, 3)))
    rows = image_files.srgb_to_linear(picture).mean((1, 2)).reshape(8, -1).mean(1)
    np.testing.assert_allclose(painted.mean((1, 2)).reshape(8, -1).mean(1), rows, rtol=0.1)
