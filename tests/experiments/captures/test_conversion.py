import numpy as np
import pytest

from experiments.captures.conversion import (
    Placement,
    centred_windows,
    meeting_point,
    place,
    undo_motion,
)
from refref_jax.data import SceneError
from refref_jax.geometry.cameras import orbit
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


@pytest.mark.parametrize(
    ("centres", "size", "starts", "kept", "shift"),
    [
        ([6.0], 12, [0], 12, 0.0),  # centred: all of it
        ([6.2], 12, [0], 12, 0.2),  # a fifth of a pixel costs nothing
        ([6.4], 12, [1], 11, 0.1),  # a column from the left, and half a pixel is gained
        ([5.0], 12, [0], 10, 0.0),
        ([8.5], 12, [5], 7, 0.0),
        ([5.0, 7.0], 12, [0, 2], 10, 0.0),  # of one size, at different places
        ([6.0, 6.5], 12, [0, 0], 12, 0.5),
    ],
)
def test_by_hand(centres, size, starts, kept, shift):
    windows = centred_windows(np.array(centres), size)
    assert (windows.starts.tolist(), windows.size) == (starts, kept)
    assert windows.shift == pytest.approx(shift)


def test_no_window_leaves_its_image_or_is_off_by_more_than_half_a_pixel():
    rng = np.random.default_rng(0)
    for _ in range(200):
        size = int(rng.integers(8, 60))
        centres = size * rng.uniform(0.3, 0.7, rng.integers(1, 5))
        windows = centred_windows(centres, size)
        assert windows.starts.min() >= 0 and windows.starts.max() + windows.size <= size
        middles = windows.starts + 0.5 * windows.size
        assert np.abs(middles - centres).max() == pytest.approx(windows.shift)
        assert windows.shift <= 0.5
        # Nothing larger by two would have done: the nearest principal point bounds it.
        nearest = np.minimum(centres, size - centres).min()
        assert windows.size + 2 > 2.0 * nearest - 1.0


def test_one_image_is_never_off_by_more_than_a_quarter():
    for centre in np.linspace(4.0, 8.0, 41):
        assert centred_windows(np.array([centre]), 12).shift <= 0.25 + 1e-12
