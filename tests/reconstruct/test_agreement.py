"""Masks that a body does not agree with: known by which of them was spoilt."""

import functools

import numpy as np
import pytest

from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.masks import Views
from refref_jax.reconstruct.mesh_distance import carved_alone, without_outliers
from tests.factories import bodies

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
    with pytest.raises(ReconstructionError, match="can not be left out"):
        without_outliers(bodies.icosphere(1), _views(), count)


def test_no_views_carve_nothing():
    cameras = _views().cameras
    with pytest.raises(ReconstructionError, match="There is no mask"):
        carved_alone(Views(_views().masks[:0], cameras._replace(poses=cameras.poses[:0])))


def test_the_view_that_overlaps_least_is_left_out():
    mesh = bodies.icosphere(3)
    kept = without_outliers(mesh, _halved(), 1)
    assert len(kept.masks) == len(kept.cameras.poses) == 29
    np.testing.assert_array_equal(kept.masks, np.delete(_views().masks, _SPOILT, axis=0))
    expected = np.delete(_views().cameras.poses, _SPOILT, axis=0)
    np.testing.assert_array_equal(kept.cameras.poses, expected)
    assert without_outliers(mesh, _halved(), 0).masks.shape == _views().masks.shape
