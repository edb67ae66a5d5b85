import json

import numpy as np
import pytest

from experiments.captures.world import (
    Placement,
    ball_of_masks,
    meeting_point,
    move,
    place,
    sees,
    undo_motion,
    upright,
)
from refref_jax.data import SceneError
from refref_jax.geometry.cameras import image_rays, orbit
from tests.factories.small_captures import pose_of

_CENTRE = np.array([0.4, -1.0, 2.0])


def _orbit(shift=0.0):
    poses = orbit(7, distance=4.0, elevation=0.4, size=8, angle_x=1.0).poses
    return place(poses, Placement(np.full(3, -shift), 1.0))


def test_a_point_keeps_its_pixel():
    poses, point = _orbit(), np.array([0.3, 0.1, -0.2])
    moved = place(poses, Placement(_CENTRE, 2.5))
    before = np.einsum("nji,nj->ni", poses[..., :3], point - poses[..., 3])
    after = np.einsum("nji,nj->ni", moved[..., :3], 2.5 * (point - _CENTRE) - moved[..., 3])
    np.testing.assert_allclose(after, 2.5 * before, atol=1e-12)


def test_axes_meet_where_the_cameras_look():
    np.testing.assert_allclose(meeting_point(_orbit()), 0.0, atol=1e-12)
    np.testing.assert_allclose(meeting_point(_orbit(shift=0.7)), 0.7, atol=1e-12)


def test_the_meeting_point_is_the_nearest_to_all_axes():
    rng = np.random.default_rng(0)
    poses = _orbit() + np.concatenate(
        [np.zeros((7, 3, 3)), rng.normal(0.0, 0.3, (7, 3, 1))], axis=-1
    )

    def squares(point):
        away = point - poses[..., 3]
        along = np.einsum("ni,ni->n", away, poses[..., 2])
        return np.sum(away**2) - np.sum(along**2)

    best = meeting_point(poses)
    for _ in range(50):
        assert squares(best) <= squares(best + rng.normal(0.0, 0.1, 3))


def test_parallel_axes_meet_nowhere():
    poses = np.stack([pose_of(0)[:3]] * 3)
    poses[1, 2, 3] += 1.0
    with pytest.raises(SceneError, match=r"look in the same direction.*centre, such as"):
        meeting_point(poses)


def test_an_applied_transform_is_undone():
    motion = np.array([[1.0, 0, 0, 0.5], [0, 0, 1, -2.0], [0, -1, 0, 1.0]])
    poses = _orbit()
    applied = np.concatenate(
        [
            motion[:, :3] @ poses[..., :3],
            3.0 * (poses[..., 3] @ motion[:, :3].T + motion[:, 3])[..., None],
        ],
        axis=-1,
    )
    np.testing.assert_allclose(undo_motion(applied, motion, 3.0), poses, atol=1e-12)


def _random_placement():
    rng = np.random.default_rng(3)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return Placement(_CENTRE, 0.37, turn * np.sign(np.linalg.det(turn)))


def test_points_and_poses_move_together():
    poses, where = _orbit(), _random_placement()
    points = np.random.default_rng(0).normal(size=(9, 3))
    before = np.einsum("nji,npj->npi", poses[..., :3], points - poses[:, None, :, 3])
    moved, turned = move(points, where), place(poses, where)
    after = np.einsum("nji,npj->npi", turned[..., :3], moved - turned[:, None, :, 3])
    np.testing.assert_allclose(after, 0.37 * before, atol=1e-12)


def test_a_record_leads_back():
    where = _random_placement()
    record = json.loads(json.dumps(where.record()))
    points = np.random.default_rng(0).normal(size=(9, 3))
    moved = move(points, where)
    back = moved @ np.array(record["rotation"]) / record["scale"] + record["centre"]
    np.testing.assert_allclose(back, points, atol=1e-12)


def test_the_cameras_mean_up_becomes_z():
    poses, where = _orbit(), _random_placement()
    tilted = place(poses, where)
    turn = upright(tilted)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    mean = (turn @ tilted[..., 1].mean(axis=0)) / np.linalg.norm(tilted[..., 1].mean(axis=0))
    np.testing.assert_allclose(mean, [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(upright(poses), np.eye(3), atol=1e-12)
    down = place(poses, Placement(np.zeros(3), 1.0, np.diag([1.0, -1.0, -1.0])))
    np.testing.assert_allclose(
        upright(down) @ down[..., 1].mean(axis=0), poses[..., 1].mean(axis=0)
    )


def test_cameras_without_a_common_up_keep_theirs():
    poses = _orbit()[:2]
    rolled = poses.copy()
    rolled[1, :, :2] = -poses[0, :, :2]
    rolled[1, :, 2] = poses[0, :, 2]
    np.testing.assert_array_equal(upright(rolled), np.eye(3))


def _masks_of_a_ball(cameras, centre, radius):
    """A pixel sees a ball where the angle to its centre is below that of its tangents."""
    rays = [image_rays(cameras, i).directions for i in range(len(cameras.poses))]
    towards = centre - cameras.poses[..., 3]
    distance = np.linalg.norm(towards, axis=-1)
    cosines = [each @ way / far for each, way, far in zip(rays, towards, distance, strict=True)]
    limits = np.sqrt(1.0 - (radius / distance) ** 2)
    return np.stack([cosine >= limit for cosine, limit in zip(cosines, limits, strict=True)])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_ball_is_found_in_its_masks_whatever_its_place_and_size(scale):
    centre = np.array([0.5, -0.2, 0.3])
    cameras = orbit(14, distance=4.0, elevation=0.5, size=64, angle_x=1.0)
    cameras = cameras._replace(poses=place(cameras.poses, Placement(-_CENTRE, scale)))
    true = scale * (centre + _CENTRE)
    masks = _masks_of_a_ball(cameras, true, 0.4 * scale)
    found = ball_of_masks(masks, cameras)
    assert np.linalg.norm(found.centre - true) < 0.05 * scale
    assert 0.4 * scale < found.radius < 0.6 * scale  # with cones above and below
    assert sees(found, cameras).all()


@pytest.mark.slow
def test_empty_masks_and_a_wrong_one_do_no_harm():
    cameras = orbit(40, distance=4.0, elevation=0.5, size=64, angle_x=1.0)
    masks = _masks_of_a_ball(cameras, np.zeros(3), 0.5)
    whole = ball_of_masks(masks, cameras)
    masks[3] = masks[17] = False
    masks[8] = np.roll(masks[8], 25, axis=1)
    found = ball_of_masks(masks, cameras)
    assert np.linalg.norm(found.centre - whole.centre) < 0.05
    assert found.radius == pytest.approx(whole.radius, rel=0.1)


def test_masks_that_show_no_object_are_refused():
    cameras = orbit(6, distance=4.0, elevation=0.5, size=32, angle_x=1.0)
    with pytest.raises(SceneError, match="No mask marks the object"):
        ball_of_masks(np.zeros((6, 32, 32), bool), cameras)
    with pytest.raises(SceneError, match=r"mark 100 % of the pixels.*--masks"):
        ball_of_masks(np.ones((6, 32, 32), bool), cameras)
    corners = np.zeros((6, 32, 32), bool)
    corners[::2, :3, :3] = corners[1::2, -3:, -3:] = True
    with pytest.raises(SceneError, match="no point in common"):
        ball_of_masks(corners, cameras)


@pytest.mark.parametrize(
    ("views", "of", "reason"),
    [(3, 120, "within 6 degrees"), (10, 120, "within 26 degrees"), (5, 5, "have a radius of 2")],
)
def test_views_that_leave_the_place_of_the_object_unknown_are_refused(views, of, reason):
    whole = orbit(of, distance=4.0, elevation=0.3, size=64, angle_x=1.0)
    some = whole._replace(poses=whole.poses[:views])
    masks = _masks_of_a_ball(some, np.zeros(3), 1.4)
    with pytest.raises(SceneError, match=rf"{views} masks leave .*place unknown.*{reason}"):
        ball_of_masks(masks, some)
