import numpy as np
import pytest

from experiments import measures
from refref_jax.data.local_layout import Frames
from refref_jax.render import Rendering
from tests.small_model import CAMERAS


def _seen(rgb, distance=1.0, lost=0.0):
    shape = rgb.shape[:2]
    grey = np.full(shape, np.float32(distance))
    return Rendering(rgb, grey, grey, grey, rgb, np.full((*shape, 3), np.float32(lost)))


def _truth(masks, distances):
    images = np.zeros((1, 16, 16, 3), np.uint8)
    return measures.Truth(Frames(("a",), (), None, None, CAMERAS), images, masks, distances)


_GREY = np.full((16, 16, 3), np.float32(0.1))


def test_all_measures_by_hand():
    mask = np.zeros((1, 16, 16), bool)
    mask[0, :2] = True
    distances = np.full((1, 16, 16), np.float32(1.0))
    seen = _seen(_GREY, distance=3.0, lost=0.25)
    found = measures.measure(seen, _truth(mask, distances), 0)
    assert found["psnr"] == pytest.approx(20.0, abs=1e-4)
    assert found["psnr_masked"] == pytest.approx(20.0, abs=1e-4)
    assert found["distance_mae"] == pytest.approx(2.0)
    assert found["distance_mae_masked"] == pytest.approx(2.0)
    assert found["lost"] == 0.25


def test_what_is_over_no_pixel_is_left_out_and_spoils_no_mean():
    nothing = np.zeros((1, 16, 16), bool)
    misses = np.full((1, 16, 16), np.float32(np.inf))
    found = measures.measure(_seen(_GREY), _truth(nothing, misses), 0)
    assert found["psnr_masked"] is found["distance_mae"] is found["distance_mae_masked"] is None
    assert measures.mean_of([found, found | {"psnr_masked": 30.0}], "psnr_masked") == 30.0
    assert measures.mean_of([found], "psnr_masked") is None
