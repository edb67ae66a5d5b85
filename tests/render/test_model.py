import dataclasses

import pytest

from tests.factories.small_model import MODEL


def test_samples_may_begin_at_the_camera():
    assert dataclasses.replace(MODEL, near=0.0).near == 0.0


@pytest.mark.parametrize(("near", "far"), [(-0.1, 15.0), (15.0, 15.0), (float("nan"), 15.0)])
def test_distances_out_of_order_are_refused(near, far):
    with pytest.raises(ValueError, match="0 <= near < far"):
        dataclasses.replace(MODEL, near=near, far=far)
