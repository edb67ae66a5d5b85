import numpy as np
import pytest

from refref_jax.data import SceneError
from refref_jax.data.nerfstudio.conversion import Placement, meeting_point, place, undo_motion
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
    with pytest.raises(SceneError, match=r"look the same way.*centre, such as"):
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
