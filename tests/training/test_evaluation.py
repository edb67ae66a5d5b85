import sys

import jax
import numpy as np
import pytest

from experiments.runs import perceptual
from refref_jax import metrics
from refref_jax.data.scene_folder import Frames
from refref_jax.optics.path_settings import STRAIGHT, TREE
from refref_jax.render import Model, Rendering
from refref_jax.training import evaluation
from refref_jax.training.evaluation import Perceptual
from tests.factories import made_lpips, scenes
from tests.factories.small_model import CAMERAS, MODEL, initial

pytestmark = pytest.mark.loose

_NOTHING = Perceptual()

_KINDS = ("distance", "surface", "substituted")


def _seen(rgb, distance=1.0, dropped=0.0):
    shape = rgb.shape[:2]
    grey = np.full(shape, np.float32(distance))
    return Rendering(rgb, grey, grey, grey, rgb, np.full((*shape, 3), np.float32(dropped)))


def _truth(masks, distances):
    images = np.zeros((1, 16, 16, 3), np.uint8)
    return evaluation.Truth(Frames(("a",), (), None, None, CAMERAS), images, masks, distances)


def _top_rows():
    mask = np.zeros((1, 16, 16), bool)
    mask[0, :4] = True
    return mask


def _ones():
    return np.full((1, 16, 16), np.float32(1.0))


def _measure(seen, truth, first=None, perceptual=_NOTHING):
    return evaluation.measure(seen, truth, 0, first=first, perceptual=perceptual)


_GREY = np.full((16, 16, 3), np.float32(0.1))


def test_all_measures_by_hand():
    found = _measure(_seen(_GREY, distance=3.0, dropped=0.25), _truth(_top_rows(), _ones()))
    assert found["psnr"] == pytest.approx(20.0, abs=1e-6)
    assert found["psnr_masked"] == pytest.approx(20.0, abs=1e-6)
    assert found["distance_mae"] == found["distance_mae_masked"] == pytest.approx(2.0)
    assert found["distance_rmse"] == found["distance_rmse_masked"] == pytest.approx(2.0)
    assert found["dropped"] == 0.25
    assert found["lpips"] is found["flip"] is None


def test_the_three_kinds_of_distances_by_hand():
    # The median is 2 too far everywhere. The first surface is met in two of the four rows of the
    # mask, where it is 1 too near, and beside them in two rows of background, 3 too near.
    first = np.full((16, 16), np.float32(np.inf))
    first[:2], first[4:6] = 0.0, -2.0
    found = _measure(_seen(_GREY, distance=3.0), _truth(_top_rows(), _ones()), first)
    assert found["distance_mae"] == found["distance_mae_masked"] == pytest.approx(2.0)
    assert found["surface_mae_masked"] == pytest.approx((2 * 1 + 2 * 2) / 4)
    assert found["surface_rmse_masked"] == pytest.approx(np.sqrt((2 * 1 + 2 * 4) / 4))
    assert found["surface_mae"] == pytest.approx((2 * 1 + 2 * 3 + 12 * 2) / 16)
    assert found["surface_rmse"] == pytest.approx(np.sqrt((2 * 1 + 2 * 9 + 12 * 4) / 16))
    assert found["substituted_mae_masked"] == found["substituted_rmse_masked"] == 0.0
    assert found["substituted_mae"] == pytest.approx(12 * 2 / 16)
    assert found["substituted_rmse"] == pytest.approx(np.sqrt(12 * 4 / 16))


def test_straight_light_has_one_kind_of_distance():
    found = _measure(_seen(_GREY, distance=3.0), _truth(_top_rows(), _ones()))
    for key in ("mae", "mae_masked", "rmse", "rmse_masked"):
        assert found[f"surface_{key}"] == found[f"substituted_{key}"] == found[f"distance_{key}"]


def test_distances_that_are_not_known_count_nowhere():
    distances = _ones()
    distances[0, 0], distances[0, 10:] = np.inf, np.inf
    first = np.full((16, 16), np.float32(1.5))
    found = _measure(_seen(_GREY, distance=3.0), _truth(_top_rows(), distances), first)
    assert found["distance_mae"] == pytest.approx(2.0)
    assert found["surface_mae"] == found["surface_mae_masked"] == pytest.approx(0.5)
    assert found["substituted_mae"] == pytest.approx(6 * 2 / 9)


def test_without_a_mask_or_distances_nothing_of_them_is_measured():
    first = np.full((16, 16), np.float32(1.0))
    found = _measure(_seen(_GREY), _truth(None, _ones()), first)
    masked = [key for key in found if key.endswith("_masked")]
    assert len(masked) == 7 and all(found[key] is None for key in masked)
    assert found["substituted_mae"] is None and found["surface_mae"] == 0.0
    found = _measure(_seen(_GREY), _truth(_top_rows(), None), first)
    assert all(found[key] is None for key in found if key.startswith(_KINDS))


def test_what_is_over_no_pixel_is_left_out_and_spoils_no_mean():
    nothing = np.zeros((1, 16, 16), bool)
    misses = np.full((1, 16, 16), np.float32(np.inf))
    found = _measure(_seen(_GREY), _truth(nothing, misses), np.ones((16, 16), np.float32))
    assert found["psnr_masked"] is None
    assert all(found[key] is None for key in found if key.startswith(_KINDS))
    assert evaluation.mean_of([found, found | {"psnr_masked": 30.0}], "psnr_masked") == 30.0
    assert evaluation.mean_of([found], "psnr_masked") is None


def test_equal_images_are_infinitely_good():
    black = np.zeros((16, 16, 3), np.float32)
    found = _measure(_seen(black), _truth(_top_rows(), _ones()))
    assert found["psnr"] == found["psnr_masked"] == np.inf
    assert found["ssim"] == pytest.approx(1.0, abs=1e-9)
    assert all(found[key] == 0.0 for key in found if key.startswith(_KINDS))
    assert evaluation.mean_of([found, found | {"psnr": 30.0}], "psnr") == np.inf


def test_an_image_too_small_for_a_window_has_no_ssim():
    flat = np.full((10, 30, 3), np.float32(0.5))
    found = evaluation.measure_colours(flat, np.zeros_like(flat), None, _NOTHING)
    assert found["ssim"] is None
    assert found["psnr"] == pytest.approx(-20.0 * np.log10(0.5))


def test_double_precision_ends_with_the_measuring():
    _measure(_seen(_GREY), _truth(_top_rows(), _ones()))
    assert not jax.config.jax_enable_x64


def test_eyes_are_asked_where_they_are_at_hand(tmp_path):
    lpips = metrics.load_lpips(made_lpips.write(tmp_path / "weights.npz"))
    asked = []

    def flip(rendered, target):
        asked.append((rendered.shape, target.max()))
        return 0.125

    rng = np.random.default_rng(0)
    rendered, target = rng.uniform(size=(2, 33, 31, 3)).astype(np.float32)
    found = evaluation.measure_colours(rendered, target, None, Perceptual(lpips, flip))
    expected = jax.jit(metrics.lpips)(lpips, *jax.device_put((rendered, target)))
    assert found["lpips"] == pytest.approx(float(expected), rel=1e-5)
    assert found["flip"] == 0.125 and asked == [((33, 31, 3), target.max())]
    small = evaluation.measure_colours(rendered[:30], target[:30], None, Perceptual(lpips, flip))
    assert small["lpips"] is None and small["flip"] == 0.125


def _photograph(gain, *, lamp=False):
    """Returns a rendering, a photograph of it with gains, and a mask of part of it."""
    rng = np.random.default_rng(0)
    linear = rng.uniform(0.05, 0.5, (20, 20, 3))
    encode = lambda x: np.where(x > 0.0031308, 1.055 * x ** (1.0 / 2.4) - 0.055, 12.92 * x)
    rendered, target = encode(linear), np.clip(encode(linear * gain), 0.0, 1.0)
    mask = np.zeros((20, 20), bool)
    mask[5:12, 6:15] = True
    if lamp:
        target[:3] = 1.0
    return rendered, target, mask


@pytest.mark.parametrize("lamp", [False, True])
def test_a_gain_of_the_photograph_costs_nothing_after_it_is_fitted(lamp):
    rendered, target, mask = _photograph(np.array([1.2, 0.9, 0.8]), lamp=lamp)
    found = evaluation.measure_after_gain(rendered, target, mask)
    assert found["psnr_masked_after_gain"] > 100.0
    assert (found["psnr_after_gain"] > 100.0) != lamp
    plain = evaluation.measure_colours(rendered, target, mask, _NOTHING)
    assert plain["psnr_masked"] < 30.0


def test_what_is_seen_through_the_object_has_no_say_in_the_gain():
    rendered, target, mask = _photograph(np.ones(3))
    target = np.where(mask[..., None], 0.5 * target, target)
    found = evaluation.measure_after_gain(rendered, target, mask)
    plain = evaluation.measure_colours(rendered, target, mask, _NOTHING)
    assert found["psnr_masked_after_gain"] == pytest.approx(plain["psnr_masked"], abs=1e-6)


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_black_and_saturated_images_have_no_gain(value):
    rendered, target, mask = _photograph(np.ones(3))
    found = evaluation.measure_after_gain(np.full_like(rendered, value), target, mask)
    plain = evaluation.measure_colours(np.full_like(rendered, value), target, mask, _NOTHING)
    assert found["psnr_after_gain"] == pytest.approx(plain["psnr"], abs=1e-6)


def test_without_a_mask_all_pixels_are_beside_the_object():
    rendered, target, _ = _photograph(np.array([0.7, 1.0, 1.1]))
    found = evaluation.measure_after_gain(rendered, target, None)
    assert found["psnr_after_gain"] > 100.0 and found["psnr_masked_after_gain"] is None


def _model(settings):
    scene = scenes.build(scenes.ball(1.3, subdivisions=1))
    return Model(MODEL, settings, scene, initial(MODEL))


def test_evaluating_is_rendering_and_measuring_view_by_view(ball_scene):
    views, calls = [], []
    found = evaluation.evaluate(
        _model(STRAIGHT),
        str(ball_scene),
        limit=2,
        progress=lambda *call: calls.append(call),
        on_view=views.append,
    )
    truth = evaluation.read_truth(ball_scene, "test")
    names = [truth.frames.names[0], truth.frames.names[-1]]
    assert [view.name for view in views] == [image["name"] for image in found.per_image] == names
    assert [(view.place, view.count) for view in views] == [(0, 2), (1, 2)]
    assert [call[:2] for call in calls] == [(0, 2), (1, 2), (2, 2)]
    assert calls[-1][2] == f"{names[1]}  PSNR {found.per_image[1]['psnr']:.2f}"
    expected = evaluation.measure(views[1].rendering, truth, -1, first=None, perceptual=_NOTHING)
    assert views[1].measures == expected | {"seconds": found.per_image[1]["seconds"]}
    np.testing.assert_array_equal(views[1].target, truth.images[-1])
    for key, value in found.results.items():
        each = [image[key.replace("seconds_per_image", "seconds")] for image in found.per_image]
        assert value == (None if None in each else pytest.approx(np.mean(each)))
    assert "seconds" not in found.results and found.learned is None


def test_surfaces_are_known_where_light_bends():
    assert evaluation.first_distances(_model(STRAIGHT), CAMERAS, 0) is None
    first = evaluation.first_distances(_model(TREE), CAMERAS, 0)
    # A ball of radius 1.3, seen from a distance of 4; its facets lie a little deeper.
    assert np.min(first) == pytest.approx(2.7, abs=0.15) and np.isinf(first[0, 0])


@pytest.mark.parametrize(
    ("wrong", "says"),
    [({"limit": 0}, "Give 1 or more"), ({"rays_per_pixel": 3}, "Give 1 or 4")],
)
def test_wrong_arguments_are_refused_before_anything_is_read(wrong, says):
    with pytest.raises(ValueError, match=says):
        evaluation.evaluate(_model(STRAIGHT), "nowhere", **wrong)


def test_what_is_not_at_hand_is_warned_of_once(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    assert perceptual.chosen(None) == Perceptual(None, None)
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("warning: LPIPS") and "docs/metrics.md" in first
    assert second.startswith("warning: FLIP") and "pip install -e '.[flip]'" in second
    with pytest.raises(ValueError, match=r"none\.npz cannot be read"):
        perceptual.chosen(str(tmp_path / "none.npz"))
    weights = made_lpips.write(tmp_path / "weights.npz")
    assert perceptual.chosen(str(weights)).lpips is not None
    assert "LPIPS" not in capsys.readouterr().out
