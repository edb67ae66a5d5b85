import dataclasses

import pytest

from tests.factories.small_model import MODEL


def test_samples_may_begin_at_the_camera():
    assert dataclasses.replace(MODEL, near=0.0).near == 0.0


@pytest.mark.parametrize(("near", "far"), [(-0.1, 15.0), (15.0, 15.0), (float("nan"), 15.0)])
def test_distances_out_of_order_are_refused(near, far):
    with pytest.raises(ValueError, match="0 <= near < far"):
        dataclasses.replace(MODEL, near=near, far=far)


@pytest.mark.parametrize("radius", [0.0, -1.0, float("inf"), float("nan")])
def test_a_cube_of_no_size_is_refused(radius):
    for name in ("radius", "field_radius"):
        with pytest.raises(ValueError, match=f"{name} is {radius}"):
            dataclasses.replace(MODEL, **{name: radius})
