import numpy as np
import pytest

from refref_jax.data.masks import well_inside, well_outside


def _masks():
    masks = np.zeros((2, 9, 9), bool)
    masks[0, 2:7, 2:7] = True
    return masks


def test_margins_by_hand():
    inside, outside = well_inside(_masks(), margin=1), well_outside(_masks(), margin=2)
    expected = np.zeros((9, 9), bool)
    expected[3:6, 3:6] = True
    np.testing.assert_array_equal(inside[0], expected)
    # Two pixels around a square of five leave nothing of nine.
    assert not outside[0].any()
    assert not inside[1].any() and outside[1].all()


def test_a_mask_at_the_rim_of_the_image_has_no_inside_there():
    assert well_inside(np.ones((1, 5, 5), bool), margin=1).sum() == 9


@pytest.mark.parametrize("margin", [0, 1, 2])
def test_inside_and_outside_never_meet(margin):
    masks = np.random.default_rng(0).uniform(size=(3, 16, 16)) < 0.3
    inside, outside = well_inside(masks, margin=margin), well_outside(masks, margin=margin)
    assert not np.any(inside & ~masks) and not np.any(outside & masks)
    if margin == 0:
        np.testing.assert_array_equal(inside, masks)
        np.testing.assert_array_equal(outside, ~masks)
