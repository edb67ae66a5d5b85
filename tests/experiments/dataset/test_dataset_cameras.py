"""Where cameras of the data set stand, and how they look."""

import json
import math

import numpy as np
import pytest
import scipy.stats

from experiments.captures import world
from experiments.dataset import cameras
from experiments.dataset.seeds import seed_of
from tests.processes.command import ROOT

_BUNDLED = ROOT / "experiments" / "data" / "cube_smcvx_ball"


_POSES = {
    "random": cameras.random_poses(500, seed=3),
    "helix": cameras.helix_poses(100),
    "poles": cameras.look_at_origin(
        np.array([0.0, 1.0, -2.5]), np.array([0.5 * math.pi, -0.5 * math.pi, 0.5])
    ),
}


@pytest.mark.parametrize("kind", _POSES)
def test_poses_are_rigid_and_look_at_the_origin_with_z_up(kind):
    poses = _POSES[kind]
    axes, positions = poses[:, :3, :3], poses[:, :3, 3]
    assert poses.dtype == np.float64
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-12)
    np.testing.assert_allclose(
        np.swapaxes(axes, 1, 2) @ axes, np.broadcast_to(np.eye(3), axes.shape), atol=1e-12
    )
    np.testing.assert_array_equal(poses[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (len(poses), 1)))
    # Four units along -z of the camera is the origin.
    np.testing.assert_allclose(positions - 4.0 * axes[:, :, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(axes[:, 2, 0], 0.0, atol=1e-12)
    assert np.all(axes[:, 2, 1] >= -1e-12)


def test_random_poses_are_uniform_on_the_sphere():
    positions = cameras.random_poses(20000, seed=11)[:, :3, 3]
    # Standard errors are 4 / sqrt(3 * 20000) = 0.016 and 0.034.
    np.testing.assert_allclose(positions.mean(0), 0.0, atol=0.07)
    np.testing.assert_allclose(np.cov(positions.T), 16.0 / 3.0 * np.eye(3), atol=0.15)
    height = scipy.stats.kstest(positions[:, 2], "uniform", args=(-4.0, 8.0))
    azimuth = np.arctan2(positions[:, 1], positions[:, 0])
    turn = scipy.stats.kstest(azimuth, "uniform", args=(-math.pi, 2.0 * math.pi))
    assert height.pvalue > 1e-3 and turn.pvalue > 1e-3


def test_more_poses_begin_with_the_fewer():
    many, few = cameras.random_poses(100, seed=5), cameras.random_poses(7, seed=5)
    np.testing.assert_array_equal(many[:7], few)
    assert not np.allclose(few, cameras.random_poses(7, seed=6))


def test_the_helix_rises_from_minus_10_to_65_degrees_in_three_turns():
    first, middle, last = cameras.helix_poses(3)
    np.testing.assert_allclose(first[:3, 3], [3.939231012, 0.0, -0.694592711], atol=1e-8)
    # Half of three turns is on the other side, 27.5 degrees up.
    np.testing.assert_allclose(middle[:3, 3], [-3.548043301, 0.0, 1.846994453], atol=1e-8)
    np.testing.assert_allclose(last[:3, 3], [1.690473047, 0.0, 3.625231148], atol=1e-8)
    assert world.USUAL_DISTANCE == cameras.CAMERA_RADIUS  # captures are scaled to it


def test_the_bundled_scene_was_seen_from_the_helix():
    record = json.loads((_BUNDLED / "transforms_test.json").read_text())
    expected = np.array([frame["transform_matrix"] for frame in record["frames"]])
    np.testing.assert_allclose(cameras.helix_poses(len(expected)), expected, atol=1e-6)
    assert record["camera_angle_x"] == pytest.approx(cameras.ANGLE_X, abs=1e-7)


def test_splits_have_poses_of_their_own():
    poses = [
        cameras.split_poses(scene, split, 20)
        for scene in ("cube_smcvx_ball", "env_smcvx_ball")
        for split in ("train", "val")
    ]
    firsts = {tuple(each[0, :3, 3]) for each in poses}
    assert len(firsts) == 4
    np.testing.assert_array_equal(
        cameras.split_poses("cube_smcvx_ball", "test", 20), cameras.helix_poses(20)
    )


def test_seeds_are_the_same_on_every_machine():
    # The first 16 digits of `printf 'cube_smcvx_ball\0train\0' | sha256sum`.
    assert seed_of("cube_smcvx_ball", "train") == 0xBFBC145261EEC7B1
    assert seed_of("a", "bc") != seed_of("ab", "c")


def test_wrong_input_is_told():
    with pytest.raises(ValueError, match=r"no split 'eval'\. Choose from train, val, test"):
        cameras.split_poses("cube_smcvx_ball", "eval", 3)
    for make in (cameras.helix_poses, lambda count: cameras.random_poses(count, seed=0)):
        with pytest.raises(ValueError, match=r"0 poses were requested\. Request one or more"):
            make(0)
    assert cameras.helix_poses(1).shape == (1, 4, 4)
