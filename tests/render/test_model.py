import dataclasses

import pytest

from refref_jax.render.model import BackdropConfig
from tests.factories.small_model import MODEL


def test_samples_may_begin_at_the_camera():
    assert dataclasses.replace(MODEL, near=0.0).near == 0.0


@pytest.mark.parametrize(("near", "far"), [(-0.1, 15.0), (15.0, 15.0), (float("nan"), 15.0)])
def test_distances_out_of_order_are_refused(near, far):
    with pytest.raises(ValueError, match="0 <= near < far"):
        dataclasses.replace(MODEL, near=near, far=far)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"hull_cells": 0}, r"cells are \(8, 3, 0\)\. Give positive numbers"),
        ({"field_ball": (0.0, 0.0, 2.0, -1.0)}, "is not a ball"),
    ],
)
def test_a_backdrop_without_cells_or_with_a_ball_of_no_size_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        BackdropConfig(8, **given)
